"""What the drives say, put together: where the platform is, how fast the sliders are and how far behind."""

from __future__ import annotations

from collections import deque

import numpy as np
from trirail_drivers.interface import Feedback, PowerState, Triple

from trirail.kinematics.algebra import Array
from trirail.kinematics.robot import forward_into
from trirail.motion.runs import STILL

OLDEST = 3
"""The greatest age of a position that is looked at, in SYNCs: at the next one the drive is silent."""
CAN_MOVE = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
"""States in which a drive can move its slider."""


class Measured:
    """The newest feedback, beside the setpoints that it answers. `step` [m] is how far a slider can go in a cycle."""

    def __init__(self, legs: Array, period: float, step: float) -> None:
        self.feedback = Feedback(STILL, (PowerState.NOT_READY_TO_SWITCH_ON,) * 3, None)
        self.velocity: Triple = STILL
        self.following_error: Triple = STILL
        """Setpoint due less position [m]; none for a drive that moves by itself."""
        self.pose: Triple = STILL
        """The newest pose to which measured sliders belonged."""
        self.jumps = False, False, False
        """Which sliders were measured where none can be so soon: what they say is not followed."""
        self._legs = legs
        self._period = period
        self._step = step
        self._sliders, self._pose = np.zeros(3), np.zeros(3)
        self._written: deque[Triple] = deque([STILL] * (2 + OLDEST), maxlen=2 + OLDEST)

    @property
    def powered(self) -> bool:
        """Whether any drive can still move its slider."""
        return any(state in CAN_MOVE for state in self.feedback.state)

    @property
    def homed(self) -> bool:
        """Whether it is known where the sliders are."""
        return all(self.feedback.homed)

    def start(self, feedback: Feedback) -> None:
        """Take the first feedback, for the setpoints of the past too."""
        self.feedback = feedback
        self._written.extend([feedback.position] * (2 + OLDEST))

    def note(self, setpoint: Triple) -> None:
        """Take note of a setpoint as it is written."""
        self._written.append(setpoint)

    def take(self, feedback: Feedback) -> None:
        """Take the feedback of the next cycle."""
        before, self.feedback = self.feedback, feedback
        self._compare(before)
        a, b, c = self.velocity
        most = 2.0 * self._step / self._period  # the age may be one off, and makes a step a double one
        self.jumps = abs(a) > most, abs(b) > most, abs(c) > most
        pose = None if any(self.jumps) else self.pose_of(feedback.position)
        if pose is not None:
            self.pose = pose

    def pose_of(self, sliders: Triple) -> Triple | None:
        """Return the pose to which sliders belong, the one nearest to the newest; None if they belong to none."""
        self._sliders[:], self._pose[:] = sliders, self.pose
        if forward_into(self._legs, self._sliders, self._pose, self._pose):
            return None
        x, y, phi = self._pose.tolist()
        return x, y, phi

    def _compare(self, before: Feedback) -> None:
        """Work out velocities and following errors, for the SYNC at which each position was sampled."""
        velocity, error = list(self.velocity), [0.0, 0.0, 0.0]
        follows = self.feedback.follows
        for n, (now, age, last, last_age) in enumerate(
            zip(self.feedback.position, self.feedback.age, before.position, before.age, strict=True)
        ):
            cycles = 1 + last_age - age
            if cycles > 0:  # else there is no newer position
                velocity[n] = (now - last) / (cycles * self._period)
            # A drive reaches at a SYNC the setpoint that it took up one SYNC ago, which was written a cycle earlier.
            if follows[n]:
                error[n] = self._written[-2 - min(age, OLDEST)][n] - now
        self.velocity = (velocity[0], velocity[1], velocity[2])
        self.following_error = (error[0], error[1], error[2])
