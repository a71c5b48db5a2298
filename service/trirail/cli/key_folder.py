"""The folder of an authority: its own certificate and key, those of the robot, and a folder to hand over to each user.

    ca.pem  ca-key.pem    the authority; its key can create any user, so keep it off the robot
    cert.pem  key.pem     the robot; [zenoh.tls] reads only these two files, ca.pem and revoked.txt
    revoked.txt           users that no longer have a role, regardless of [zenoh.users]
    users/<user>/         ca.pem, cert.pem, key.pem for the user; delete the key here after you have handed it over

Private keys can be read by their owner only. No file or folder is ever incomplete, because each is written under a
temporary name and then renamed. A renewed certificate has the same key as before.
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
from trirail.wire.certificates import AUTHORITY_SUFFIX, Pair, authority, common_name, issue, renew, serves
from trirail.wire.credentials import AUTHORITY, CERTIFICATE, KEY, REVOKED, Credentials, check_private, revoked

AUTHORITY_KEY = "ca-key.pem"
USERS = "users"
PRIVATE, PUBLIC = 0o600, 0o644


class IssuedCertificate(NamedTuple):
    """A certificate that the authority has issued, or a folder that contains no valid one."""

    name: str
    is_robot: bool
    """Whether the certificate belongs to the authority's own robot."""
    serves: bool
    """Whether the certificate belongs to any robot or router."""
    expires: datetime | None
    """Expiry date; None if there is no valid certificate."""
    folder: Path

    def trouble(self, now: datetime | None = None) -> str:
        """Return the reason why the certificate cannot open a session, or "" if it can."""
        if self.expires is None:
            return f"no valid {CERTIFICATE}: delete {self.folder}, then trirail keys add {self.name} --role ROLE"
        expired = self.expires < (now or datetime.now(UTC))
        return f"expired: trirail keys renew {self.name} makes a new one" if expired else ""


class KeyFolder:
    """The files of an authority. If a method fails, it raises ServiceError with the file and the remedy."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def create(self, robot: str, addresses: Sequence[str], days: float) -> Credentials:
        """Create a new authority, and a certificate for its robot at the addresses where clients find the robot."""
        if self.folder.exists():
            raise ServiceError(f"{self.folder} already exists: use another folder, or renew the certificates in it")
        by = authority(robot)
        with _atomic_folder(self.folder) as made:
            _write(made / AUTHORITY, by.certificate, PUBLIC)
            _write(made / AUTHORITY_KEY, by.key, PRIVATE)
            _write_pair(made, issue(by, robot, days, addresses, serves=True))
        return Credentials.read(self.folder)

    def add(self, user: str, days: float, addresses: Sequence[str] = ()) -> Credentials:
        """Create the folder of a user or, with addresses, of a further robot that clients find at these addresses.

        A revoked name is never issued again, because the old certificate would become valid as well.
        """
        folder = self.folder / USERS / user
        if user in revoked(self.folder):
            raise ServiceError(f"{user} was revoked, and the lost certificate has this name: choose another name")
        if user in self._robot_names():
            raise ServiceError(f"{user} is the name of the robot: choose another name")
        if folder.exists():
            raise ServiceError(f"{folder} already exists: extend the certificate with trirail keys renew {user}")
        by = self._authority()
        with _atomic_folder(folder) as made:
            _write(made / AUTHORITY, by.certificate, PUBLIC)
            _write_pair(made, issue(by, user, days, addresses, serves=bool(addresses)))
        return Credentials.read(folder)

    def renew(self, name: str, days: float) -> IssuedCertificate:
        """Create a new certificate for the existing key of a user or of the robot."""
        there = self._find(name)
        file = there.folder / CERTIFICATE
        try:
            certificate = renew(self._authority(), _read(file), days)
        except (ValueError, x509.ExtensionNotFound) as error:
            raise ServiceError(f"{file}: {error}") from error
        _write(file, certificate, PUBLIC)
        return self._find(name)

    def revoke(self, user: str) -> None:
        """Revoke a user's role and delete the user's folder, if it is still here.

        Only the name counts: the folder may have been moved to the user's machine.
        """
        if user in self._robot_names():
            raise ServiceError(f"{user} is the robot itself, and cannot be revoked: create a new authority instead")
        names = sorted({*revoked(self.folder), user})
        _write(self.folder / REVOKED, "".join(f"{name}\n" for name in names).encode(), PUBLIC)
        for there in [each for each in self.issued() if each.name == user]:
            with _as_service_error():
                rmtree(there.folder)

    def issued(self) -> list[IssuedCertificate]:
        """Return the certificates that were issued and not revoked: the robot's first, then the users' by name."""
        folder = self.folder / USERS
        users = sorted(each for each in folder.iterdir() if each.name[0] != ".") if folder.exists() else []
        return [*self._robot(), *(_issued(each, is_robot=False) for each in users)]

    def _find(self, name: str) -> IssuedCertificate:
        matches = [each for each in self.issued() if each.name == name]
        if not matches:
            raise ServiceError(f"{self.folder}: there is no user {name}; trirail keys list shows the users")
        return matches[0]

    def _robot(self) -> list[IssuedCertificate]:
        """Return the robot's certificate, or nothing if an authority on another machine has only its own files."""
        kept_elsewhere = (self.folder / AUTHORITY_KEY).exists() and not (self.folder / CERTIFICATE).exists()
        return [] if kept_elsewhere else [_issued(self.folder, is_robot=True)]

    def _robot_names(self) -> set[str]:
        """Return the name in the robot's certificate, and that for which the authority was created."""
        names = {each.name for each in self._robot()}
        return names | {common_name(_certificate(self.folder / AUTHORITY)).removesuffix(AUTHORITY_SUFFIX)}

    def _authority(self) -> Pair:
        pair = Pair(_read(self.folder / AUTHORITY), _read(self.folder / AUTHORITY_KEY))
        check_private(self.folder / AUTHORITY_KEY)
        expires = _certificate(self.folder / AUTHORITY).not_valid_after_utc
        if expires < datetime.now(UTC):
            raise ServiceError(
                f"{self.folder / AUTHORITY}: the authority expired on {expires:%Y-%m-%d}: create a new one in another "
                "folder with trirail keys init"
            )
        return pair


def _issued(folder: Path, *, is_robot: bool) -> IssuedCertificate:
    file = folder / CERTIFICATE
    try:
        certificate = _certificate(file)
    except ServiceError as error:
        if is_robot or isinstance(error.__cause__, PermissionError):
            raise
        return IssuedCertificate(folder.name, False, False, None, folder)
    return IssuedCertificate(
        common_name(certificate), is_robot, serves(certificate), certificate.not_valid_after_utc, folder
    )


def _certificate(file: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_read(file))
    except ValueError as error:
        raise ServiceError(f"{file}: not a certificate in PEM format") from error


def _write_pair(folder: Path, pair: Pair) -> None:
    _write(folder / CERTIFICATE, pair.certificate, PUBLIC)
    _write(folder / KEY, pair.key, PRIVATE)


@contextmanager
def _atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a private folder to write to, and rename it to `folder` if the context ends without an error."""
    with _as_service_error():
        files.make_folder(folder.parent, 0o755)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
        try:
            yield made
            made.rename(folder)
            files.sync_folder(folder.parent)
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
    """Convert system errors about a file to a ServiceError with a message of one line."""
    try:
        yield
    except OSError as error:
        raise ServiceError(f"{error.filename}: {error.strerror}; create an authority with trirail keys init") from error
