"""Measured state of the robot from the drives' feedback: pose, velocities and following errors."""

from __future__ import annotations

import numpy as np
from trirail_drivers.interface import Feedback, PowerState, Triple

from trirail.config import InPosition
from trirail.control import cycle
from trirail.control.backlash import backlash
from trirail.control.in_position import Settling
from trirail.kinematics.arrays import Array
from trirail.kinematics.robot import forward_into
from trirail.motion.backlash_reserve import NO_BACKLASH, TakeUp
from trirail.motion.runs import ZERO_RATES
from trirail.wire.records import DTYPE

WINDOWS = InPosition()
CAN_MOVE = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
"""States in which a drive can move its slider."""


class MeasuredState:
    """Measured state by the newest feedback, kept in the cycle's record.

    Parameters
    ----------
    step
        Greatest travel of a slider in a cycle [m].
    limit
        Limit of following errors [m].
    windows
        Limits of residuals at rest.
    take_up
        Take-up of the sliders' backlash.

    """

    def __init__(
        self,
        legs: Array,
        period: float,
        step: float,
        limit: float = np.inf,
        windows: InPosition = WINDOWS,
        take_up: TakeUp = NO_BACKLASH,
    ) -> None:
        self.feedback = Feedback(ZERO_RATES, (PowerState.NOT_READY_TO_SWITCH_ON,) * 3, None)
        self.record = np.zeros(1, DTYPE)
        """The cycle's record, (1,); this class writes the measured values, Setpoints the commanded ones."""
        self.numbers = np.zeros(2, cycle.FEEDBACK)
        """Newest and previous feedback, as numbers."""
        self.jumping = np.zeros(3, np.bool)
        """Whether each slider's position has changed faster than the slider can move."""
        self.settling = Settling(windows, period)
        """Whether the robot is in position."""
        self.backlash = backlash(take_up, period)
        """Backlash compensation of the setpoints, (2,) of trirail.control.backlash.BACKLASH."""
        self.legs = legs
        self._period = period
        self.fastest = 2.0 * step / period  # the age may be wrong by one, which doubles a step
        self.limit = limit
        self._packed = self.numbers.view(np.uint8).data
        self.written = np.zeros((2 + cycle.MAX_AGE, 3))
        self.scratch = np.zeros((2, 3))

    @property
    def position(self) -> Triple:
        """Newest positions of the sliders [m]; `feedback` is not updated by the compiled call."""
        x, y, z = self.numbers["position"][0].tolist()
        return x, y, z

    @property
    def pose(self) -> Triple:
        """Newest measured pose: that of the last measured sliders that close the loops."""
        return self._recorded("pose")

    @property
    def velocity(self) -> Triple:
        """Velocities of the sliders [m/s]."""
        return self._recorded("velocity")

    @property
    def following_error(self) -> Triple:
        """Setpoint in force less position [m]; zero for a drive that moves by itself."""
        return self._recorded("following_error")

    @property
    def jumps(self) -> tuple[bool, bool, bool]:
        """Whether each slider's position has changed faster than the slider can move."""
        a, b, c = self.jumping.tolist()
        return a, b, c

    @property
    def powered(self) -> bool:
        """Whether any drive can still move its slider."""
        return any(state in CAN_MOVE for state in self.feedback.state)

    @property
    def unready(self) -> tuple[str, ...]:
        """Reasons why drives cannot be reset yet, one line each, without repetitions."""
        return tuple(dict.fromkeys(str(each) for each in self.feedback.unready if each is not None))

    @property
    def homed(self) -> bool:
        """Whether the positions of all sliders are known."""
        return all(self.feedback.homed)

    def start(self, feedback: Feedback) -> None:
        """Begin with the first feedback, and use its positions as past setpoints."""
        self._pack(feedback)
        self.numbers[1] = self.numbers[0]
        self.written[:] = self.record["commanded_position"] = feedback.position

    def update(self, feedback: Feedback, at_rest: bool = False) -> int:
        """Evaluate the feedback of the next cycle; return 0, or 1 + i for a following error of slider i.

        `at_rest` is whether the commanded motion is at rest.
        """
        self._pack(feedback)
        return cycle.observe(
            self.legs,
            self.numbers,
            self.written,
            self.backlash,
            self._period,
            self.fastest,
            self.limit,
            at_rest,
            self.jumping,
            self.scratch,
            self.settling.monitored,
            self.record,
        )

    def pose_of(self, sliders: Triple) -> Triple | None:
        """Return the pose of slider setpoints that is nearest to the newest pose; None if they belong to no pose."""
        self.scratch[:] = sliders, self.pose
        self.scratch[0] -= self.backlash[0]["offset"]
        if forward_into(self.legs, self.scratch[0], self.scratch[1], self.scratch[1]):
            return None
        x, y, phi = self.scratch[1].tolist()
        return x, y, phi

    def _pack(self, feedback: Feedback) -> None:
        self.feedback = feedback
        cycle.FEEDBACK_STRUCT.pack_into(
            self._packed,
            0,
            *feedback.position,
            *feedback.age,
            *feedback.state,
            *feedback.follows,
            *feedback.homed,
            feedback.homing,
        )
        self.record["inputs"] = feedback.inputs

    def _recorded(self, field: str) -> Triple:
        x, y, z = self.record[field][0].tolist()
        return x, y, z
