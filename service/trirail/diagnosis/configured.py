"""Function that runs all checks of a configuration, and conversion of errors in a file to failed checks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trirail_drivers.errors import shortened

from trirail.config import Config, Mistake, overlap
from trirail.diagnosis import contradictions, dial_gauge, drive_checks, stopping, times
from trirail.diagnosis.check import Check

CONFIG_CHECKS = (
    *dial_gauge.CONFIG_CHECKS,
    *stopping.CONFIG_CHECKS,
    *contradictions.CONFIG_CHECKS,
    *times.CONFIG_CHECKS,
    *drive_checks.CONFIG_CHECKS,
)


def diagnose(config: Config, impossible: Sequence[str] = ()) -> list[Check]:
    """Run all checks that do not depend on `impossible` keys, which have impossible values; return the results."""
    return [check for each in CONFIG_CHECKS if not overlap(each.reads, impossible) for check in each.run(config)]


def failed_checks(path: Path, mistakes: Sequence[Mistake]) -> list[Check]:
    """Return a failed check for each error in a configuration file."""
    return [
        Check("configuration", "failure", shortened(f"{path}: {text}"), key=shortened(key)) for key, text in mistakes
    ]
