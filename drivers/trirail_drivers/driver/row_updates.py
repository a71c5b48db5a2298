"""Updates of one drive's row that every cycle makes, written once for both ways in which cycles run.

Drivers call these functions with an AxisRow. Quiet cycles compile the same functions and call them with a row of an
array of AXIS; see trirail_drivers.driver.cyclic. A function may therefore use only the fields of AxisRow and
arithmetic, and call no other function.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from trirail_drivers.driver.axis_row import AxisRow


def count_sync(row: AxisRow) -> None:
    """Count a SYNC that was sent."""
    row.syncs += 1
    row.between = False
    row.command_age += 1


def end_reading(row: AxisRow) -> None:
    """Record that this cycle's frames have been read: a position that arrives later is a late answer."""
    row.between, row.came = True, False


def answered_sync(row: AxisRow) -> int:
    """Return the number of the SYNC that a position received now answers; see trirail_drivers.driver.axis.Answers."""
    return row.syncs - (not row.between and not row.prompt and row.sampled < row.syncs - 1)


def is_late(row: AxisRow, sampled: int) -> bool:
    """Whether a position that answers the SYNC `sampled` is later in its cycle than the answer before.

    A drive that always answers after the read is not late.
    """
    return row.prompt and row.between and sampled > row.sampled


def accept_answer(row: AxisRow, sampled: int) -> None:
    """Store that a position has arrived which answers the SYNC `sampled`."""
    row.came, row.prompt = True, not row.between and sampled == row.syncs
    row.sampled = sampled


def accept_counts(row: AxisRow, counts: int, now: float) -> None:
    """Store a received position [counts]; `now` is the time of reception [s]."""
    if abs(counts - row.stands_at) > row.still:
        row.stands_at, row.stands_since = counts, now
    row.stands_since = min(row.stands_since, now)
    if counts != row.newest:
        row.step = counts - row.newest
    row.newest, row.actual = counts, counts
    row.position = counts / row.counts_per_metre + row.zero


def accept_turns(row: AxisRow, turns: float) -> None:
    """Store a received position [turns]."""
    row.position = turns / row.counts_per_metre + row.zero
