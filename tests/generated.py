"""Generated tests: the same examples at every run, and ever new ones with --explore, for tools/explore.py.

Hypothesis tests are generated, and so are those that draw from a seed: @pytest.mark.generated(0, 1, 2) on a test with
an argument `seed` has it run with each of these, or with as many fresh ones. What exploring finds stays: as @example(…)
of a hypothesis test, as one more seed of the others. --effort=0.1 tries a tenth of the examples, of the seeds and
of the cases of each test, for `make test`: also these are the same at every run.
"""

from __future__ import annotations

import functools
import json
import random
import re
import zlib
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any

import pytest
from _pytest.mark import ParameterSet
from hypothesis import HealthCheck, Phase, is_hypothesis_test, seed, settings
from hypothesis.database import DirectoryBasedExampleDatabase
from hypothesis.internal.conjecture import providers

# How fast this machine is, or how many random robots are thrown away, says nothing of the code.
CHECKS = [HealthCheck.too_slow, HealthCheck.filter_too_much]
EXAMPLES = ".explore"
"""The folder of the checkout where what was found is kept from run to run: it is tried first."""

settings.register_profile("gate", deadline=None, derandomize=True, database=None, suppress_health_check=CHECKS)
settings.load_profile("gate")

FEWEST = 3
"""So many examples are tried, however little effort is asked for."""

RUNS = pytest.StashKey[int]()
"""How often the body of a test has run."""


def thinned(cases: Iterable[Any], every: int = 2) -> list[ParameterSet]:
    """Of the cases of a test, `make test` has one of so many, from the first on; `make test-all` has them all."""
    each = (case if type(case) is tuple else (case,) for case in cases)
    return [pytest.param(*case, marks=pytest.mark.long if number % every else ()) for number, case in enumerate(each)]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of tools/explore.py."""
    group = parser.getgroup("generated tests")
    group.addoption("--explore", type=int, metavar="SEED", help="generated tests alone, with new examples by this seed")
    group.addoption("--effort", type=float, default=1.0, metavar="X", help="so many times the examples and the seeds")
    group.addoption("--found", type=Path, metavar="FILE", help="add a line of JSON for each test to this file")


def pytest_configure(config: pytest.Config) -> None:
    """Choose how examples come about before the first test is read."""
    config.addinivalue_line("markers", "generated(*seeds): drawn from `seed`: these, or fresh ones with --explore")
    if config.getoption("explore") is None:
        # Hypothesis draws some values from the constants of all modules that happen to be loaded: a test would have
        # other examples alone than in company.
        fixed = pytest.MonkeyPatch()
        fixed.setattr(providers, "_get_local_constants", lambda: providers._local_constants)
        config.add_cleanup(fixed.undo)
    else:
        settings.register_profile(
            "explore",
            deadline=None,
            derandomize=False,
            database=DirectoryBasedExampleDatabase(config.rootpath / EXAMPLES),
            suppress_health_check=CHECKS,
            phases=[Phase.explicit, Phase.reuse, Phase.generate, Phase.target, Phase.shrink],
            report_multiple_bugs=False,
        )
        settings.load_profile("explore")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give a test that draws from a seed those that it names, or fresh ones."""
    marker = metafunc.definition.get_closest_marker("generated")
    if marker is None or not marker.args:
        return
    explore, effort = metafunc.config.getoption("explore"), metafunc.config.getoption("effort")
    number = max(1, round(len(marker.args) * effort))
    seeds = list(marker.args[-number:])  # those that exploring has found stand last
    if explore is not None:
        chance = random.Random(f"{explore} {metafunc.definition.nodeid}")
        seeds = [chance.randrange(2**32) for _ in range(number)]
    metafunc.parametrize("seed", seeds)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Set how many examples are tried; if these are explored, leave what is generated, in an order of its own."""
    explore, effort = config.getoption("explore"), config.getoption("effort")
    if effort != 1.0:
        for test in {_function(item) for item in items if _hypothesis(item)}:
            given = test._hypothesis_internal_use_settings
            examples = max(min(FEWEST, given.max_examples), round(given.max_examples * effort))
            test._hypothesis_internal_use_settings = settings(given, max_examples=examples)
        _thin(config, items)
    if explore is None:
        return
    kept = [item for item in items if _hypothesis(item) or item.get_closest_marker("generated")]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    random.Random(explore).shuffle(kept)
    items[:] = kept
    _note(config, {"tests": len({item.nodeid.partition("[")[0] for item in kept})})


def _thin(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out all but a share of the cases of each test; keep one at least of a long test and for each seed of a
    generated one, and two of any other.
    """
    cases: dict[tuple[str, int, Any], list[pytest.Item]] = {}
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        if marks.isdisjoint({"core", "alone", "vcan"}):
            fewest = 1 if marks & {"long", "generated"} else 2
            seed = item.callspec.params.get("seed") if hasattr(item, "callspec") else None
            cases.setdefault((item.nodeid.partition("[")[0], fewest, seed), []).append(item)
    effort, left_out = config.getoption("effort"), []
    for (_, fewest, _), each in cases.items():
        each.sort(key=lambda item: zlib.crc32(item.nodeid.encode()))  # no order of theirs, and the same at every run
        left_out += each[max(fewest, round(len(each) * effort)) :]
    config.hook.pytest_deselected(items=left_out)
    gone = set(left_out)
    items[:] = [item for item in items if item not in gone]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Have a hypothesis test that is explored draw new examples, and count them."""
    item.stash[RUNS] = 0
    if item.config.getoption("explore") is None or not _hypothesis(item):
        return
    test = _function(item)
    test.hypothesis.inner_test = _counted(item, test.hypothesis.inner_test)
    given = test._hypothesis_internal_use_settings
    seed(item.config.getoption("explore"))(test)  # without a database, but for the next line
    test._hypothesis_internal_use_settings = given


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note how it went."""
    report = yield
    if report.when == "call" or report.outcome != "passed":
        line: dict[str, Any] = {"test": item.nodeid, "examples": item.stash[RUNS] or 1, "outcome": report.outcome}
        if report.outcome == "failed" and call.excinfo is not None:
            drawn = item.callspec.params.get("seed") if hasattr(item, "callspec") else None
            line |= finding(call.excinfo.value, drawn)
        _note(item.config, line)
    return report


def _note(config: pytest.Config, line: dict[str, Any]) -> None:
    file: Path | None = config.getoption("found")
    if file is not None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(line) + "\n")


def finding(error: BaseException, drawn: int | None) -> dict[str, str]:
    """Return what was found, and what is to be written above the test so that it stays."""
    noted = "\n".join(getattr(error, "__notes__", ()))
    example = re.search(r"^Fail.*?: \w+(\(.*?^\))", noted, re.MULTILINE | re.DOTALL)  # Failing test case: test_x(…)
    keep = f"@example{example[1]}" if example else f"@pytest.mark.generated(…, {drawn})" if drawn is not None else noted
    return {"error": f"{type(error).__name__}: {error}"[:2000], "keep": keep}


def _hypothesis(item: pytest.Item) -> bool:
    return isinstance(item, pytest.Function) and is_hypothesis_test(item.obj)


def _function(item: pytest.Item) -> Any:
    assert isinstance(item, pytest.Function)
    return getattr(item.obj, "__func__", item.obj)


def _counted(item: pytest.Item, body: Callable[..., object]) -> Callable[..., object]:
    @functools.wraps(body)
    def run(*args: object, **kwargs: object) -> object:
        item.stash[RUNS] += 1
        return body(*args, **kwargs)

    return run
