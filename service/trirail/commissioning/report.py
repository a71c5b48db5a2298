"""Report of a commissioning, which is saved after every step, as JSON for programs and as text for people."""

from __future__ import annotations

import contextlib
import datetime
from pathlib import Path

import msgspec
from msgspec import Struct
from trirail_drivers import files
from trirail_drivers.errors import FileError

from trirail.commissioning.judgement import Changes, Judgement, Verdict

Number = float | int | str | bool | None


class StepReport(Struct, frozen=True):
    """Entry in the report for a step that was run or skipped."""

    step: str
    drive: str
    """Drive A, B or C; "" for a step with all three drives."""
    verdict: Verdict
    words: tuple[str, ...]
    remedy: str
    measured: dict[str, Number]
    """Measured values by name; lengths are signed [m], and times are in [s]."""
    changes: dict[str, int | float]
    """Proposed new values of configuration keys."""
    at: str
    """Wall-clock time at the end of the step (ISO 8601)."""


class CommissioningReport(Struct):
    """Report of all steps, in the order in which they were run. If a step was repeated, its last run counts."""

    robot: str
    config: str
    began: str
    simulated: bool
    software: str
    plan: tuple[tuple[str, str], ...] = ()
    """All steps of the guide, each with its drive."""
    steps: list[StepReport] = []
    changes: dict[str, int | float] = {}
    """Proposed new values of configuration keys, merged from all steps."""
    written: str | None = None
    """Path of the corrected configuration; None if no corrected configuration was written."""

    @property
    def latest(self) -> dict[tuple[str, str], StepReport]:
        """Entry for the last run of each step, by the step's name and drive."""
        return {(entry.step, entry.drive): entry for entry in self.steps}

    @property
    def ok(self) -> bool:
        """True if every step of the guide was run or skipped, and all that were run, at least one, are ok."""
        verdicts = {entry.verdict for entry in self.latest.values()}
        return "ok" in verdicts and verdicts <= {"ok", "skipped"} and self.latest.keys() >= set(self.plan)

    @property
    def complete(self) -> bool:
        """True if all steps of the guide were run and are ok."""
        return bool(self.steps) and not self.incomplete

    @property
    def incomplete(self) -> list[str]:
        """Names of the steps that were not run or are not ok."""
        latest = self.latest
        return [
            f"{step} {drive}".rstrip()
            for step, drive in self.plan or latest
            if (step, drive) not in latest or latest[step, drive].verdict != "ok"
        ]


class ReportFile:
    """JSON file of a report, and a text file for people in the same folder."""

    def __init__(self, report: CommissioningReport, path: Path) -> None:
        """Create the JSON file at `path`. Raises FileError if one of the files exists or cannot be created."""
        self.report = report
        self.path = path
        self._is_saved = False
        if path == self.text_path:
            raise FileError(f"{path} is the name of the text version; choose another one with --report, as report.json")
        for file in (path, self.text_path):
            if file.exists():
                raise FileError(f"{file} already exists; choose another file with --report")
        try:
            path.touch(exist_ok=False)
        except OSError as error:
            raise FileError(f"{path}: {error.strerror}") from error

    @property
    def text_path(self) -> Path:
        """Path of the text file."""
        return self.path.with_suffix(".txt")

    @property
    def is_saved(self) -> bool:
        """True if the report has been saved at least once."""
        return self._is_saved

    def remove_if_empty(self) -> None:
        """Remove the JSON file if no report has been saved, so that the same command can be run again."""
        if not self._is_saved:
            with contextlib.suppress(OSError):
                self.path.unlink()

    def add(self, step: str, drive: str, judgement: Judgement, measured: dict[str, Number]) -> None:
        """Add an entry for a step, and save the report."""
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
        """Write both files; each file is replaced atomically."""
        _replace(self.path, msgspec.json.format(msgspec.json.encode(content(self.report)), indent=2).decode() + "\n")
        self._is_saved = True
        _replace(self.text_path, "\n".join(format_lines(self.report)) + "\n")


def content(report: CommissioningReport) -> dict[str, object]:
    """Return the content of a report as built-in types, with the overall results `ok` and `complete`."""
    return {"ok": report.ok, "complete": report.complete, **msgspec.to_builtins(report)}


def format_lines(report: CommissioningReport) -> list[str]:
    """Return the lines of a report for people."""
    lines = [f"Commissioning of robot {report.robot}, {report.config}", f"started {report.began}, {report.software}"]
    if report.simulated:
        lines.append("simulated drives")
    for entry in report.steps:
        lines += ["", f"{entry.step} {entry.drive}".rstrip() + f": {entry.verdict}"]
        lines += [f"  {word}" for word in entry.words]
        if entry.remedy:
            lines.append(f"  remedy: {entry.remedy}")
    lines.append("")
    lines += [f"{key} should be {value:.10g}" for key, value in report.changes.items()]
    if report.written:
        lines.append(f"written to {report.written}")
    lines.append("all steps passed" if report.complete else f"not passed: {', '.join(report.incomplete)}")
    return lines


def now() -> str:
    """Return the local date and time (ISO 8601), to the second."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _replace(path: Path, text: str) -> None:
    try:
        files.replace(path, text.encode())
    except OSError as error:
        raise FileError(f"{path}: {error.strerror}") from error
