"""Before Ruckig is compiled, what that needs is checked; a machine with a ready-made package is not bothered."""

from __future__ import annotations

from pathlib import Path

import check_ruckig
import pytest


@pytest.mark.parametrize(
    ("system", "machine", "version", "compiled"),
    [
        ("linux", "x86_64", (3, 11), False),
        ("linux", "x86_64", (3, 14), False),
        ("linux", "x86_64", (3, 15), True),
        ("linux", "aarch64", (3, 11), True),
        ("darwin", "arm64", (3, 12), False),
    ],
)
def test_only_a_machine_without_a_package_compiles(
    system: str, machine: str, version: tuple[int, int], compiled: bool
) -> None:
    assert check_ruckig.is_compiled(system, machine, version) == compiled


@pytest.fixture
def raspberry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")


@pytest.mark.usefixtures("raspberry")
@pytest.mark.parametrize("compiler", [None, "/usr/bin/c++"])
@pytest.mark.parametrize("has_headers", [False, True])
def test_what_is_missing_is_named_as_packages_to_install(
    compiler: str | None,
    has_headers: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("shutil.which", lambda _: compiler)
    monkeypatch.setattr("sysconfig.get_path", lambda _: str(tmp_path))
    if has_headers:
        (tmp_path / "Python.h").touch()
    assert check_ruckig.main() == (0 if compiler and has_headers else 1)
    said = capsys.readouterr()
    assert ("g++" in said.err) == (compiler is None)
    assert ("python3-dev" in said.err) == (not has_headers)
    assert ("compiles" in said.out) == bool(compiler and has_headers)


def test_a_machine_with_a_package_sees_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    monkeypatch.setattr("sys.version_info", (3, 12, 0))
    assert check_ruckig.main() == 0
    assert capsys.readouterr() == ("", "")
