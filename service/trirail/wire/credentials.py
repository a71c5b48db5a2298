"""The folder by which a robot or a user is known on the network: ca.pem, cert.pem and key.pem, read and checked."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple, Self

from trirail.errors import ServiceError
from trirail.wire.endpoints import ReachableBy, reach
from trirail.wire.vocabulary import Role

AUTHORITY, CERTIFICATE, KEY, REVOKED = "ca.pem", "cert.pem", "key.pem", "revoked.txt"
WARNED = timedelta(days=30)
"""So long before a certificate expires it is told."""


class Credentials(NamedTuple):
    """What was found in such a folder."""

    folder: Path
    name: str
    """In whose name the certificate is: a user's, or a robot's; "" where it names nobody."""
    expires: datetime
    """When it, or that of its authority, ends, whichever is first."""
    addresses: tuple[str, ...]
    """At which host names and IP addresses clients find a robot; none for a user's."""
    serves: bool = False
    """Whether it is a robot's or a router's; a user's is good for a client alone."""
    contents: tuple[bytes, ...] = ()
    """Contents of the three files, as they were checked."""
    copies: tuple[Path, ...] = ()
    """Files in this process's memory with these contents, in place of those in the folder."""

    @property
    def files(self) -> tuple[Path, Path, Path]:
        """The authority's certificate, one's own, and its private key."""
        authority, certificate, key = self.copies or (self.folder / name for name in (AUTHORITY, CERTIFICATE, KEY))
        return authority, certificate, key

    def in_memory(self) -> Self:
        """Return the same with files in this process's memory: what happens in the folder matters no more."""
        return self._replace(copies=tuple(map(_memory_file, self.contents)))

    @classmethod
    def read(cls, folder: Path, now: datetime | None = None) -> Self:
        """Read and check a folder. Raises ServiceError, with file and remedy, for what cannot open a session."""
        # Not at the top: whoever needs no certificates does not wait for it.
        from cryptography import x509
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.serialization import load_pem_private_key

        from trirail.wire.certificates import addresses_of, common_name, serves

        authority_file, certificate_file, key_file = (folder / name for name in (AUTHORITY, CERTIFICATE, KEY))
        authority_pem, certificate_pem, key_pem = map(_content, (authority_file, certificate_file, key_file))
        try:
            authority, certificate = map(x509.load_pem_x509_certificate, (authority_pem, certificate_pem))
            key = load_pem_private_key(key_pem, password=None)
        except (ValueError, TypeError) as error:
            raise ServiceError(f"{folder}: {AUTHORITY}, {CERTIFICATE} and {KEY} must be PEM: {error}") from error
        if key.public_key() != certificate.public_key():
            raise ServiceError(f"{folder}: {KEY} is not the key of {CERTIFICATE}: copy the whole folder again")
        try:
            certificate.verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature) as error:
            raise ServiceError(f"{folder}: {CERTIFICATE} is not signed by the authority of {AUTHORITY}") from error
        check_private(key_file)
        now = now or datetime.now(UTC)
        if now < certificate.not_valid_before_utc:
            raise ServiceError(
                f"{certificate_file}: not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC: "
                "is this machine's clock right?"
            )
        expires = min(certificate.not_valid_after_utc, authority.not_valid_after_utc)
        if now > expires:
            raise ServiceError(f"{certificate_file}: expired on {expires:%Y-%m-%d}; trirail keys renew makes a new one")
        return cls(
            folder,
            common_name(certificate),
            expires,
            tuple(addresses_of(certificate)),
            serves(certificate),
            (authority_pem, certificate_pem, key_pem),
        )

    @classmethod
    def read_server(cls, folder: Path) -> Self:
        """Read the folder of a robot or router. Raises ServiceError as `read`, and for a user's."""
        found = cls.read(folder)
        if not found.serves:
            raise ServiceError(
                f"{folder / CERTIFICATE}: the certificate of user {found.name}, with which nobody serves others: "
                "trirail keys init or trirail keys robot makes one for a robot or router"
            )
        return found

    def warning(self, now: datetime | None = None) -> str:
        """Say that it expires soon; "" where it does not."""
        left = self.expires - (now or datetime.now(UTC))
        if left > WARNED:
            return ""
        return f"the certificate in {self.folder} expires in {left.days} days; trirail keys renew makes a new one"


class Admission(NamedTuple):
    """Who serves, and who may do what: read once when a service starts, for every start of its gateway."""

    credentials: Credentials
    users: dict[str, Role]
    """The role of each user who is not revoked."""

    @classmethod
    def read(cls, folder: Path, users: Mapping[str, Role]) -> Self:
        """Read the folder of a robot. Raises ServiceError as `Credentials.read_server` and `revoked`."""
        return cls(Credentials.read_server(folder), with_role(users, folder))


def check_private(key_file: Path) -> None:
    """Raise ServiceError where others than its owner can read a private key, or, where root owns it, than its group."""
    found = key_file.stat()
    if found.st_mode & (0o037 if found.st_uid == 0 else 0o077):
        raise ServiceError(
            f"{key_file}: its mode {stat.S_IMODE(found.st_mode):04o} lets others use this private key: "
            f"chmod 600 {key_file}; if somebody may have read it, revoke it and make another"
        )


def revoked(folder: Path) -> frozenset[str]:
    """Return the users whose certificates are no longer good, from the file of an authority's folder, one a line.

    Raises ServiceError for one that is there and cannot be read.
    """
    file = folder / REVOKED
    return frozenset(_content(file).decode().split()) if file.exists() else frozenset()


def with_role(users: Mapping[str, Role], folder: Path) -> dict[str, Role]:
    """Return the role of each user who is not revoked in an authority's folder. Raises ServiceError as `revoked`."""
    without = revoked(folder)
    return {user: role for user, role in users.items() if user not in without}


def credentials_for(robot: str, locator: str, folder: Path | str | None = None) -> Credentials | None:
    """Read what a client needs at a locator: its folder, by default ~/.config/trirail/<robot>; None where nothing is.

    Raises ServiceError for credentials that are no good, or that would not be used.
    """
    if reach(locator) is ReachableBy.CERTIFICATE:
        base = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        return Credentials.read(Path(folder) if folder is not None else base / "trirail" / robot)
    if folder is not None:
        raise ServiceError(f"{locator}: credentials are for tls/HOST:PORT; nothing else is encrypted")
    return None


def _memory_file(content: bytes) -> Path:
    """Return the path of a new file in memory, there for as long as this process."""
    descriptor = os.memfd_create("credentials")
    os.write(descriptor, content)
    return Path(f"/proc/self/fd/{descriptor}")


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ServiceError(
            f"{file}: {error.strerror}; trirail keys makes {AUTHORITY}, {CERTIFICATE} and {KEY}"
        ) from error
