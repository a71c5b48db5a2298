"""The sliders' setpoints: solved for the commanded motion behind the last gate, or led to where the sliders are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, Triple

from trirail.control import cycle
from trirail.control.feedback import Measured
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.arrays import Array
from trirail.kinematics.robot import inverse_into
from trirail.motion.limits import Bounds
from trirail.motion.runs import Run
from trirail.motion.schedule import Schedule


class Setpoints:
    """The setpoints of the next SYNC. `step` [m] is how far a slider can go in a cycle."""

    def __init__(self, legs: Array, bounds: Bounds, measured: Measured, step: float) -> None:
        self._legs = legs
        self._bounds = bounds
        self._measured = measured
        self.step = step
        self.sliders = np.zeros((2, 6, 3))
        self._sent = self.sliders[0, :2]
        self._motion = np.zeros((3, 3))
        self._tried = np.zeros((6, 3))

    @property
    def bounds(self) -> NDArray[np.void]:
        """The last gate's, (1,) of trirail.motion.limits.BOUNDS."""
        return self._bounds.packed

    @property
    def found(self) -> Array:
        """What the last gate has found, (2,)."""
        return self._bounds.found

    @property
    def rows(self) -> list[list[float]]:
        """Rows position, velocity, acceleration of the sliders, then those of the cross slides."""
        return self.sliders[0].tolist()  # type: ignore[no-any-return]  # numpy does not tell of what type its lists are

    @property
    def sent(self) -> tuple[Triple, Triple]:
        """What the drives get: positions [m] and velocities [m/s]."""
        (a, b, c), (u, v, w) = self._sent.tolist()
        return (a, b, c), (u, v, w)

    def start(self) -> None:
        """Begin where the sliders are."""
        self.sliders[0, 0] = self._measured.position

    def solve(self, schedule: Schedule, run: Run | None) -> int:
        """Move the commanded motion on, by the run under way, and solve the sliders by the paper's recursion.

        Where the last gate refuses that they stay as they are. Returns what trirail.control.cycle.command does.
        """
        legs, bounds, found = self._legs, self._bounds.packed, self._bounds.found
        motion, sliders, record = schedule.motion, self.sliders, self._measured.record
        kept = self._measured.backlash
        if run is None:
            return cycle.hold(legs, bounds, motion, sliders, kept, found, record)
        path, law, (begun, end, arrival) = run.path, run.law, run.course
        return cycle.command(
            *(legs, bounds, *path, law.knots, law.pieces, run.time, run.target, run.furthest),
            *(begun, end, arrival, motion, sliders, kept, found, record),
        )

    def refusal(self, code: int) -> str | None:
        """Say why the last gate has refused what was just solved; None where it has not."""
        refused = cycle.refusal(code)
        if refused == 0:
            return None
        if refused == cycle.BACKWARDS:
            now, furthest = self._bounds.found.tolist()
            return f"no setpoint: time along the path would run backwards, from {furthest:.6g} to {now:.6g} s"
        if refused <= len(NAMES):
            slider = f"slider {self._bounds.labels[refused - 1]}"
            return f"{slider}: no setpoint, the commanded pose is singular or not a number"
        return f"setpoint refused: {self._bounds.violation(refused - len(NAMES))}"

    def follow(self, schedule: Schedule, *, held: bool, stopped_now: bool) -> None:
        """Command the pose that is measured, and every drive that holds none the position that it measures.

        Nothing moves on enable. Where that is not where the slider was commanded to be, the setpoint goes there at the
        slider's speed: a drive that missed the command to stop must not jump either. A position that jumps is not
        followed. A drive that moves by itself, to be homed, gets no setpoint: what is meant for it is its position at
        once. `held` tells whether drives that are enabled hold theirs, `stopped_now` whether all were stopped in this
        cycle: then no setpoint is sent.
        """
        measured = self._measured
        arrays = schedule.motion, self.sliders, measured.backlash, measured.record
        cycle.follow(self._legs, measured.numbers, measured.jumping, held, stopped_now, self.step, *arrays)

    def tell_progress(self, progress: float, remaining: float) -> None:
        """Let the record say how much of the goal under way is over, as a share, and what remains [s]."""
        record = self._measured.record
        record["progress"], record["remaining"] = progress, remaining

    def check_rest(self) -> None:
        """Refuse to enable while a setpoint is on its way to where its slider is."""
        places = self._measured.position
        for name, setpoint, position in zip(self._bounds.labels, self.rows[0], places, strict=True):
            if not abs(setpoint - position) <= self.step:
                raise RefusedError(
                    RefusalCode.NOT_AT_REST,
                    f"slider {name} moves too fast for its setpoint to follow: enable when it stands",
                )

    def check_start(self) -> None:
        """Refuse to begin where the robot stands outside what it may do."""
        position = self._measured.position
        pose = self._measured.pose_of(position)
        self._motion[:] = 0.0
        self._motion[0] = pose or math.nan
        if pose is None or inverse_into(self._legs, self._motion, self._tried):
            raise RefusedError(
                RefusalCode.SINGULAR, "the measured sliders belong to no pose: move them by hand, then enable"
            )
        self._tried[0] += self._measured.backlash[0]["offset"]
        violation = self._bounds.pose(pose) or self._bounds.setpoint(self._tried)
        if violation:
            raise RefusedError(
                RefusalCode.OUT_OF_WORKSPACE,
                f"the robot stands outside its limits: {violation}; move it inside by hand, then enable",
                value=violation.value,
                limit=violation.limit,
            )
