"""Backlash compensation for sliders that reverse. The functions are compiled and advance by one cycle per call.

A slider with backlash lags its motor by half the backlash. The setpoint of a drive is therefore the position of the
slider plus an offset of half the backlash in the direction of the last motion. The position of the slider is the
measurement of the drive minus this offset. After a reversal, the offset changes its sign gradually, over the time given
by trirail.motion.backlash_reserve. If the slider reverses again during this change, the next change starts only when
the current change is complete. If the slider reverses twice during a change, the offset changes to the opposite side
and then back, because the slider may be anywhere within its backlash. While the last direction of a slider is unknown,
for example after power-on, the offset is zero.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trirail.kinematics.algebra import copy_vector
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.motion.backlash_reserve import TakeUp

__all__ = [
    "BACKLASH",
    "MIN_REVERSAL_M",
    "OFFSETS_KEPT",
    "add_offset",
    "backlash",
    "due_offset",
    "keep_offset",
    "release_offsets",
    "taking_up",
]

MIN_REVERSAL_M = 5e-7
"""Shortest motion that counts as a reversal [m]. To compensate shorter reversals has no benefit and wears the drive."""
OFFSETS_KEPT = 5
"""Number of past setpoints of which the offsets are stored, to correct late measurements."""

BACKLASH = np.dtype(
    [
        ("half", "<f8", 3),  # half the backlash [m]
        ("step", "<f8"),  # fraction of a change that is completed per cycle; zero if no slider has backlash
        ("period", "<f8"),  # duration of a cycle [s]
        ("offset", "<f8", 3),  # offset in the latest setpoints [m]
        ("begin", "<f8", 3),  # offsets at the beginning and at the end of the change [m]
        ("end", "<f8", 3),
        ("done", "<f8", 3),  # completed fraction of the change, 0 to 1
        ("turns", "<i8", 3),  # number of reversals since the change began
        ("heading", "<f8", 3),  # direction in which a slider last moved: 1 or -1; 0 if unknown
        ("farthest", "<f8", 3),  # farthest position in that direction [m]; NaN before the first command
        ("offsets", "<f8", (OFFSETS_KEPT, 3)),  # offsets in the setpoints of previous cycles, oldest first
    ],
    align=True,
)
"""State of the compensation between cycles, for compiled code."""


def backlash(take_up: TakeUp, period: float) -> NDArray[np.void]:
    """Return an array (2,) with the initial state, and space for a tentative state."""
    state = np.zeros(2, BACKLASH)
    state["half"] = np.array(take_up.widths) / 2.0
    state["step"] = 1.0 / math.ceil(take_up.duration / period) if take_up.duration > 0.0 else 0.0
    state["period"] = period
    state["done"], state["farthest"] = 1.0, math.nan
    return state


@compiled()
def add_offset(states: NDArray[np.void], sliders: Array) -> None:
    """Add the offset of the next cycle to the solved slider positions, and write the new state to states[1].

    If the setpoints are accepted, the caller assigns `states[0] = states[1]`. If they are refused, the caller leaves
    `states[0]` unchanged, and the next call starts from the same state again.

    Parameters
    ----------
    states : (2,)
        Current and tentative state, of dtype BACKLASH.
    sliders : (6, 3)
        Position, velocity and acceleration of the sliders (rows lambda_10, v_10, gamma_10), then of the cross slides.

    """
    if states[0].step == 0.0:
        return
    states[1] = states[0]
    tried = states[1]
    for i in range(3):
        place, heading, farthest = sliders[0, i], tried.heading[i], tried.farthest[i]
        if math.isnan(farthest) or (heading != 0.0 and (place - farthest) * heading >= 0.0):
            tried.farthest[i] = place
        elif abs(place - farthest) > MIN_REVERSAL_M:
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
def taking_up(states: NDArray[np.void]) -> bool:
    """Return whether the offset of any slider is changing."""
    least: float = min(states[0].done[0], states[0].done[1], states[0].done[2])
    return least < 1.0


@compiled()
def keep_offset(states: NDArray[np.void]) -> None:
    """Append the offset in the setpoints of the previous cycle to the stored past offsets."""
    offsets = states[0].offsets
    for n in range(1, OFFSETS_KEPT):
        copy_vector(offsets[n], offsets[n - 1])
    copy_vector(states[0].offset, offsets[-1])


@compiled()
def due_offset(states: NDArray[np.void], age: int, i: int) -> float:
    """Return the offset that was part of the active setpoint when slider i was measured, `age` SYNCs ago [m]."""
    due: float = states[0].offsets[OFFSETS_KEPT - 2 - age, i]
    return due


@compiled()
def release_offsets(states: NDArray[np.void]) -> None:
    """Freeze the offsets while the setpoints follow the measured sliders.

    Without this, a change of an offset could move a slider when the drives hold their positions again.
    """
    for i in range(3):
        if states[0].done[i] < 1.0:
            states[0].end[i], states[0].done[i], states[0].heading[i] = states[0].offset[i], 1.0, 0.0
        states[0].farthest[i], states[0].turns[i] = math.nan, 0
