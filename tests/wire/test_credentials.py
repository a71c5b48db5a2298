"""Private keys that others can use are refused, whoever reads them: service, router, client and `trirail keys`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from certificates import tls_config, user
from trirail.cli.key_folder import AUTHORITY_KEY, KeyFolder
from trirail.errors import ServiceError
from trirail.wire.credentials import KEY, Credentials, check_private, credentials_for, revoked, with_role
from trirail.wire.vocabulary import Role


def test_a_key_is_its_owners_alone_and_roots_its_groups_to_read(tmp_path: Path) -> None:
    file = tmp_path / KEY
    file.touch()
    of_root = file.stat().st_uid == 0
    for mode in range(0o1000):
        file.chmod(mode)
        if mode & 0o007 or mode & 0o030 or (mode & 0o040 and not of_root):
            with pytest.raises(ServiceError, match=rf"mode {mode:04o} lets other .* chmod 600 {file}"):
                check_private(file)
        else:
            check_private(file)


def test_everybody_who_reads_one_looks_at_that(tmp_path: Path) -> None:
    tls_config(tmp_path)
    keys = tmp_path / "keys"
    readers: dict[Path, Callable[[], object]] = {
        keys / KEY: lambda: Credentials.read_server(keys),
        user(tmp_path, "ann") / KEY: lambda: Credentials.read(user(tmp_path, "ann")),
        keys / AUTHORITY_KEY: lambda: KeyFolder(keys).renew("ann", 9.0),
    }
    for file, read in readers.items():
        read()
        file.chmod(0o644)
        with pytest.raises(ServiceError, match="lets other users read this private key"):
            read()
        file.chmod(0o600)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_a_list_of_the_revoked_that_is_not_understood_lets_nobody_in(tmp_path: Path, encoding: str) -> None:
    """A program on another system may have written it."""
    (tmp_path / "revoked.txt").write_bytes("ann\r\nbob\r\n".encode(encoding) + (b"\xe4" * (encoding == "latin-1")))
    if encoding.startswith("utf-8"):
        assert with_role({"ann": Role.OPERATOR, "eva": Role.VIEWER}, tmp_path) == {"eva": Role.VIEWER}
    else:
        with pytest.raises(ServiceError, match="not text in UTF-8"):
            revoked(tmp_path)


def test_a_user_without_a_home_is_told_where_credentials_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TRIRAIL_TLS", "XDG_CONFIG_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    with pytest.raises(ServiceError, match="the home folder is unknown: set HOME, or set TRIRAIL_TLS"):
        credentials_for("demo", "tls/127.0.0.1:7447")
