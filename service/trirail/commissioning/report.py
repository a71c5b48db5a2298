"""Report of a commissioning. It is saved after every step, as JSON for programs and as text for people."""

from __future__ import annotations

import datetime
import os
from pathlib import Path

import msgspec
from msgspec import Struct
from trirail_drivers.errors import FileError

from trirail.commissioning.judgement import Changes, Judgement, Verdict

Number = float | int | str | bool | None


class StepReport(Struct, frozen=True):
    """Entry for a step that was carried out or skipped."""

    step: str
    drive: str
    """Drive A, B or C; "" for a step with all three drives."""
    verdict: Verdict
    words: tuple[str, ...]
    remedy: str
    measured: dict[str, Number]
    """Measured lengths [m] and times [s], with sign."""
    changes: dict[str, int | float]
    """Proposed values of configuration keys."""
    at: str
    """Wall-clock time at the end of the step (ISO 8601)."""


class CommissioningReport(Struct):
    """Report of all steps in the order in which they were run. The last run of a repeated step counts."""

    robot: str
    config: str
    began: str
    simulated: bool
    software: str
    plan: tuple[tuple[str, str], ...] = ()
    """All steps of the guide, each with its drive."""
    steps: list[StepReport] = []
    changes: dict[str, int | float] = {}
    """Proposed values of configuration keys, from all steps together."""
    written: str | None = None
    """Path of the corrected configuration."""

    @property
    def latest(self) -> dict[tuple[str, str], StepReport]:
        """Last run of each step."""
        return {(entry.step, entry.drive): entry for entry in self.steps}

    @property
    def ok(self) -> bool:
        """True if no step that was run found a defect or failed."""
        return all(entry.verdict in ("ok", "skipped") for entry in self.latest.values())

    @property
    def complete(self) -> bool:
        """True if every step was run and is ok."""
        return bool(self.steps) and not self.incomplete

    @property
    def incomplete(self) -> list[str]:
        """Steps that were not run, or are not ok."""
        latest = self.latest
        return [
            f"{step} {drive}".rstrip()
            for step, drive in self.plan or latest
            if (step, drive) not in latest or latest[step, drive].verdict != "ok"
        ]


class ReportFile:
    """A report's JSON file, and the text file for people beside it."""

    def __init__(self, report: CommissioningReport, path: Path) -> None:
        """Create the report files. Raises FileError if the file exists or cannot be created."""
        self.report = report
        self.path = path
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            raise FileError(f"{path} already exists; choose another file with --report") from None
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from error

    @property
    def text_path(self) -> Path:
        """Path of the text file."""
        return self.path.with_suffix(".txt")

    def add(self, step: str, drive: str, judgement: Judgement, measured: dict[str, Number]) -> None:
        """Add a step and save the report."""
        entry = StepReport(
            step, drive, judgement.verdict, judgement.words, judgement.remedy, measured, dict(judgement.changes), now()
        )
        self.report.steps.append(entry)
        self.save()

    def conclude(self, changes: Changes, written: Path | None) -> None:
        """Set the proposed changes and the path of the corrected configuration, and save the report."""
        self.report.changes, self.report.written = dict(changes), None if written is None else str(written)
        self.save()

    def save(self) -> None:
        """Replace both files, each atomically."""
        _replace(self.path, msgspec.json.format(msgspec.json.encode(content(self.report)), indent=2).decode() + "\n")
        _replace(self.text_path, "\n".join(format_lines(self.report)) + "\n")


def content(report: CommissioningReport) -> dict[str, object]:
    """Return a report as plain values, with its overall result."""
    return {"ok": report.ok, "complete": report.complete, **msgspec.to_builtins(report)}


def format_lines(report: CommissioningReport) -> list[str]:
    """Return a report as human-readable lines."""
    lines = [f"Commissioning of robot {report.robot}, {report.config}", f"started {report.began}, {report.software}"]
    if report.simulated:
        lines.append("simulated drives")
    for entry in report.steps:
        lines += ["", f"{entry.step} {entry.drive}".rstrip() + f": {entry.verdict}"]
        lines += [f"  {word}" for word in entry.words]
        if entry.remedy:
            lines.append(f"  remedy: {entry.remedy}")
    lines.append("")
    lines += [f"{key} should be {value:g}" for key, value in report.changes.items()]
    if report.written:
        lines.append(f"written to {report.written}")
    lines.append("all steps passed" if report.complete else f"not passed: {', '.join(report.incomplete)}")
    return lines


def now() -> str:
    """Return the wall-clock time, to the second."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error
