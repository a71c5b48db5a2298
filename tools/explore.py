"""Run the generated tests with new examples on every core until the time is over, and print the findings.

python tools/explore.py 30                      half an hour
python tools/explore.py 30 --only motion        tests whose name or file contains this
python tools/explore.py 5 --seed 7              the same examples as an earlier run, until the time is over

Each core repeats all tests in a different order, each time with twice as many examples and another seed. Findings are
printed at the end, with the lines that preserve them as examples of the tests. The next run tries the findings first.
The exit code is 1 if there are findings.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from interruption import interrupt_on_signals

ROOT = Path(__file__).parents[1]
NICE = 10
"""Nice value of the tests, which gives other programs on the machine precedence."""
TIMEOUT = 600
"""Time limit of a test with its usual number of examples, including the simplification of its findings [s]."""
REPORT_PERIOD_S = 30.0
"""Interval of progress messages [s]."""
GRACE = 20.0
"""Time limit for a test to clean up [s]."""


class Summary(NamedTuple):
    """Numbers of tests and of tried examples, and the findings up to now."""

    tests: int
    """Number of tests."""
    examples: Counter[str]
    """Number of examples by test."""
    findings: dict[str, dict[str, str]]
    """First error of each failed test, and the line that preserves the example."""

    @classmethod
    def from_lines(cls, lines: Sequence[dict[str, Any]]) -> Summary:
        """Return a summary of the output of all rounds."""
        examples: Counter[str] = Counter()
        findings: dict[str, dict[str, str]] = {}
        for line in lines:
            if "test" in line:
                test = line["test"].partition("[")[0]
                examples[test] += line["examples"] if line["outcome"] != "skipped" else 0
                if line["outcome"] == "failed":
                    findings.setdefault(test, {"error": line["error"], "keep": line["keep"]})
        return cls(max((line.get("tests", 0) for line in lines), default=0), examples, findings)

    def __str__(self) -> str:
        tried = sum(count > 0 for count in self.examples.values())
        return f"{self.examples.total():,} examples of {tried} of {self.tests} tests, {len(self.findings)} findings"

    def lines(self) -> Iterator[str]:
        """Yield the summary as text, line by line."""
        for test, count in sorted(self.examples.items()):
            yield f"{count:10,}  {test}"
        for test, finding in self.findings.items():
            yield f"\nfound in {test}:\n{finding['error']}\nto keep it, write above the test:\n{finding['keep']}"
        yield f"\n{self}"


class Core:
    """Rounds of the generated tests on one core, each in a separate process."""

    def __init__(self, folder: Path, number: int, seed: int, only: str) -> None:
        self.found = folder / f"{number}.jsonl"
        self._log = folder / f"{number}.log"
        self._chance = random.Random(f"{seed} {number}")
        self._only = only
        self._effort = 1
        self._begin()

    def _begin(self) -> None:
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-k", self._only, f"--found={self.found}"]
        command += [f"--explore={self._chance.randrange(2**32)}", f"--effort={self._effort}"]
        command += [f"--timeout={TIMEOUT * self._effort}"]
        with self._log.open("wb") as log:  # only this program handles Ctrl-C, and then ends the rounds
            self._process = subprocess.Popen(
                ["nice", "-n", str(NICE), *command], cwd=ROOT, stdout=log, stderr=log, start_new_session=True
            )

    def continue_rounds(self) -> str | None:
        """Start the next round if the last round has ended; return a reason if no further round can start."""
        code = self._process.poll()
        if code is None:
            return None
        if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            return f"pytest has ended with {code}:\n{self._log.read_text(encoding='utf-8')[-3000:]}"
        self._effort *= 2
        self._begin()
        return None

    def interrupt(self) -> None:
        """Interrupt the running test, which then cleans up."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGINT)

    def end(self) -> None:
        """Wait until the round has ended, and kill its processes after a time limit."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def lines(self) -> list[dict[str, Any]]:
        """Return the output of all rounds, except for an incomplete last line."""
        if not self.found.exists():
            return []
        whole = self.found.read_text(encoding="utf-8").rpartition("\n")[0]
        return [json.loads(line) for line in whole.splitlines()]


def explore(cores: Sequence[Core], seconds: float) -> str | None:
    """Run for the given time [s] and report the progress; return the reason for an early end, "" for an interrupt."""
    begun = reported_at = time.monotonic()
    trouble = None
    try:
        while trouble is None and time.monotonic() - begun < seconds:
            time.sleep(0.2)
            trouble = next(filter(None, (core.continue_rounds() for core in cores)), None)
            if time.monotonic() - reported_at >= REPORT_PERIOD_S:
                reported_at = time.monotonic()
                gone = reported_at - begun
                print(f"{gone / 60:.1f} of {seconds / 60:g} min: {summary(cores)}", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        trouble = ""
    for core in cores:
        core.interrupt()
    for core in cores:
        core.end()
    return trouble


def summary(cores: Sequence[Core]) -> Summary:
    """Return the summary of all cores."""
    return Summary.from_lines([line for core in cores for line in core.lines()])


def main() -> int:
    """Explore for the requested time; print the summary or, with --json, one JSON object; return the exit code."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("minutes", type=float)
    arguments.add_argument("--only", default="", help="tests whose name or file contains this, as pytest -k has it")
    arguments.add_argument("--seed", type=int, help="seed of the examples; random if absent")
    arguments.add_argument("--json", action="store_true", help="print one JSON object")
    options = arguments.parse_args()
    interrupt_on_signals()
    seed = random.SystemRandom().randrange(2**32) if options.seed is None else options.seed
    with tempfile.TemporaryDirectory(prefix="trirail-explore-") as folder:
        cores = [Core(Path(folder), number, seed, options.only) for number in range(os.cpu_count() or 1)]
        trouble = explore(cores, 60.0 * options.minutes)
        result = summary(cores)
    if trouble:
        print(f"explore: {trouble}", file=sys.stderr)
        return 2
    if options.json:
        content = {"seed": seed, "tests": result.tests, "examples": result.examples, "findings": result.findings}
        print(json.dumps(content | {"interrupted": trouble is not None}))
    else:
        print("\n".join(result.lines()) + f"; --seed {seed}" + ("; interrupted" if trouble is not None else ""))
    return 130 if trouble is not None else int(bool(result.findings))


if __name__ == "__main__":
    sys.exit(main())
