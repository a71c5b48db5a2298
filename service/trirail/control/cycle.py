"""Arithmetic of one cycle, compiled: the robot's measured state, and its sliders' next setpoints.

`observe` evaluates the drives' feedback at a SYNC. `command` moves the platform along its path by one period and solves
the sliders for it, behind the last gate; `hold` does the same for a platform at rest, and `follow` leads the setpoints
to the measured sliders. Each is one call over arrays that are made once, allocates nothing, and writes the cycle's
record. Between the two calls of a cycle the control decides on changes of mode.

Arrays: `legs` is Geometry.packed(), `bounds` Bounds.packed, `feedback` (2,) of FEEDBACK, the newest and the one before,
`written` (5, 3) the setpoints of the cycles before, the newest last [m], `motion` (2, 3, 3) the platform's rows pose,
velocity, acceleration as commanded in this cycle and in the one before, `sliders` (2, 6, 3) the rows position,
velocity, acceleration, and those of the cross slides, as set and as tried, `kept` (2,) of BACKLASH, as set and as
tried, `found` (2,) the values that the gate has refused, and `record` (1,) of trirail.wire.records.DTYPE. Positions of
sliders, set or measured, include the offset that compensates backlash.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from numba import b1, f8, from_dtype, i8, typeof, void
from numpy.typing import NDArray
from trirail_drivers.interface import PowerState

from trirail.control.backlash import BACKLASH, add_offset, due_offset, keep_offset, let_go, taking_up
from trirail.control.in_position import MONITOR, monitor
from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import forward_into
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.geometry import Geometry
from trirail.motion.limits import BOUNDS, AllowedMotion, gate
from trirail.motion.paths import MAX_TIME_FALL_S, law_at, platform_at
from trirail.wire.records import DTYPE

__all__ = [
    "BACKWARDS",
    "DRIFTS",
    "FAR",
    "FEEDBACK",
    "OLDEST",
    "PASSED",
    "RUNS_ON",
    "SAID",
    "STANDS",
    "command",
    "follow",
    "hold",
    "observe",
    "refusal",
]

OLDEST = 3
"""Greatest age of a position that is compared with its setpoint [SYNCs]: at the next one a real drive is silent."""
PASSED, STANDS = 1, 2
"""Bits in the result of command: the goal under way has ended on the path, the motion is at rest."""
FAR = 1000
"""Greatest distance of a setpoint from its slider, in steps, unless it has followed a wrong position."""
BACKWARDS = -1
"""Refusal of command where the time along the path would fall."""
DRIFTS = -2
"""Refusal of command and hold where the platform would move in a mode of standstill."""
RUNS_ON = -3
"""Refusal of command where a braking motion would continue."""
DRIFT = 1e-12
"""Greatest change of a pose per cycle that is rounding [m, rad]: at 1 kHz a drift of 1 nm/s is refused."""
DRIFT_VELOCITY = 1e-9
"""Greatest velocity of a platform at rest that is rounding [m/s, rad/s]."""
_ANY, _BRAKING, _BRAKED, _NONE = (int(allowed) for allowed in AllowedMotion)
OLDEST_RECORDED = 255
"""Greatest recorded age of feedback [SYNCs]; a greater one is recorded as this."""

FEEDBACK = np.dtype(
    [
        ("position", "<f8", 3),
        ("age", "<i8", 3),
        ("drive_state", "u1", 3),
        ("follows", "u1", 3),
        ("homed", "u1", 3),
        ("homing", "u1"),
    ],
    align=True,
)
"""Numeric fields of trirail_drivers.interface.Feedback."""
SAID = struct.Struct("<3d3q10B")
"""Packing of FEEDBACK."""

LEGS = typeof(Geometry.symmetric().packed())  # type: ignore[no-untyped-call]
BOUND, FEEDBACKS, RECORD = from_dtype(BOUNDS)[::1], from_dtype(FEEDBACK)[::1], from_dtype(DTYPE)[::1]
MONITORED, KEPT = from_dtype(MONITOR)[::1], from_dtype(BACKLASH)[::1]
MOTION, SLIDERS = f8[:, :, ::1], f8[:, :, ::1]
KNOTS, PIECES = f8[::1], f8[:, :, ::1]
_ENABLED = int(PowerState.OPERATION_ENABLED)


@compiled(i8(LEGS, FEEDBACKS, f8[:, ::1], KEPT, f8, f8, f8, b1, b1[::1], f8[:, ::1], MONITORED, RECORD))
def observe(
    legs: Array,
    feedback: NDArray[np.void],
    written: Array,
    kept: NDArray[np.void],
    period: float,
    fastest: float,
    limit: float,
    stands: bool,
    jumps: NDArray[np.bool],
    room: Array,
    monitored: NDArray[np.void],
    record: NDArray[np.void],
) -> int:
    """Compute pose, velocities and following errors from feedback[0], and keep it as feedback[1].

    `fastest` [m/s] is the velocity above which a slider `jumps`: then the pose stays unchanged, as it does where
    the sliders belong to none; `room` (2, 3) is workspace. While the commanded motion `stands`, and no backlash is
    being taken up, `monitored` records whether the robot is in position. Returns 0, or 1 + i if the following error
    of slider i is the first beyond `limit` [m].
    """
    now, before, told = feedback[0], feedback[1], record[0]
    written[:-1] = written[1:]
    written[-1] = told.commanded_position
    keep_offset(kept)
    beyond, jumping = 0, False
    for i in range(3):
        cycles = 1 + before.age[i] - now.age[i]
        if cycles > 0:  # else there is no newer position
            told.velocity[i] = (now.position[i] - before.position[i]) / (cycles * period)
        # A drive reaches at a SYNC the setpoint that it took up one SYNC ago, which was written a cycle earlier.
        age = min(now.age[i], OLDEST)
        told.backlash[i] = due_offset(kept, age, i)
        if not now.follows[i]:
            told.following_error[i] = 0.0
        elif now.age[i] <= OLDEST:  # else the setpoint due then is no longer known, and the error stays unchanged
            told.following_error[i] = written[len(written) - 2 - age, i] - now.position[i]
        if beyond == 0 and not abs(told.following_error[i]) <= limit:
            beyond = 1 + i
        jumps[i] = not abs(told.velocity[i]) <= fastest
        jumping |= jumps[i]
        told.position[i], told.age[i] = now.position[i], min(now.age[i], OLDEST_RECORDED)
        told.drive_state[i], told.follows[i], told.homed[i] = now.drive_state[i], now.follows[i], now.homed[i]
        room[0, i], room[1, i] = now.position[i] - told.backlash[i], told.pose[i]
    told.homing = now.homing
    known = not jumping and forward_into(legs, room[0], room[1], room[1]) == 0
    if known:
        told.pose[:] = room[1]
    monitor(record, known and not taking_up(kept), stands, monitored)
    feedback[1] = feedback[0]
    return beyond


@compiled()
def _record_command(motion: Array, sliders: Array, progress: float, remaining: float, record: NDArray[np.void]) -> None:
    """Write the commanded values into the record."""
    told = record[0]
    for i in range(3):
        told.commanded_pose[i] = motion[0, 0, i]
        told.commanded_pose_velocity[i] = motion[0, 1, i]
        told.commanded_pose_acceleration[i] = motion[0, 2, i]
        told.commanded_position[i] = sliders[0, 0, i]
        told.commanded_velocity[i] = sliders[0, 1, i]
        told.commanded_acceleration[i] = sliders[0, 2, i]
        told.passive_position[i] = sliders[0, 3, i]
    told.progress, told.remaining = progress, remaining


@compiled()
def _drifts(motion: Array, found: Array) -> bool:
    """Whether the platform moves; then `found` holds its change and velocity."""
    for n in range(3):
        change = motion[0, 0, n] - motion[1, 0, n]
        if not (abs(change) <= DRIFT and abs(motion[0, 1, n]) <= DRIFT_VELOCITY):
            found[0], found[1] = change, motion[0, 1, n]
            return True
    return False


@compiled()
def _solve(
    legs: Array,
    bounds: NDArray[np.void],
    motion: Array,
    sliders: Array,
    kept: NDArray[np.void],
    found: Array,
) -> int:
    """Solve the sliders for the platform's motion; leave them unchanged where the last gate refuses it.

    Returns 0, 1 + i where leg i is singular or a number is not finite, 3 + a code of trirail.motion.limits.gate, or
    DRIFTS.
    """
    if bounds[0].allowed == _NONE and _drifts(motion, found):
        return DRIFTS
    singular = inverse_motion(legs, motion[0], sliders[1])
    if singular:
        return singular
    add_offset(kept, sliders[1])
    code = gate(bounds, sliders[1], sliders[0], motion[0], motion[1], found)
    if code:
        return 3 + code
    sliders[0], kept[0] = sliders[1], kept[1]
    return 0


@compiled(
    i8(
        *(LEGS, BOUND, KNOTS, PIECES, b1, f8[:, ::1], KNOTS, PIECES),
        *(f8, f8, f8[::1], f8, f8, f8, MOTION, SLIDERS, KEPT, f8[::1], RECORD),
    )
)
def command(
    legs: Array,
    bounds: NDArray[np.void],
    knots: Array,
    pieces: Array,
    in_sliders: bool,
    tools: Array,
    law_knots: Array,
    law_pieces: Array,
    time: float,
    target: float,
    furthest: Array,
    begun: float,
    end: float,
    arrival: float,
    motion: Array,
    sliders: Array,
    kept: NDArray[np.void],
    found: Array,
    record: NDArray[np.void],
) -> int:
    """Move the platform along its path, to a time of its law [s], and solve the sliders for it.

    `target` is the rate that the law leads to, `furthest` (1,) the greatest time yet along the path [s]: less is
    refused. The goal under way began and ends at the times `begun` and `end` along the path, and the law reaches its
    end at `arrival` [s]. Returns a sum of PASSED, STANDS and 4 times the refusal: see `refusal`.
    """
    law = law_at(law_knots, law_pieces, time)
    s, rate, change = law
    motion[1] = motion[0]
    if platform_at(legs, knots, pieces, in_sliders, tools, law, motion[1, 0], motion[0]) != 0:
        motion[0] = math.nan
    if bounds[0].allowed == _BRAKING and target == 0.0:
        bounds[0].allowed = _BRAKED
    if bounds[0].allowed == _BRAKED and target != 0.0:
        found[0], found[1] = target, rate
        refused = RUNS_ON
    elif s >= furthest[0] - MAX_TIME_FALL_S:
        furthest[0] = max(s, furthest[0])
        refused = _solve(legs, bounds, motion, sliders, kept, found)
    else:
        found[0], found[1] = s, furthest[0]
        refused = BACKWARDS
    progress = max(0.0, min(1.0, (s - begun) / (end - begun))) if end > begun else 1.0
    remaining = max(0.0, arrival - time if target != 0.0 else end - s)
    _record_command(motion, sliders, progress, remaining, record)
    passed = s >= end
    stands = s >= knots[-1] or (target == 0.0 and rate == 0.0 and change == 0.0)
    return PASSED * passed + STANDS * stands + 4 * refused


@compiled(i8(LEGS, BOUND, MOTION, SLIDERS, KEPT, f8[::1], RECORD))
def hold(
    legs: Array,
    bounds: NDArray[np.void],
    motion: Array,
    sliders: Array,
    kept: NDArray[np.void],
    found: Array,
    record: NDArray[np.void],
) -> int:
    """Solve the sliders for a platform at rest; return the code of `command`."""
    motion[1] = motion[0]
    refused = _solve(legs, bounds, motion, sliders, kept, found)
    _record_command(motion, sliders, 0.0, 0.0, record)
    return 4 * refused


def refusal(code: int) -> int:
    """Return the refusal in a result of `command` or `hold`.

    0 for nothing, BACKWARDS, DRIFTS, RUNS_ON, 1 + i where leg i is singular or a number is not finite, or 3 + a code
    for Bounds.violation.
    """
    return code >> 2


@compiled(void(LEGS, FEEDBACKS, b1[::1], b1, b1, f8, MOTION, SLIDERS, KEPT, RECORD))
def follow(
    legs: Array,
    feedback: NDArray[np.void],
    jumps: NDArray[np.bool],
    held: bool,
    stopped_now: bool,
    step: float,
    motion: Array,
    sliders: Array,
    kept: NDArray[np.void],
    record: NDArray[np.void],
) -> None:
    """Command the measured pose, at rest, and lead each setpoint to its slider, by a `step` [m] at most.

    A position that jumps is not followed, nor one that an enabled drive holds where `held`, nor any where all drives
    were `stopped_now`. A drive that moves by itself gets its own position immediately, and so does one without power
    whose setpoint is FAR from it, since that setpoint followed a wrong position.
    """
    let_go(kept)
    now, told = feedback[0], record[0]
    motion[0] = 0.0
    motion[0, 0] = told.pose
    if inverse_motion(legs, motion[0], sliders[1]) == 0:
        sliders[0, 3:] = sliders[1, 3:]
    for i in range(3):
        position, last = now.position[i], sliders[0, 0, i]
        if not now.follows[i]:
            sliders[0, 0, i] = position
        elif not (stopped_now or jumps[i] or (held and now.drive_state[i] == _ENABLED)):
            lost = now.drive_state[i] != _ENABLED and abs(position - last) > FAR * step
            sliders[0, 0, i] = position if lost else last + max(-step, min(position - last, step))
        sliders[0, 1, i] = sliders[0, 2, i] = 0.0
    _record_command(motion, sliders, 0.0, 0.0, record)
