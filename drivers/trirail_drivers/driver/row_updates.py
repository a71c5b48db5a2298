"""Updates of one drive's row and of its frames that every cycle makes, written once for both ways in which cycles run.

Drivers call these functions with an AxisRow. Compiled cycles compile the same functions and call them with a row of an
array of AXIS; see trirail_drivers.driver.cyclic. A function may therefore use only the fields of AxisRow, arrays and
arithmetic, and call no other function of this file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from trirail_drivers.driver.axis_row import NO_OFFSET
from trirail_drivers.driver.scaling import FLOAT32_MAX, INT32_MAX

OUTPUT_REPEATS = 2
"""Number of cycles in which the frame of changed outputs is sent again."""

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


def unanswered(row: AxisRow) -> int:
    """Return the number of unanswered SYNCs. The newest SYNC is not counted while its answer is not yet due."""
    return row.syncs - row.sampled - (not row.prompt)


def accept_answer(row: AxisRow, sampled: int) -> None:
    """Store that a position has arrived which answers the SYNC `sampled`, and count answers that are late or lost."""
    row.lost += max(0, sampled - row.sampled - 1)
    row.late += row.prompt and row.between and sampled > row.sampled  # a drive that always answers later is not late
    row.came, row.prompt = True, not row.between and sampled == row.syncs
    row.sampled = sampled


def turns_back(row: AxisRow, place: float) -> bool:
    """Whether a received position in drive units lies in the opposite direction to the last step."""
    return (place < row.newest and row.step > 0) or (place > row.newest and row.step < 0)


def is_far(row: AxisRow, place: float) -> bool:
    """Whether a received position in drive units and the one before it must come from two sliders, if no SYNC is
    between.
    """
    return abs(place - row.newest) > row.far_apart


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
    if turns != row.newest:
        row.step = turns - row.newest
    row.newest = turns
    row.position = turns / row.counts_per_metre + row.zero


def accept_statusword(row: AxisRow, statusword: int, now: float) -> None:
    """Store a received statusword; `now` is the time of reception [s]."""
    row.statusword, row.status_heard = statusword, now


def due_setpoint(row: AxisRow, commanded: NDArray[np.float64]) -> float:
    """Return the position that was commanded at the SYNC at which the newest position was sampled [m], or NaN.

    Parameters
    ----------
    commanded : (n,)
        Positions commanded at each SYNC [m]; SYNC k is at k % n. A drive whose position is older is compared with the
        oldest.

    """
    age = min(row.syncs - row.sampled, len(commanded) - 1)
    return float(commanded[(row.syncs - age) % len(commanded)])


def scale_setpoint(row: AxisRow, position: float, velocity: float) -> bool:
    """Store a setpoint [m], [m/s] in drive units. Return False, and store nothing, if its frame cannot contain it."""
    target, offset = row.counts_per_metre * (position - row.zero), 0.0
    if not row.floats:
        target = np.rint(target)
    if row.velocity_at != NO_OFFSET:
        offset = np.rint(row.velocity_per_metre * velocity / row.velocity_step)
    fits = abs(target) <= FLOAT32_MAX if row.floats else -INT32_MAX - 1 <= target <= INT32_MAX
    half = 1 << (8 * row.velocity_bytes - 1)
    if not fits or not -half <= offset < half:
        return False
    row.target, row.offset = target, int(offset)
    return True


def put_setpoint(row: AxisRow, data: NDArray[np.uint8]) -> None:
    """Write the stored setpoint, and the controlword if it is in the same frame, into the data of the frame."""
    at = row.position_at
    if row.floats:
        data[at : at + 4].view(np.float32)[0] = row.target
    else:
        for i in range(4):
            data[at + i] = int(row.target) >> 8 * i & 0xFF
    if row.velocity_at != NO_OFFSET:
        for i in range(row.velocity_bytes):
            data[row.velocity_at + i] = row.offset >> 8 * i & 0xFF
    if row.controlword_at != NO_OFFSET:
        for i in range(2):
            data[row.controlword_at + i] = row.controlword >> 8 * i & 0xFF


def outputs_pending(row: AxisRow) -> bool:
    """Whether the wanted outputs differ from the outputs sent last, must be repeated, or have not been sent yet."""
    return row.has_outputs and (row.outputs != row.outputs_sent or row.outputs_repeats > 0)


def put_outputs(row: AxisRow, data: NDArray[np.uint8]) -> None:
    """Write the wanted outputs into the data of their frame, beside the outputs that the robot does not use."""
    for i in range(4):
        data[i] = (row.outputs | row.outputs_kept) >> 8 * i & 0xFF


def note_outputs(row: AxisRow) -> None:
    """Record that the bus has accepted a frame with the wanted outputs. No answer shows whether the drive got it, but a
    drive that does not answer SYNCs has probably missed it.
    """
    silent = row.syncs - row.sampled > 1  # some drives answer the newest SYNC after this function is called
    row.outputs_repeats = OUTPUT_REPEATS if silent or row.outputs != row.outputs_sent else row.outputs_repeats - 1
    row.outputs_sent = row.outputs
