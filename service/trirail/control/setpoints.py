"""The sliders' setpoints: solved for the commanded motion behind the last gate, or led to where the sliders are."""

from __future__ import annotations

import math

import numpy as np
from trirail_drivers.interface import NAMES, PowerState

from trirail.control.feedback import Measured
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.algebra import Array
from trirail.kinematics.robot import inverse_into
from trirail.motion.limits import Bounds
from trirail.motion.runs import MotionState, rest


class Setpoints:
    """The setpoints of the next SYNC. `step` [m] is how far a slider can go in a cycle."""

    def __init__(self, legs: Array, bounds: Bounds, measured: Measured, step: float) -> None:
        self._legs = legs
        self._bounds = bounds
        self._measured = measured
        self._step = step
        self._motion = np.zeros((3, 3))
        self._sliders = np.zeros((6, 3))
        self._before: MotionState | None = None
        """The platform's motion in the cycle before; None where the sliders were not solved for one."""
        self.rows: list[list[float]] = self._sliders.tolist()
        """Rows lambda_10, v_10, gamma_10, lambda_32, v_32, gamma_32."""

    def start(self) -> None:
        """Begin where the sliders are."""
        self.rows[0] = list(self._measured.feedback.position)

    def solve(self, commanded: MotionState) -> str | None:
        """Solve the sliders, by the paper's recursion; return why not, and leave all as it is, at the last gate."""
        for row, values in enumerate(commanded):
            self._motion[row] = values
        singular = inverse_into(self._legs, self._motion, self._sliders)
        if singular:
            return f"slider {NAMES[singular - 1]}: no setpoint, the commanded pose is singular or not a number"
        rows = self._sliders.tolist()
        bounds = self._bounds
        before = self._before or rest(commanded.pose)
        violation = (
            bounds.setpoint(rows)
            or bounds.pose(commanded.pose)
            or bounds.step(rows, self.rows)
            or bounds.platform(commanded, before)
        )
        if violation:
            return f"setpoint refused: {violation}"
        self.rows, self._before = rows, commanded
        return None

    def follow(self, *, held: bool, stopped_now: bool) -> None:
        """Make the setpoint of every drive that none holds the position that it measures: nothing moves on enable.

        Where that is not where the slider was commanded to be, the setpoint goes there at the slider's speed: a drive
        that missed the command to stop must not jump either. A position that jumps is not followed. A drive that
        moves by itself, to be homed, gets no setpoint: what is meant for it is its position at once. `held` tells
        whether drives that are enabled hold theirs, `stopped_now` whether all were stopped in this cycle: then no
        setpoint is sent.
        """
        measured = self._measured
        position = []
        for last, now, jumps, state, follows in zip(
            self.rows[0],
            measured.feedback.position,
            measured.jumps,
            measured.feedback.state,
            measured.feedback.follows,
            strict=True,
        ):
            if not follows:
                position.append(now)
            elif stopped_now or jumps or (held and state is PowerState.OPERATION_ENABLED):
                position.append(last)
            else:
                position.append(last + max(-self._step, min(now - last, self._step)))
        self._motion[:] = 0.0
        self._motion[0] = measured.pose
        if inverse_into(self._legs, self._motion, self._sliders) == 0:
            self.rows = self._sliders.tolist()
        self._before = None
        self.rows[0] = position
        self.rows[1] = self.rows[2] = [0.0, 0.0, 0.0]

    def check_rest(self) -> None:
        """Refuse to enable while a setpoint is on its way to where its slider is."""
        for name, setpoint, position in zip(NAMES, self.rows[0], self._measured.feedback.position, strict=True):
            if not abs(setpoint - position) <= self._step:
                raise RefusedError(
                    RefusalCode.NOT_AT_REST,
                    f"slider {name} moves too fast for its setpoint to follow: enable when it stands",
                )

    def check_start(self) -> None:
        """Refuse to begin where the robot stands outside what it may do."""
        position = self._measured.feedback.position
        pose = self._measured.pose_of(position)
        self._motion[:] = 0.0
        self._motion[0] = pose or math.nan
        if pose is None or inverse_into(self._legs, self._motion, self._sliders):
            raise RefusedError(
                RefusalCode.SINGULAR, "the measured sliders belong to no pose: move them by hand, then enable"
            )
        violation = self._bounds.pose(pose) or self._bounds.setpoint(self._sliders.tolist())
        if violation:
            raise RefusedError(
                RefusalCode.OUT_OF_WORKSPACE,
                f"the robot stands outside its limits: {violation}; move it inside by hand, then enable",
                value=violation.value,
                limit=violation.limit,
            )
