"""Setpoints of the sliders. They are computed from the commanded motion, or they follow the measured sliders."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, Triple

from trirail.control import cycle
from trirail.control.feedback import MeasuredState
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.kinematics.closed_forward import sign_of_det_j2
from trirail.kinematics.robot import inverse_into
from trirail.motion.limits import AllowedMotion, Bounds
from trirail.motion.runs import ZERO_RATES, Run
from trirail.motion.schedule import Schedule
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.vocabulary import Mode

_ALLOWED = {Mode.HOLDING: AllowedMotion.NONE, Mode.STOPPING: AllowedMotion.BRAKING}
"""Motion that the last gate allows in each mode; any motion in other modes. The last gate is not used in modes in which
the setpoints follow the measured sliders."""


class Setpoints:
    """Setpoints for the next SYNC, and their check by the last gate.

    Parameters
    ----------
    tolerance
        Tolerances for a robot at rest outside its limits, from trirail.motion.limits.standing_tolerance.
    step
        Greatest travel of a slider in one cycle [m].

    """

    def __init__(self, legs: Array, bounds: Bounds, tolerance: Array, measured: MeasuredState, step: float) -> None:
        self._legs = legs
        self._tolerance = tolerance
        self._bounds = bounds
        self._measured = measured
        self.step = step
        self.sliders = np.zeros((2, 6, 3))
        self._sent = self.sliders[0, :2]
        self._motion = np.zeros((3, 3))
        self._tried = np.zeros((6, 3))

    @property
    def bounds(self) -> NDArray[np.void]:
        """Bounds of the last gate, (1,) of dtype trirail.motion.limits.BOUNDS."""
        return self._bounds.packed

    @property
    def refused_values(self) -> Array:
        """Refused value, and the value with which it was compared, (2,)."""
        return self._bounds.last_violation

    @property
    def rows(self) -> list[list[float]]:
        """Six rows: position, velocity and acceleration of the sliders, then of the cross slides."""
        return self.sliders[0].tolist()  # type: ignore[no-any-return]  # numpy does not annotate the type of its lists

    @property
    def sent(self) -> tuple[Triple, Triple]:
        """Setpoints for the drives: positions [m] and velocities [m/s]."""
        (a, b, c), (u, v, w) = self._sent.tolist()
        return (a, b, c), (u, v, w)

    def start(self) -> None:
        """Set the first setpoints to the measured slider positions."""
        self.sliders[0, 0] = self._measured.position

    def allow(self, mode: Mode) -> None:
        """Set the motion that the last gate allows in a new mode."""
        self.bounds[0]["allowed"] = _ALLOWED.get(mode, AllowedMotion.ANY)

    def solve(self, schedule: Schedule, run: Run | None) -> int:
        """Advance the commanded motion along the run by one period, and solve the slider positions.

        If the last gate refuses the result, the slider positions do not change. Returns the result of
        trirail.control.cycle.command.
        """
        legs, bounds, refused_values = self._legs, self._bounds.packed, self._bounds.last_violation
        motion, sliders, record = schedule.motion, self.sliders, self._measured.record
        backlash = self._measured.backlash
        if run is None:
            return cycle.hold(legs, bounds, motion, sliders, backlash, refused_values, record)
        path, law, (begun, end, arrival) = run.path, run.law, run.goal_span
        return cycle.command(
            *(legs, bounds, *path, law.knots, law.pieces, run.time, run.target, run.furthest),
            *(begun, end, arrival, motion, sliders, backlash, refused_values, record),
        )

    def refusal(self, code: int) -> str | None:
        """Return the reason why the setpoints were refused; None if the result code contains no refusal."""
        refused = cycle.refusal(code)
        if refused == 0:
            return None
        now, other = self._bounds.last_violation.tolist()
        if refused == cycle.BACKWARDS:
            return f"no setpoint: time along the path would run backwards, from {other:.6g} to {now:.6g} s"
        if refused == cycle.DRIFTING:
            return (
                f"setpoint refused: the platform would move by {now:.3g} m or rad in a cycle while the mode is holding"
            )
        if refused == cycle.NOT_BRAKING:
            return f"setpoint refused: the motion would continue at {now:.0%} of its speed while the mode is stopping"
        if refused <= len(NAMES):
            slider = f"slider {self._bounds.labels[refused - 1]}"
            return f"{slider}: no setpoint, the commanded pose is singular or not a number"
        return f"setpoint refused: {self._bounds.violation(refused - len(NAMES))}"

    def follow(self, schedule: Schedule, *, held: bool, stopped_now: bool) -> None:
        """Set the commanded pose to the measured pose, and let the setpoints follow the measured sliders.

        With setpoints at the measured positions, nothing moves when the drives are enabled. A setpoint moves no faster
        than a slider. A drive that has missed the command to stop therefore does not jump. While a drive homes itself,
        the setpoint equals the measured position.

        Parameters
        ----------
        held
            Whether the setpoints of enabled drives remain unchanged.
        stopped_now
            Whether all drives were stopped in this cycle. If True, the setpoints of all drives remain unchanged.

        """
        measured = self._measured
        arrays = schedule.motion, self.sliders, measured.backlash, measured.record
        cycle.follow(self._legs, measured.numbers, measured.jumping, held, stopped_now, self.step, *arrays)

    def set_cross_slides(self, pose: Sequence[float]) -> None:
        """Set the positions of the cross slides for a pose. The last gate compares the next setpoint with them."""
        self._motion[:] = 0.0
        self._motion[0] = pose
        if inverse_into(self._legs, self._motion, self._tried) == 0:
            self.sliders[0, 3:] = self._tried[3:]

    def record_progress(self, progress: float, remaining: float) -> None:
        """Write the completed fraction and the remaining time [s] of the current goal to the record."""
        record = self._measured.record
        record["progress"], record["remaining"] = progress, remaining

    def check_rest(self) -> None:
        """Raise RefusedError if a setpoint has not reached its slider, in which case the drives must not be enabled."""
        places = self._measured.position
        for name, setpoint, position in zip(self._bounds.labels, self.rows[0], places, strict=True):
            if not abs(setpoint - position) <= self.step:
                raise RefusedError(
                    RefusalCode.NOT_AT_REST,
                    f"slider {name} moves faster than its setpoint can follow: send enable when the slider is at rest",
                )

    def check_start(self) -> EventText | None:
        """Return a warning if the robot is outside its limits by more than the tolerance; otherwise None.

        A robot outside its limits can only move back towards the limits. Raises RefusedError if the robot is at or
        beyond a singular pose, because no motion may pass through a singular pose.
        """
        pose = self._measured.pose_of(self._measured.position)
        self._motion[:] = 0.0
        self._motion[0] = pose or math.nan
        if pose is None or inverse_into(self._legs, self._motion, self._tried):
            raise RefusedError(
                RefusalCode.SINGULAR,
                "the measured slider positions do not correspond to any pose: move the sliders by hand, then send "
                "enable",
            )
        if sign_of_det_j2(self._legs, pose) != sign_of_det_j2(self._legs, ZERO_RATES):
            raise RefusedError(
                RefusalCode.SINGULAR,
                "the robot has passed a singular pose: move the platform back by hand, then send enable",
            )
        self._tried[0] += self._measured.backlash[0]["offset"]
        violation = self._bounds.standing_violation(
            np.concatenate([pose, self._tried[0], self._tried[3]]), self._tolerance
        )
        if violation is None:
            return None
        words = f"the robot is outside its limits, and only motion back towards them is accepted: {violation}"
        return coded(
            words,
            EventCode.OUTSIDE_LIMITS,
            part=violation.part,
            name=violation.name,
            quantity=violation.quantity,
            value=violation.value,
            limit=violation.limit,
            unit=violation.unit,
        )
