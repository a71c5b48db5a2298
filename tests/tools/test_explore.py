"""Generated tests: the same examples in every company, new ones when they are explored, and what is said of them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from explore import Summary

pytestmark = pytest.mark.long

TESTS = Path(__file__).parents[1]
SOME = """
import json
import pytest
from hypothesis import example, given, settings, strategies as st

@settings(max_examples=30)
@given(st.integers(), st.floats(), st.text(max_size=5))
def test_drawn(a, b, c):
    with open("drawn", "a") as file:
        file.write(repr((a, b, c)))

@given(a=st.integers(), b=st.lists(st.booleans()))
def test_wrong(a, b):
    assert a < 1000

@pytest.mark.generated(1, 2)
@pytest.mark.parametrize("kind", ["x"])
def test_seeded(seed, kind):
    assert seed < 3

@pytest.mark.long
@pytest.mark.parametrize("case", range(10))
def test_long(case):
    with open("cases", "a") as file:
        file.write(str(case))

@pytest.mark.core
@pytest.mark.long
@pytest.mark.parametrize("case", range(4))
def test_core(case):
    with open("core", "a") as file:
        file.write(str(case))

def test_plain():
    raise AssertionError("it is not generated")
"""
CONSTANTS = "VALUES = [" + ", ".join(str(10_007 * n) for n in range(500)) + "]\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project of its own with generated tests, and a module full of constants that is local to it."""
    settings = f"[pytest]\npythonpath = {TESTS} .\nmarkers =\n  long\n  core\n"
    (tmp_path / "pytest.ini").write_text(settings, encoding="utf-8")
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["generated"]\n', encoding="utf-8")
    (tmp_path / "test_some.py").write_text(SOME, encoding="utf-8")
    (tmp_path / "many.py").write_text(CONSTANTS, encoding="utf-8")
    (tmp_path / "test_company.py").write_text("import many\ndef test_it(): pass\n", encoding="utf-8")
    return tmp_path


def pytest_in(folder: Path, *options: str) -> int:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    return subprocess.run(command, cwd=folder, stdout=subprocess.DEVNULL, timeout=500, check=False).returncode


def told(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "found").read_text(encoding="utf-8").splitlines()]


def test_a_test_has_the_same_examples_alone_and_in_company(folder: Path) -> None:
    drawn = []
    for company in ([], ["test_company.py"], ["test_company.py"]):
        assert pytest_in(folder, *company, "test_some.py", "-k", "it or drawn") == 0
        drawn.append((folder / "drawn").read_bytes())
        (folder / "drawn").unlink()
    assert drawn[0] == drawn[1] == drawn[2]


@pytest.mark.parametrize(("effort", "number"), [("1", 10), ("0.3", 3), ("0.01", 1)])
def test_with_less_effort_there_are_fewer_cases_of_what_is_long(folder: Path, effort: str, number: int) -> None:
    said = []
    for _ in range(2):
        assert pytest_in(folder, "--effort", effort, "-k", "long or core") == 0
        cases, core = (folder / "cases").read_text(), (folder / "core").read_text()
        assert (len(set(cases)), len(cases), core) == (number, number, "0123")
        said.append(cases)
        for name in ("cases", "core"):
            (folder / name).unlink()
    assert said[0] == said[1]


def test_with_less_effort_there_are_fewer_examples_and_seeds_and_the_same_at_every_run(folder: Path) -> None:
    drawn = []
    for effort in ("1", "0.1", "0.1"):
        assert pytest_in(folder, "--effort", effort, "--found", "found", "-k", "drawn or seeded and 2-") == 0
        drawn.append((folder / "drawn").read_bytes())
        (folder / "drawn").unlink()
    assert drawn[1] == drawn[2]
    assert 0 < len(drawn[1]) < len(drawn[0]) / 3
    assert pytest_in(folder, "--effort", "0.1", "-k", "seeded and 1-") == pytest.ExitCode.NO_TESTS_COLLECTED


def test_exploring_draws_anew_by_its_seed_and_keeps_what_it_finds(folder: Path) -> None:
    drawn = []
    for seed in (7, 7, 8):
        assert pytest_in(folder, "--explore", str(seed), "--effort", "2", "--found", "found") == 1
        drawn.append((folder / "drawn").read_bytes())
        (folder / "drawn").unlink()
    assert drawn[0] == drawn[1] != drawn[2]
    lines = told(folder)
    assert [line["tests"] for line in lines if "tests" in line] == [3, 3, 3]
    tried = [line["examples"] for line in lines if "drawn" in line.get("test", "")]
    assert tried == [60, 60, 60]
    seeds = [line["test"] for line in lines if "seeded" in line.get("test", "")]
    assert len(seeds) == 3 * 4  # twice as many as the test names
    assert len(set(seeds)) == 2 * 4
    first, again, _ = (line["examples"] for line in lines if "wrong" in line.get("test", ""))
    assert again <= 3 < first  # what was found is tried first


def test_what_was_found_is_told_with_the_line_that_keeps_it(folder: Path) -> None:
    assert pytest_in(folder, "--explore", "1", "--found", "found") == 1
    found = Summary.from_lines(told(folder))
    assert found.tests == 3
    assert found.examples["test_some.py::test_drawn"] == 30
    assert found.findings["test_some.py::test_wrong"]["keep"] == "@example(\n    a=1000,\n    b=[],\n)"
    assert found.findings["test_some.py::test_seeded"]["keep"].startswith("@pytest.mark.generated(…, ")
    said = "\n".join(found.lines())
    assert "found in test_some.py::test_wrong:\nAssertionError: assert 1000 < 1000" in said
    assert "2 findings" in said
    assert "test_plain" not in said
