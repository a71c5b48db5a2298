"""Every check of a configuration, and a file with all that is wrong in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from trirail_drivers.errors import shortened

from trirail.config import Config, Findings, overlap
from trirail.diagnosis import drives, limits, stopping, times
from trirail.diagnosis.check import Check

JUDGEMENTS = (*stopping.JUDGEMENTS, *limits.JUDGEMENTS, *times.JUDGEMENTS, *drives.JUDGEMENTS)


def diagnose(config: Config, impossible: Sequence[str] = ()) -> list[Check]:
    """Return what every check finds that reads no `impossible` key."""
    return [check for each in JUDGEMENTS if not overlap(each.reads, impossible) for check in each.of(config)]


def examined(path: Path, found: Findings) -> list[Check]:
    """Return each mistake of a file, and what the checks find that can do without what is impossible."""
    wrong = [mistake.key for mistake in found.mistakes]
    checks = []
    for key, text in found.mistakes:
        checks.append(Check("configuration", "failure", shortened(f"{path}: {text}"), key=shortened(key)))
    checks += diagnose(found.config, wrong)
    if wrong:
        said = "the machine, and what depends on the above, is looked at once that is right"
        checks.append(Check("the rest", "warning", said, "correct it, and ask again"))
    return checks
