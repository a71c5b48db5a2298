"""Backlash, taken up where a slider turns back; compiled, from cycle to cycle.

A slider with play stands half its width beside its motor, behind it as the motor last went. So the setpoints are the
sliders' places plus an offset of half a width to the side to which the slider last went, and what the drives measure,
less the offset, is where the slider is. From one side to the other the offset goes by trirail.motion.backlash_reserve,
one way at a time: a slider that turns back again meanwhile waits for the end of it, and where it has turned twice goes
to the other side first, since it may have been left anywhere in its play. Where nobody knows to which side a slider
last went, as after power-on, the offset is zero.
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
"""A slider turns back where it goes back by more [m]: less makes no difference to anybody, and wears the drive."""
KEPT = 5
"""Offsets of the newest setpoints that are kept, as of trirail.control.feedback."""

BACKLASH = np.dtype(
    [
        ("half", "<f8", 3),  # of the backlash [m]
        ("step", "<f8"),  # which part of taking it up is done in a cycle; zero where there is no backlash
        ("period", "<f8"),  # of a cycle [s]
        ("offset", "<f8", 3),  # in the newest setpoints [m]
        ("begin", "<f8", 3),  # where the offset comes from, and where it goes [m]
        ("end", "<f8", 3),
        ("done", "<f8", 3),  # which part of that is done; one where all is
        ("turns", "<i8", 3),  # how often a slider has turned back since it began
        ("heading", "<f8", 3),  # to which side a slider last went: 1 or -1; 0 where nobody knows
        ("farthest", "<f8", 3),  # how far, as a place of the slider [m]; not a number before it is commanded anywhere
        ("offsets", "<f8", (KEPT, 3)),  # in the setpoints of the cycles before, the newest last
    ],
    align=True,
)
"""What is kept from cycle to cycle, as compiled code takes it."""


def backlash(taken: TakeUp, period: float) -> NDArray[np.void]:
    """Return what is kept, (2,): as it is, and as it is tried."""
    kept = np.zeros(2, BACKLASH)
    kept["half"] = np.array(taken.widths) / 2.0
    kept["step"] = 1.0 / math.ceil(taken.duration / period) if taken.duration > 0.0 else 0.0
    kept["period"] = period
    kept["done"], kept["farthest"] = 1.0, math.nan
    return kept


@compiled()
def add_offset(kept: NDArray[np.void], sliders: Array) -> None:
    """Add to solved sliders (6, 3), rows lambda_10, v_10, gamma_10, the offset of the next cycle; write it to kept[1].

    Another call without `kept[0] = kept[1]` in between begins from the same.
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
    """Keep the offset of the setpoints that were written in the cycle before."""
    kept[0].offsets[:-1] = kept[0].offsets[1:]
    kept[0].offsets[-1] = kept[0].offset


@compiled()
def due_offset(kept: NDArray[np.void], age: int, i: int) -> float:
    """Return the offset in the setpoint at which slider i was due when it was measured, so many SYNCs ago [m]."""
    due: float = kept[0].offsets[KEPT - 2 - age, i]
    return due


@compiled()
def let_go(kept: NDArray[np.void]) -> None:
    """Leave the offsets as they are: the sliders go wherever they do, and nothing moves when they are held again."""
    for i in range(3):
        if kept[0].done[i] < 1.0:
            kept[0].end[i], kept[0].done[i], kept[0].heading[i] = kept[0].offset[i], 1.0, 0.0
        kept[0].farthest[i], kept[0].turns[i] = math.nan, 0
