"""What a commissioning has come to: kept in a file after every step, for programs and for people."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import msgspec
from msgspec import Struct
from trirail_drivers.errors import FileError

from trirail.commissioning.judgement import Changes, Judged, Verdict

Number = float | int | str | bool | None


class StepReport(Struct, frozen=True):
    """A step that was carried out, or left out."""

    step: str
    drive: str
    """A, B or C; "" where it is of all three."""
    verdict: Verdict
    words: tuple[str, ...]
    remedy: str
    measured: dict[str, Number]
    """Lengths in m, times in s, signed."""
    changes: dict[str, int | float]
    """Keys of the configuration and what they should have."""
    at: str
    """When it ended, by the wall clock (ISO 8601)."""


class CommissioningReport(Struct):
    """All steps in the order in which they were done; of one that was repeated the last counts."""

    robot: str
    config: str
    began: str
    simulated: bool
    software: str
    plan: tuple[tuple[str, str], ...] = ()
    """The steps that there are, each with its drive."""
    steps: list[StepReport] = []
    changes: dict[str, int | float] = {}
    """What the configuration should say otherwise, all steps together."""
    written: str | None = None
    """The configuration that was written."""

    @property
    def latest(self) -> dict[tuple[str, str], StepReport]:
        """Of each step the last time that it was done."""
        return {(entry.step, entry.drive): entry for entry in self.steps}

    @property
    def ok(self) -> bool:
        """Whether nothing was found wrong and nothing failed, of what was done."""
        return all(entry.verdict in ("ok", "skipped") for entry in self.latest.values())

    @property
    def complete(self) -> bool:
        """Whether every step was done and is as it should be."""
        return bool(self.steps) and not self.left

    @property
    def left(self) -> list[str]:
        """The steps that were not done, or are not as they should be."""
        latest = self.latest
        return [
            f"{step} {drive}".rstrip()
            for step, drive in self.plan or latest
            if (step, drive) not in latest or latest[step, drive].verdict != "ok"
        ]


class Keeper:
    """Keeps a report in a file of its own, and the same in words beside it."""

    def __init__(self, report: CommissioningReport, path: Path) -> None:
        """Raises FileError where there is such a file already, or none can be made."""
        self.report = report
        self.path = path
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            raise FileError(f"{path} exists already: name another file with --report") from None
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from error

    @property
    def text(self) -> Path:
        """The file for people."""
        return self.path.with_suffix(".txt")

    def add(self, step: str, drive: str, judged: Judged, measured: dict[str, Number]) -> None:
        """Note a step and write the file anew."""
        entry = StepReport(
            step, drive, judged.verdict, judged.words, judged.remedy, measured, dict(judged.changes), now()
        )
        self.report.steps.append(entry)
        self.save()

    def conclude(self, changes: Changes, written: Path | None) -> None:
        """Note what it has come to."""
        self.report.changes, self.report.written = dict(changes), None if written is None else str(written)
        self.save()

    def save(self) -> None:
        """Write both files; each is there whole, before and after."""
        _replace(self.path, msgspec.json.format(msgspec.json.encode(content(self.report)), indent=2).decode() + "\n")
        _replace(self.text, "\n".join(words(self.report)) + "\n")


def content(report: CommissioningReport) -> dict[str, object]:
    """Return a report as plain values, with what it comes to."""
    return {"ok": report.ok, "complete": report.complete, **msgspec.to_builtins(report)}


def words(report: CommissioningReport) -> list[str]:
    """Return a report as lines for people."""
    lines = [f"Commissioning of robot {report.robot}, {report.config}", f"begun {report.began}, {report.software}"]
    if report.simulated:
        lines.append("on simulated drives")
    for entry in report.steps:
        lines += ["", f"{entry.step} {entry.drive}".rstrip() + f": {entry.verdict}"]
        lines += [f"  {word}" for word in entry.words]
        if entry.remedy:
            lines.append(f"  remedy: {entry.remedy}")
    lines.append("")
    lines += [f"{key} should be {value:g}" for key, value in report.changes.items()]
    if report.written:
        lines.append(f"written to {report.written}")
    lines.append("everything is as it should be" if report.complete else f"not passed: {', '.join(report.left)}")
    return lines


def now() -> str:
    """Return the wall-clock time, to the second."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _replace(path: Path, text: str) -> None:
    beside = path.with_name(f".{path.name}.new")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error
