"""Measured state from the drives' feedback: the platform's pose, the sliders' velocities and following errors."""

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


class Measured:
    """Newest feedback, beside the setpoints that it answers; all of it in the cycle's record.

    `step` [m] is a slider's greatest travel in a cycle, `limit` [m] the limit of following errors, `windows` the limits
    of residuals at rest, `taken` the take-up of the sliders' backlash.
    """

    def __init__(
        self,
        legs: Array,
        period: float,
        step: float,
        limit: float = np.inf,
        windows: InPosition = WINDOWS,
        taken: TakeUp = NO_BACKLASH,
    ) -> None:
        self.feedback = Feedback(ZERO_RATES, (PowerState.NOT_READY_TO_SWITCH_ON,) * 3, None)
        self.record = np.zeros(1, DTYPE)
        """The cycle's record, (1,): measured values are written here, commanded ones by the setpoints."""
        self.numbers = np.zeros(2, cycle.FEEDBACK)
        """Numbers of the feedback, and of the one before."""
        self.jumping = np.zeros(3, np.bool)
        """Whether each slider's position jumped faster than it can move: such positions are not followed."""
        self.settling = Settling(windows, period)
        """Whether the robot is in position."""
        self.backlash = backlash(taken, period)
        """Backlash compensation of the setpoints, (2,) of trirail.control.backlash.BACKLASH."""
        self.legs = legs
        self._period = period
        self.fastest = 2.0 * step / period  # the age may be wrong by one, which doubles a step
        self.limit = limit
        self._packed = self.numbers.view(np.uint8).data
        self.written = np.zeros((2 + cycle.OLDEST, 3))
        self.room = np.zeros((2, 3))

    @property
    def position(self) -> Triple:
        """Newest positions of the sliders [m]; while cycles are quiet the feedback has older ones."""
        x, y, z = self.numbers["position"][0].tolist()
        return x, y, z

    @property
    def pose(self) -> Triple:
        """Newest pose to which measured sliders belonged."""
        return self._recorded("pose")

    @property
    def velocity(self) -> Triple:
        """Velocities of the sliders [m/s]."""
        return self._recorded("velocity")

    @property
    def following_error(self) -> Triple:
        """Setpoint due less position [m]; zero for a drive that moves by itself."""
        return self._recorded("following_error")

    @property
    def jumps(self) -> tuple[bool, bool, bool]:
        """Whether each slider's position jumped faster than it can move."""
        a, b, c = self.jumping.tolist()
        return a, b, c

    @property
    def powered(self) -> bool:
        """Whether any drive can still move its slider."""
        return any(state in CAN_MOVE for state in self.feedback.state)

    @property
    def unready(self) -> tuple[str, ...]:
        """Reasons why drives cannot be reset yet, a line for each, and one for all where the bus is lost."""
        return tuple(dict.fromkeys(str(each) for each in self.feedback.unready if each is not None))

    @property
    def homed(self) -> bool:
        """Whether the positions of all sliders are known."""
        return all(self.feedback.homed)

    def start(self, feedback: Feedback) -> None:
        """Take the first feedback, also as the past setpoints."""
        self._pack(feedback)
        self.numbers[1] = self.numbers[0]
        self.written[:] = self.record["commanded_position"] = feedback.position

    def update(self, feedback: Feedback, stands: bool = False) -> int:
        """Take the feedback of the next cycle; return 0, or 1 + i if slider i's following error is beyond its limit.

        `stands` is whether the motion commanded until now is at rest.
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
            stands,
            self.jumping,
            self.room,
            self.settling.monitored,
            self.record,
        )

    def pose_of(self, sliders: Triple) -> Triple | None:
        """Return the pose of setpoints that is nearest to the newest pose; None if they belong to none."""
        self.room[:] = sliders, self.pose
        self.room[0] -= self.backlash[0]["offset"]
        if forward_into(self.legs, self.room[0], self.room[1], self.room[1]):
            return None
        x, y, phi = self.room[1].tolist()
        return x, y, phi

    def _pack(self, feedback: Feedback) -> None:
        self.feedback = feedback
        cycle.SAID.pack_into(
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
