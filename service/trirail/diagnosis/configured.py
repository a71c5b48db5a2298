"""Every check of a configuration, and a file with all that is wrong in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trirail_drivers.errors import shortened

from trirail.config import Config, Mistake, overlap
from trirail.diagnosis import contradictions, dial_gauge, drive_checks, stopping, times
from trirail.diagnosis.check import Check

JUDGEMENTS = (
    *dial_gauge.JUDGEMENTS,
    *stopping.JUDGEMENTS,
    *contradictions.JUDGEMENTS,
    *times.JUDGEMENTS,
    *drive_checks.JUDGEMENTS,
)


def diagnose(config: Config, impossible: Sequence[str] = ()) -> list[Check]:
    """Return what every check finds that reads no `impossible` key."""
    return [check for each in JUDGEMENTS if not overlap(each.reads, impossible) for check in each.of(config)]


def failed_checks(path: Path, mistakes: Sequence[Mistake]) -> list[Check]:
    """Return each mistake of a file as a check that failed."""
    return [
        Check("configuration", "failure", shortened(f"{path}: {text}"), key=shortened(key)) for key, text in mistakes
    ]
