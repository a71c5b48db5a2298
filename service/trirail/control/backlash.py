"""Compensation of backlash where a slider reverses; compiled, one cycle at a time.

A slider with backlash lags its motor by half the width. The setpoints are therefore the sliders' positions plus an
offset of half a width in the direction in which the slider last moved, and a slider's position is the drive's
measurement less the offset. The offset changes sides by trirail.motion.backlash_reserve, one change at a time: a slider
that reverses again during a change waits for its end, and after two reversals it goes to the other side first, since it
may have been left anywhere in its backlash. While the last direction of a slider is unknown, as after power-on, its
offset is zero.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.motion.backlash_reserve import TakeUp

__all__ = ["BACKLASH", "KEPT", "TURNS", "add_offset", "backlash", "due_offset", "keep_offset", "let_go", "taking_up"]

TURNS = 5e-7
"""Least distance of a reversal [m]: compensating less has no benefit, and wears the drive."""
KEPT = 5
"""Number of newest setpoints whose offsets are kept, for trirail.control.feedback."""

BACKLASH = np.dtype(
    [
        ("half", "<f8", 3),  # of the backlash [m]
        ("step", "<f8"),  # share of the take-up that is done in a cycle; zero without backlash
        ("period", "<f8"),  # of a cycle [s]
        ("offset", "<f8", 3),  # in the newest setpoints [m]
        ("begin", "<f8", 3),  # offset at the begin and at the end of the change [m]
        ("end", "<f8", 3),
        ("done", "<f8", 3),  # share of the change that is done; one when complete
        ("turns", "<i8", 3),  # reversals of a slider since the change began
        ("heading", "<f8", 3),  # direction in which a slider last moved: 1 or -1; 0 while unknown
        ("farthest", "<f8", 3),  # farthest position in that direction [m]; NaN before the first command
        ("offsets", "<f8", (KEPT, 3)),  # in the setpoints of the cycles before, the newest last
    ],
    align=True,
)
"""State of the compensation between cycles, for compiled code."""


def backlash(taken: TakeUp, period: float) -> NDArray[np.void]:
    """Return the state, (2,): the current one, and the tried one."""
    kept = np.zeros(2, BACKLASH)
    kept["half"] = np.array(taken.widths) / 2.0
    kept["step"] = 1.0 / math.ceil(taken.duration / period) if taken.duration > 0.0 else 0.0
    kept["period"] = period
    kept["done"], kept["farthest"] = 1.0, math.nan
    return kept


@compiled()
def add_offset(kept: NDArray[np.void], sliders: Array) -> None:
    """Add to solved sliders (6, 3), rows lambda_10, v_10, gamma_10, the offset of the next cycle; write it to kept[1].

    Another call without `kept[0] = kept[1]` in between begins from the same state.
    """
    if kept[0].step == 0.0:
        return
    kept[1] = kept[0]
    tried = kept[1]
    for i in range(3):
        place, heading, farthest = sliders[0, i], tried.heading[i], tried.farthest[i]
        if math.isnan(farthest) or (heading != 0.0 and (place - farthest) * heading >= 0.0):
            tried.farthest[i] = place
        elif abs(place - farthest) > TURNS:
            tried.heading[i] = math.copysign(1.0, place - farthest)
            tried.farthest[i] = place
            tried.turns[i] += 1
        if tried.done[i] < 1.0:
            tried.done[i] = min(1.0, tried.done[i] + tried.step)
            u, way, rate = tried.done[i], tried.end[i] - tried.begin[i], tried.step / tried.period
            tried.offset[i] = tried.begin[i] + way * u * u * u * (10.0 + u * (6.0 * u - 15.0))
            sliders[1, i] += way * rate * 30.0 * u * u * (1.0 - u) * (1.0 - u)
            sliders[2, i] += way * rate * rate * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u)
        sliders[0, i] += tried.offset[i]
        side = tried.heading[i] * tried.half[i]
        if side != 0.0 and tried.done[i] >= 1.0 and (tried.turns[i] > 0 or tried.end[i] != side):
            tried.begin[i], tried.end[i] = tried.end[i], side if tried.end[i] != side else -side
            tried.done[i], tried.turns[i] = 0.0, 0


@compiled()
def taking_up(kept: NDArray[np.void]) -> bool:
    """Whether backlash of any slider is being taken up."""
    least: float = min(kept[0].done[0], kept[0].done[1], kept[0].done[2])
    return least < 1.0


@compiled()
def keep_offset(kept: NDArray[np.void]) -> None:
    """Keep the offset of the setpoints that were written in the previous cycle."""
    kept[0].offsets[:-1] = kept[0].offsets[1:]
    kept[0].offsets[-1] = kept[0].offset


@compiled()
def due_offset(kept: NDArray[np.void], age: int, i: int) -> float:
    """Return the offset [m] in the setpoint that slider i was due at when measured, `age` SYNCs ago."""
    due: float = kept[0].offsets[KEPT - 2 - age, i]
    return due


@compiled()
def let_go(kept: NDArray[np.void]) -> None:
    """Freeze the offsets while the sliders move freely, so that nothing moves when they are held again."""
    for i in range(3):
        if kept[0].done[i] < 1.0:
            kept[0].end[i], kept[0].done[i], kept[0].heading[i] = kept[0].offset[i], 1.0, 0.0
        kept[0].farthest[i], kept[0].turns[i] = math.nan, 0
