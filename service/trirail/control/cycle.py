"""Compiled computations of one cycle: the measured state of the robot, and the next setpoints of the sliders.

`observe` evaluates the drives' feedback at a SYNC. `command` moves the platform along its path by one period and solves
the slider positions, which become setpoints only if the last gate accepts them. `hold` does the same for a platform at
rest. `follow` moves the setpoints towards the measured sliders. All functions work on preallocated arrays, allocate no
memory, and write to the record of the cycle. Between `observe` and the other functions, the control may change the
mode.

The functions share these arrays:

legs
    Geometry.packed().
bounds
    Bounds.packed.
feedback : (2,)
    Latest and previous feedback, of dtype FEEDBACK.
written : (5, 3)
    Setpoints of the previous cycles, oldest first [m].
motion : (2, 3, 3)
    Commanded motion of the platform in this cycle and in the previous one; rows are pose, velocity, acceleration.
sliders : (2, 6, 3)
    Accepted and tentative motion of the sliders; rows are position, velocity and acceleration of the sliders, then of
    the cross slides.
backlash : (2,)
    Accepted and tentative state of the backlash compensation, of dtype BACKLASH.
refused_values : (2,)
    Refused value, and the value with which it was compared.
record : (1,)
    Record of the cycle, of dtype trirail.wire.records.DTYPE.

Commanded and measured slider positions include the offset of the backlash compensation.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from numba import b1, f8, from_dtype, i8, typeof, void
from numpy.typing import NDArray
from trirail_drivers.interface import PowerState

from trirail.control.backlash import BACKLASH, add_offset, due_offset, keep_offset, release_offsets, taking_up
from trirail.control.in_position import MONITOR, monitor
from trirail.kinematics.algebra import copy_vector
from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import forward_into
from trirail.kinematics.closure import inverse_motion
from trirail.kinematics.compiled import compiled
from trirail.kinematics.geometry import Geometry
from trirail.motion.limits import BOUNDS, AllowedMotion, gate
from trirail.motion.paths import earliest_time, law_at, platform_at
from trirail.wire.records import DTYPE

__all__ = [
    "AT_REST",
    "BACKWARDS",
    "DRIFTING",
    "FEEDBACK",
    "FEEDBACK_STRUCT",
    "MAX_AGE",
    "MAX_DISTANCE_STEPS",
    "NOT_BRAKING",
    "PASSED",
    "command",
    "ends_at",
    "follow",
    "hold",
    "observe",
    "refusal",
]

MAX_AGE = 3
"""Greatest age of a position for which a following error is computed [SYNCs]. A drive with an older position is
silent."""
PASSED, AT_REST = 1, 2
"""Bits in the result of `command`: the path has passed the end of the current goal; the motion is at rest."""
MAX_DISTANCE_STEPS = 1000
"""Greatest plausible distance of a setpoint from its slider, in multiples of the travel in one cycle. A greater
distance shows that the setpoint has followed a wrong position."""
BACKWARDS = -1
"""Refusal by `command`: the time along the path would decrease."""
DRIFTING = -2
"""Refusal by `command` and `hold`: the platform would move although the mode requires a standstill."""
NOT_BRAKING = -3
"""Refusal by `command`: the motion would continue although the mode requires braking."""
MAX_DRIFT = 1e-12
"""Greatest change of a pose per cycle that is treated as rounding [m, rad]. At 1 kHz, a drift of 1 nm/s is refused."""
MAX_DRIFT_VELOCITY = 1e-9
"""Greatest velocity that is treated as rounding [m/s, rad/s]."""
_ANY, _BRAKING, _BRAKED, _NONE = (int(allowed) for allowed in AllowedMotion)
MAX_RECORDED_AGE = 255
"""Greatest age of feedback in a record [SYNCs]; greater ages are recorded as this value."""

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
"""Layout of the numeric fields of trirail_drivers.interface.Feedback."""
FEEDBACK_STRUCT = struct.Struct("<3d3q10B")
"""Struct with the same layout as FEEDBACK."""

LEGS = typeof(Geometry.symmetric().packed())  # type: ignore[no-untyped-call]
BOUND, FEEDBACKS, RECORD = from_dtype(BOUNDS)[::1], from_dtype(FEEDBACK)[::1], from_dtype(DTYPE)[::1]
MONITORED, BACKLASH_STATES = from_dtype(MONITOR)[::1], from_dtype(BACKLASH)[::1]
MOTION, SLIDERS = f8[:, :, ::1], f8[:, :, ::1]
KNOTS, PIECES = f8[::1], f8[:, :, ::1]
_ENABLED = int(PowerState.OPERATION_ENABLED)


@compiled(i8(LEGS, FEEDBACKS, f8[:, ::1], BACKLASH_STATES, f8, f8, f8, b1, b1[::1], f8[:, ::1], MONITORED, RECORD))
def observe(
    legs: Array,
    feedback: NDArray[np.void],
    written: Array,
    backlash: NDArray[np.void],
    period: float,
    fastest: float,
    limit: float,
    at_rest: bool,
    jumps: NDArray[np.bool],
    scratch: Array,
    monitored: NDArray[np.void],
    record: NDArray[np.void],
) -> int:
    """Compute pose, velocities and following errors from feedback[0], then copy feedback[0] to feedback[1].

    The pose does not change if a slider position jumps, or if no pose matches the slider positions.

    Parameters
    ----------
    fastest
        Velocity above which a slider position counts as jumping [m/s].
    limit
        Greatest permitted following error [m].
    at_rest
        Whether the commanded motion is at rest. Only at rest does `monitored` record whether the robot is in position.
    jumps : (3,)
        Output: whether the position of each slider jumps.
    scratch : (2, 3)
        Scratch space.

    Returns
    -------
    int
        0 if all following errors are within the limit; 1 + i if slider i is the first that exceeds it.

    """
    now, before, row = feedback[0], feedback[1], record[0]
    for n in range(1, len(written)):
        copy_vector(written[n], written[n - 1])
    copy_vector(row.commanded_position, written[-1])
    keep_offset(backlash)
    beyond, jumping = 0, False
    for i in range(3):
        cycles = 1 + before.age[i] - now.age[i]
        if cycles > 0:  # otherwise there is no newer position
            row.velocity[i] = (now.position[i] - before.position[i]) / (cycles * period)
        # The setpoint that a drive reaches at this SYNC was accepted at the previous SYNC, and written one cycle
        # before.
        age = min(now.age[i], MAX_AGE)
        row.backlash[i] = due_offset(backlash, age, i)
        if not now.follows[i]:
            row.following_error[i] = 0.0
        elif now.age[i] <= MAX_AGE:  # otherwise the setpoint is unknown, and the error stays unchanged
            row.following_error[i] = written[len(written) - 2 - age, i] - now.position[i]
        if beyond == 0 and not abs(row.following_error[i]) <= limit:
            beyond = 1 + i
        jumps[i] = not abs(row.velocity[i]) <= fastest
        jumping |= jumps[i]
        row.position[i], row.age[i] = now.position[i], min(now.age[i], MAX_RECORDED_AGE)
        row.drive_state[i], row.follows[i], row.homed[i] = now.drive_state[i], now.follows[i], now.homed[i]
        scratch[0, i], scratch[1, i] = now.position[i] - row.backlash[i], row.pose[i]
    row.homing = now.homing
    known = not jumping and forward_into(legs, scratch[0], scratch[1], scratch[1]) == 0
    if known:
        copy_vector(scratch[1], row.pose)
    monitor(record, known and not taking_up(backlash), at_rest, monitored)
    feedback[1] = feedback[0]
    return beyond


@compiled()
def _record_command(motion: Array, sliders: Array, progress: float, remaining: float, record: NDArray[np.void]) -> None:
    """Write the commanded values to the record."""
    row = record[0]
    for i in range(3):
        row.commanded_pose[i] = motion[0, 0, i]
        row.commanded_pose_velocity[i] = motion[0, 1, i]
        row.commanded_pose_acceleration[i] = motion[0, 2, i]
        row.commanded_position[i] = sliders[0, 0, i]
        row.commanded_velocity[i] = sliders[0, 1, i]
        row.commanded_acceleration[i] = sliders[0, 2, i]
        row.passive_position[i] = sliders[0, 3, i]
    row.progress, row.remaining = progress, remaining


@compiled()
def _is_drifting(motion: Array, refused_values: Array) -> bool:
    """Return True if the platform moves. In this case, write the change and the velocity to `refused_values`."""
    for n in range(3):
        change = motion[0, 0, n] - motion[1, 0, n]
        if not (abs(change) <= MAX_DRIFT and abs(motion[0, 1, n]) <= MAX_DRIFT_VELOCITY):
            refused_values[0], refused_values[1] = change, motion[0, 1, n]
            return True
    return False


@compiled()
def _solve(
    legs: Array,
    bounds: NDArray[np.void],
    motion: Array,
    sliders: Array,
    backlash: NDArray[np.void],
    refused_values: Array,
) -> int:
    """Solve the slider positions for the platform's motion. If the last gate refuses the result, change nothing.

    Returns 0 if the result is accepted, 1 + i if leg i is singular or a number is not finite, 3 + a code of
    trirail.motion.limits.gate, or DRIFTING.
    """
    if bounds[0].allowed == _NONE and _is_drifting(motion, refused_values):
        return DRIFTING
    singular = inverse_motion(legs, motion[0], sliders[1])
    if singular:
        return singular
    add_offset(backlash, sliders[1])
    code = gate(bounds, sliders[1], sliders[0], motion[0], motion[1], refused_values)
    if code:
        return 3 + code
    for k in range(6):
        copy_vector(sliders[1, k], sliders[0, k])
    backlash[0] = backlash[1]
    return 0


@compiled()
def _keep_motion(motion: Array) -> None:
    """Let the commanded motion become that of the previous cycle."""
    for k in range(3):
        copy_vector(motion[0, k], motion[1, k])


@compiled()
def _ends_at(law: tuple[float, float, float], target: float, end: float, duration: float) -> int:
    """Return the sum of PASSED and AT_REST for a state of the law."""
    s, rate, change = law
    at_rest = s >= duration or (target == 0.0 and rate == 0.0 and change == 0.0)
    return PASSED * (s >= end) + AT_REST * at_rest


@compiled()
def ends_at(knots: Array, law_knots: Array, law_pieces: Array, time: float, target: float, end: float) -> int:
    """Return the sum of PASSED and AT_REST that `command` would return for a later time of the law [s]."""
    return _ends_at(law_at(law_knots, law_pieces, time), target, end, knots[-1])


@compiled(
    i8(
        *(LEGS, BOUND, KNOTS, PIECES, b1, f8[:, ::1], KNOTS, PIECES),
        *(f8, f8, f8[::1], f8, f8, f8, MOTION, SLIDERS, BACKLASH_STATES, f8[::1], RECORD),
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
    backlash: NDArray[np.void],
    refused_values: Array,
    record: NDArray[np.void],
) -> int:
    """Move the platform along its path to the point that its law gives for `time`, and solve the slider positions.

    Parameters
    ----------
    knots, pieces, in_sliders, tools
        The path.
    law_knots, law_pieces
        The law, a function from the time of the law to the time along the path.
    time
        Time of the law [s].
    target
        Rate of the time along the path at the end of the law.
    furthest : (1,)
        Greatest time along the path in any cycle until now [s]. An earlier time is refused.
    begun, end, arrival
        Times along the path at which the current goal begins and ends, and time of the law at which the goal ends [s].

    Returns
    -------
    int
        Sum of PASSED, AT_REST and 4 times the refusal; see `refusal`.

    """
    law = law_at(law_knots, law_pieces, time)
    s, rate, _ = law
    _keep_motion(motion)
    if platform_at(legs, knots, pieces, in_sliders, tools, law, motion[1, 0], motion[0]) != 0:
        motion[0] = math.nan
    if bounds[0].allowed == _BRAKING and target == 0.0:
        bounds[0].allowed = _BRAKED
    if bounds[0].allowed == _BRAKED and target != 0.0:
        refused_values[0], refused_values[1] = target, rate
        refused = NOT_BRAKING
    elif s >= earliest_time(furthest[0]):
        furthest[0] = max(s, furthest[0])
        refused = _solve(legs, bounds, motion, sliders, backlash, refused_values)
    else:
        refused_values[0], refused_values[1] = s, furthest[0]
        refused = BACKWARDS
    progress = max(0.0, min(1.0, (s - begun) / (end - begun))) if end > begun else 1.0
    remaining = max(0.0, arrival - time if target != 0.0 else end - s)
    _record_command(motion, sliders, progress, remaining, record)
    return _ends_at(law, target, end, knots[-1]) + 4 * refused


@compiled(i8(LEGS, BOUND, MOTION, SLIDERS, BACKLASH_STATES, f8[::1], RECORD))
def hold(
    legs: Array,
    bounds: NDArray[np.void],
    motion: Array,
    sliders: Array,
    backlash: NDArray[np.void],
    refused_values: Array,
    record: NDArray[np.void],
) -> int:
    """Solve the slider positions for a platform at rest. The result has the same coding as the result of `command`."""
    _keep_motion(motion)
    refused = _solve(legs, bounds, motion, sliders, backlash, refused_values)
    _record_command(motion, sliders, 0.0, 0.0, record)
    return 4 * refused


def refusal(code: int) -> int:
    """Return the refusal contained in a result of `command` or `hold`.

    The refusal is 0 for none, BACKWARDS, DRIFTING, NOT_BRAKING, 1 + i if leg i is singular or a number is not finite,
    or 3 + a code for Bounds.violation.
    """
    return code >> 2


@compiled(void(LEGS, FEEDBACKS, b1[::1], b1, b1, f8, MOTION, SLIDERS, BACKLASH_STATES, RECORD))
def follow(
    legs: Array,
    feedback: NDArray[np.void],
    jumps: NDArray[np.bool],
    held: bool,
    stopped_now: bool,
    step: float,
    motion: Array,
    sliders: Array,
    backlash: NDArray[np.void],
    record: NDArray[np.void],
) -> None:
    """Set the commanded motion to rest at the measured pose, and move each setpoint towards its measured slider.

    A setpoint changes by at most `step` per cycle, and does not follow a position that jumps. For a drive that moves
    without setpoints, the setpoint equals the measured position. The same applies to a drive that is not enabled if the
    setpoint is more than MAX_DISTANCE_STEPS away, because this setpoint has followed a wrong position.

    Parameters
    ----------
    held
        Whether the setpoints of enabled drives remain unchanged.
    stopped_now
        Whether all drives were stopped in this cycle. If True, the setpoints of all drives remain unchanged.
    step
        Greatest change of a setpoint per cycle [m].

    """
    release_offsets(backlash)
    now, row = feedback[0], record[0]
    motion[0] = 0.0
    copy_vector(row.pose, motion[0, 0])
    if inverse_motion(legs, motion[0], sliders[1]) == 0:
        for k in range(3, 6):
            copy_vector(sliders[1, k], sliders[0, k])
    for i in range(3):
        position, last = now.position[i], sliders[0, 0, i]
        if not now.follows[i]:
            sliders[0, 0, i] = position
        elif not (stopped_now or jumps[i] or (held and now.drive_state[i] == _ENABLED)):
            lost = now.drive_state[i] != _ENABLED and abs(position - last) > MAX_DISTANCE_STEPS * step
            sliders[0, 0, i] = position if lost else last + max(-step, min(position - last, step))
        sliders[0, 1, i] = sliders[0, 2, i] = 0.0
    _record_command(motion, sliders, 0.0, 0.0, record)
