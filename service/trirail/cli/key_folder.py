"""The folder of an authority: its certificate and key, the robot's, and one folder for each user to take away.

    ca.pem  ca-key.pem    the authority: its key can make any user, so keep it off the robot
    cert.pem  key.pem     the robot's own; with ca.pem and revoked.txt they are all that [zenoh.tls] reads here
    revoked.txt           users that have no role any more, whatever [zenoh.users] says
    users/<user>/         ca.pem, cert.pem, key.pem for the user; delete the key here after you have handed it over

Only their owner can read private keys. No file or folder is ever incomplete: each is written beside its place and
renamed. A renewed certificate has the same key.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree
from typing import NamedTuple

from cryptography import x509
from trirail_drivers import files

from trirail.errors import ServiceError
from trirail.wire.certificates import Pair, authority, common_name, issue, renew, serves
from trirail.wire.credentials import AUTHORITY, CERTIFICATE, KEY, REVOKED, Credentials, check_private, revoked

AUTHORITY_KEY = "ca-key.pem"
USERS = "users"
PRIVATE, PUBLIC = 0o600, 0o644


class IssuedCertificate(NamedTuple):
    """A certificate that the authority has made, or a folder in which there is none."""

    name: str
    is_robot: bool
    """Whether it is that of the authority's own robot."""
    serves: bool
    """Whether it is any robot's, or a router's."""
    expires: datetime | None
    """None where there is no certificate."""
    folder: Path

    def trouble(self, now: datetime | None = None) -> str:
        """Say why it opens no session; "" where it does."""
        if self.expires is None:
            return f"no {CERTIFICATE}: delete {self.folder}, then trirail keys add {self.name} --role ROLE"
        expired = self.expires < (now or datetime.now(UTC))
        return f"expired: trirail keys renew {self.name} makes a new one" if expired else ""


class KeyFolder:
    """An authority's files. Every call raises ServiceError, with the file and what would be right."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def create(self, robot: str, addresses: Sequence[str], days: float) -> Credentials:
        """Make a new authority, and the certificate of its robot for the addresses at which clients find it."""
        if self.folder.exists():
            raise ServiceError(f"{self.folder} exists already: name another folder, or renew what is in it")
        by = authority(robot)
        with _atomic_folder(self.folder) as made:
            _write(made / AUTHORITY, by.certificate, PUBLIC)
            _write(made / AUTHORITY_KEY, by.key, PRIVATE)
            _write_pair(made, issue(by, robot, days, addresses, serves=True))
        return Credentials.read(self.folder)

    def add(self, user: str, days: float, addresses: Sequence[str] = ()) -> Credentials:
        """Make a user's folder; with addresses that of a further robot, which clients find there.

        A name that was revoked is never given again: the old certificate would be good too.
        """
        folder = self.folder / USERS / user
        if user in revoked(self.folder):
            raise ServiceError(f"{user} was revoked, and the lost certificate has that name: choose another one")
        if user == self._robot().name:
            raise ServiceError(f"{user} is the robot itself: choose another name")
        if folder.exists():
            raise ServiceError(f"{folder} exists already: trirail keys renew {user} makes it good for longer")
        by = self._authority()
        with _atomic_folder(folder) as made:
            _write(made / AUTHORITY, by.certificate, PUBLIC)
            _write_pair(made, issue(by, user, days, addresses, serves=bool(addresses)))
        return Credentials.read(folder)

    def renew(self, name: str, days: float) -> IssuedCertificate:
        """Make a new certificate for the key of a user, or of the robot."""
        there = self._find(name)
        file = there.folder / CERTIFICATE
        try:
            certificate = renew(self._authority(), _read(file), days)
        except (ValueError, x509.ExtensionNotFound) as error:
            raise ServiceError(f"{file}: {error}") from error
        _write(file, certificate, PUBLIC)
        return self._find(name)

    def revoke(self, user: str) -> None:
        """Revoke a user's role, and delete the user's folder."""
        there = self._find(user)
        if there.is_robot:
            raise ServiceError(f"{user} is the robot itself: a new authority makes its certificate worthless")
        names = sorted({*revoked(self.folder), user})
        _write(self.folder / REVOKED, "".join(f"{name}\n" for name in names).encode(), PUBLIC)
        with _as_service_error():
            rmtree(there.folder)

    def issued(self) -> list[IssuedCertificate]:
        """Return what has been issued and not been revoked: the robot's first, then those of users, by name."""
        folder = self.folder / USERS
        users = sorted(each for each in folder.iterdir() if each.name[0] != ".") if folder.exists() else []
        return [self._robot(), *(_issued(each, is_robot=False) for each in users)]

    def _find(self, name: str) -> IssuedCertificate:
        matches = [each for each in self.issued() if each.name == name]
        if not matches:
            raise ServiceError(f"{self.folder}: there is no user {name}; trirail keys list shows the users")
        return matches[0]

    def _robot(self) -> IssuedCertificate:
        return _issued(self.folder, is_robot=True)

    def _authority(self) -> Pair:
        pair = Pair(_read(self.folder / AUTHORITY), _read(self.folder / AUTHORITY_KEY))
        check_private(self.folder / AUTHORITY_KEY)
        return pair


def _issued(folder: Path, *, is_robot: bool) -> IssuedCertificate:
    file = folder / CERTIFICATE
    if not is_robot and not file.exists():
        return IssuedCertificate(folder.name, False, False, None, folder)
    try:
        certificate = x509.load_pem_x509_certificate(_read(file))
    except ValueError as error:
        raise ServiceError(f"{file}: not a certificate as PEM") from error
    return IssuedCertificate(
        common_name(certificate), is_robot, serves(certificate), certificate.not_valid_after_utc, folder
    )


def _write_pair(folder: Path, pair: Pair) -> None:
    _write(folder / CERTIFICATE, pair.certificate, PUBLIC)
    _write(folder / KEY, pair.key, PRIVATE)


@contextmanager
def _atomic_folder(folder: Path) -> Iterator[Path]:
    """Give a folder to write to, that nobody else can open; it gets its name when the context ends without an error."""
    with _as_service_error():
        folder.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            yield made
            made.rename(folder)
        except BaseException:
            rmtree(made, ignore_errors=True)
            raise


def _write(file: Path, content: bytes, mode: int) -> None:
    with _as_service_error():
        files.replace(file, content, mode)


def _read(file: Path) -> bytes:
    with _as_service_error():
        return file.read_bytes()


@contextmanager
def _as_service_error() -> Iterator[None]:
    """Say what the system says of a file in one line."""
    try:
        yield
    except OSError as error:
        raise ServiceError(f"{error.filename}: {error.strerror}; trirail keys init makes an authority") from error
