"""What the drives say, put together: where the platform is, how fast the sliders are and how far behind."""

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
from trirail.motion.runs import STILL
from trirail.wire.records import DTYPE

WINDOWS = InPosition()
CAN_MOVE = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.FAULT_REACTION_ACTIVE)
"""States in which a drive can move its slider."""


class Measured:
    """The newest feedback, beside the setpoints that it answers; all of it in the cycle's record.

    `step` [m] is how far a slider can go in a cycle, `limit` [m] what following errors are held against, `windows` what
    residuals are held against where the robot is to stand, `taken` how the sliders' backlash is taken up.
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
        self.feedback = Feedback(STILL, (PowerState.NOT_READY_TO_SWITCH_ON,) * 3, None)
        self.record = np.zeros(1, DTYPE)
        """The cycle's record, (1,): what is measured here, what is commanded by the setpoints."""
        self.numbers = np.zeros(2, cycle.FEEDBACK)
        """The feedback's numbers, and those of the one before."""
        self.jumping = np.zeros(3, np.bool)
        """Which sliders were measured where none can be so soon: what they say is not followed."""
        self.settling = Settling(windows, period)
        """Whether the robot is in position."""
        self.backlash = backlash(taken, period)
        """What of the setpoints takes up backlash, (2,) of trirail.control.backlash.BACKLASH."""
        self.legs = legs
        self._period = period
        self.fastest = 2.0 * step / period  # the age may be one off, and makes a step a double one
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
        """The newest pose to which measured sliders belonged."""
        return self._recorded("pose")

    @property
    def velocity(self) -> Triple:
        """Velocities of the sliders [m/s]."""
        return self._recorded("velocity")

    @property
    def following_error(self) -> Triple:
        """Setpoint due less position [m]; none for a drive that moves by itself."""
        return self._recorded("following_error")

    @property
    def jumps(self) -> tuple[bool, bool, bool]:
        """Which sliders were measured where none can be so soon."""
        a, b, c = self.jumping.tolist()
        return a, b, c

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
        self._pack(feedback)
        self.numbers[1] = self.numbers[0]
        self.written[:] = self.record["commanded_position"] = feedback.position

    def update(self, feedback: Feedback, stands: bool = False) -> int:
        """Take the feedback of the next cycle; return 0, or 1 + i if slider i's following error is beyond its limit.

        `stands` tells whether the motion that was commanded until now does.
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
        """Return the pose to which setpoints belong, the one nearest to the newest; None if they belong to none."""
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

    def _recorded(self, field: str) -> Triple:
        x, y, z = self.record[field][0].tolist()
        return x, y, z
