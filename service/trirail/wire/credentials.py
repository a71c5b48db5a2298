"""Credentials of a robot, router or user on the network: a folder with the files ca.pem, cert.pem and key.pem."""

from __future__ import annotations

import os
import stat
from collections.abc import Collection, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple, Self

from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.errors import ServiceError
from trirail.wire.endpoints import ReachableBy, reach
from trirail.wire.vocabulary import Role

AUTHORITY, CERTIFICATE, KEY, REVOKED = "ca.pem", "cert.pem", "key.pem", "revoked.txt"
EXPIRY_NOTICE = timedelta(days=30)
"""Time before the expiry of a certificate at which warnings begin."""


class Credentials(NamedTuple):
    """Content of a credentials folder."""

    folder: Path
    name: str
    """Common name of the certificate, the name of a user, robot or router; "" if the certificate has none."""
    expires: datetime
    """Expiry of the certificate or of its authority, whichever is earlier."""
    addresses: tuple[str, ...]
    """Host names and IP addresses at which clients connect to a robot; empty for a user."""
    serves: bool = False
    """True if the certificate is for a robot or a router, False if it is for a user and valid for clients only."""
    contents: tuple[bytes, ...] = ()
    """Contents of the three files, read when the credentials were checked."""
    copies: tuple[Path, ...] = ()
    """Files with these contents in this process's memory; if present, they replace the files in the folder."""

    @property
    def files(self) -> tuple[Path, Path, Path]:
        """Paths of the authority's certificate, of the certificate and of its private key."""
        authority, certificate, key = self.copies or (self.folder / name for name in (AUTHORITY, CERTIFICATE, KEY))
        return authority, certificate, key

    def in_memory(self) -> Self:
        """Return a copy with files in this process's memory, so that later changes in the folder have no effect."""
        return self._replace(copies=tuple(map(_memory_file, self.contents)))

    @classmethod
    def read(cls, folder: Path, now: datetime | None = None) -> Self:
        """Read and check the credentials in a folder.

        Raises ServiceError that names the file and a remedy if the credentials are unusable.
        """
        # Imported here, so that clients without certificates do not wait for the import.
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
                f"{certificate_file}: not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC; "
                "check this machine's clock"
            )
        expires = min(certificate.not_valid_after_utc, authority.not_valid_after_utc)
        if now > expires:
            raise ServiceError(f"{certificate_file}: expired on {expires:%Y-%m-%d}; renew it with: trirail keys renew")
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
        """Read and check the credentials of a robot or router.

        Raises ServiceError if the credentials are unusable or are those of a user.
        """
        credentials = cls.read(folder)
        if not credentials.serves:
            raise ServiceError(
                f"{folder / CERTIFICATE}: the certificate of user {credentials.name} is not valid for a robot or "
                "router: "
                "create one with trirail keys init or trirail keys robot"
            )
        return credentials

    def warning(self, now: datetime | None = None) -> str:
        """Return a warning if the certificate expires within EXPIRY_NOTICE; otherwise ""."""
        left = self.expires - (now or datetime.now(UTC))
        if left > EXPIRY_NOTICE:
            return ""
        hours, minutes = divmod(max(0, left // timedelta(minutes=1)), 60)
        within = f"{left.days} days" if left.days > 0 else f"{hours} h {minutes} min"
        return f"certificate in {self.folder}: expires in {within}; renew it with: trirail keys renew"


class Admission(NamedTuple):
    """Credentials of a service and roles of its users, read once at the service's start and used by every gateway."""

    credentials: Credentials
    users: dict[str, Role]
    """Roles of the users, without users that have been revoked."""

    @classmethod
    def read(cls, folder: Path, users: Mapping[str, Role], router: str | None = None) -> Self:
        """Read the credentials in a robot's folder, and remove the revoked users from `users`.

        Raises ServiceError if the credentials are unusable, if the list of revoked users cannot be read, or if the
        robot's `router` is revoked.
        """
        check_not_revoked([router] if router is not None else [], "zenoh.router", folder)
        return cls(Credentials.read_server(folder), with_role(users, folder))


def check_private(key_file: Path) -> None:
    """Raise ServiceError if users other than the owner can read a private key. The group may read a key of root."""
    status = key_file.stat()
    if status.st_mode & (0o037 if status.st_uid == 0 else 0o077):
        raise ServiceError(
            f"{key_file}: mode {stat.S_IMODE(status.st_mode):04o} lets other users read this private key; run "
            f"chmod 600 {key_file}, and revoke and replace the key if another user may have read it"
        )


def revoked(folder: Path) -> frozenset[str]:
    """Return the names of the revoked users from the file revoked.txt, one per line, in an authority's folder.

    The set is empty if the file does not exist. Raises ServiceError if the file exists but cannot be read.
    """
    file = folder / REVOKED
    try:
        return frozenset(files.text(file).split()) if file.exists() else frozenset()
    except (FileError, OSError) as error:
        raise ServiceError(f"{error}; this file lists the revoked users, one per line") from error


def check_not_revoked(names: Collection[str], listed_in: str, folder: Path) -> None:
    """Raise ServiceError if one of these names of robots and routers is revoked.

    `listed_in` tells the error message which settings contain the names.
    """
    if gone := sorted(revoked(folder) & set(names)):
        raise ServiceError(
            f"{', '.join(gone)}: revoked, but still listed in {listed_in}, so the lost certificate would be accepted: "
            "remove the name; if the machine is still in use, create a certificate with a new name for it"
        )


def with_role(users: Mapping[str, Role], folder: Path) -> dict[str, Role]:
    """Return the roles of the users that are not revoked. Raises the ServiceError of `revoked`."""
    without = revoked(folder)
    return {user: role for user, role in users.items() if user not in without}


def credentials_for(robot: str, locator: str, folder: Path | str | None = None) -> Credentials | None:
    """Return the credentials that a client needs at a locator; None if the locator requires no credentials.

    The default folder is that of TRIRAIL_TLS, or else ~/.config/trirail/<robot>. Raises ServiceError if the credentials
    are unusable, or if a folder is given although the locator's protocol does not use credentials.
    """
    if reach(locator) is ReachableBy.CERTIFICATE:
        return Credentials.read(Path(folder or os.environ.get("TRIRAIL_TLS") or _user_folder(robot)))
    if folder is not None:
        raise ServiceError(f"{locator}: this protocol does not use credentials; connect to tls/HOST:PORT")
    return None


def _user_folder(robot: str) -> Path:
    try:
        base = os.environ.get("XDG_CONFIG_HOME") or files.expand_home("~/.config")
    except FileError as error:
        raise ServiceError(f"{error}, or set TRIRAIL_TLS to the folder of the credentials") from error
    return Path(base) / "trirail" / robot


def _memory_file(content: bytes) -> Path:
    """Return the path of a new file in memory, which exists until this process ends."""
    descriptor = os.memfd_create("credentials")
    os.write(descriptor, content)
    return Path(f"/proc/self/fd/{descriptor}")


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ServiceError(
            f"{file}: {error.strerror}; trirail keys creates {AUTHORITY}, {CERTIFICATE} and {KEY}"
        ) from error
