"""Computation of the robot's measured pose, velocities and following errors from the feedback of the drives."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
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


def pack_feedback(feedback: Feedback, numbers: NDArray[np.void], record: NDArray[np.void]) -> None:
    """Write the numeric fields of a feedback to element 0 of an array of dtype trirail.control.cycle.FEEDBACK.

    The digital inputs are written directly to the record of the cycle.
    """
    record["inputs"] = feedback.inputs
    cycle.FEEDBACK_STRUCT.pack_into(
        numbers.view(np.uint8).data,
        0,
        *feedback.position,
        *feedback.age,
        *feedback.state,
        *feedback.follows,
        *feedback.homed,
        feedback.homing,
    )


class Snapshot(NamedTuple):
    """Copy of the feedback after a cycle, and of the arrays that depend on it."""

    feedback: Feedback
    arrays: tuple[NDArray[Any], ...]


class MeasuredState:
    """Measured state of the robot after the latest feedback. The values are stored in the record of the cycle.

    Parameters
    ----------
    step
        Greatest travel of a slider in one cycle [m].
    limit
        Greatest permitted following error [m].
    windows
        In-position windows, dwell time and time-out.
    take_up
        Widths of the sliders' backlash, and the time in which a motor crosses the backlash after a reversal.

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
        """Record of the cycle, (1,). This class writes the measured values, and Setpoints writes the commanded ones."""
        self.numbers = np.zeros(2, cycle.FEEDBACK)
        """Latest and previous feedback as numbers."""
        self.jumping = np.zeros(3, np.bool)
        """Whether the position of each slider has changed faster than the slider can move."""
        self.settling = Settling(windows, period)
        """Monitor that decides whether the robot is in position."""
        self.backlash = backlash(take_up, period)
        """State of the backlash compensation, (2,) of dtype trirail.control.backlash.BACKLASH."""
        self.legs = legs
        self._period = period
        # The age of a position may be wrong by one cycle. Two steps then appear as one.
        self.fastest = 2.0 * step / period
        self.limit = limit
        self.written = np.zeros((2 + cycle.MAX_AGE, 3))
        self.scratch = np.zeros((2, 3))

    @property
    def position(self) -> Triple:
        """Latest positions of the sliders [m]. Up to date in compiled cycles, unlike `feedback`."""
        x, y, z = self.numbers["position"][0].tolist()
        return x, y, z

    @property
    def pose(self) -> Triple:
        """Latest measured pose, computed from the last slider positions that match a pose and did not jump."""
        return self._recorded("pose")

    @property
    def velocity(self) -> Triple:
        """Velocities of the sliders [m/s]."""
        return self._recorded("velocity")

    @property
    def following_error(self) -> Triple:
        """Active setpoint minus position of each slider [m]; zero for a drive that moves without setpoints."""
        return self._recorded("following_error")

    @property
    def jumps(self) -> tuple[bool, bool, bool]:
        """Whether the position of each slider has changed faster than the slider can move."""
        a, b, c = self.jumping.tolist()
        return a, b, c

    @property
    def powered(self) -> bool:
        """Whether any drive can still move its slider."""
        return any(state in CAN_MOVE for state in self.feedback.state)

    @property
    def unready(self) -> tuple[str, ...]:
        """Reasons why drives cannot be reset yet. Each reason is one line and appears only once."""
        return tuple(dict.fromkeys(str(each) for each in self.feedback.unready if each is not None))

    @property
    def homed(self) -> bool:
        """Whether the positions of all sliders are known."""
        return all(self.feedback.homed)

    def start(self, feedback: Feedback) -> None:
        """Store the first feedback, and use the measured positions as the setpoints of the past cycles."""
        self._pack(feedback)
        self.numbers[1] = self.numbers[0]
        self.written[:] = self.record["commanded_position"] = feedback.position

    def update(self, feedback: Feedback, at_rest: bool = False) -> int:
        """Evaluate the feedback of the next cycle, and return the result of trirail.control.cycle.observe.

        The result is 0, or 1 + i if slider i exceeds the limit of the following error. `at_rest` is True if the
        commanded motion is at rest.
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

    def snapshot(self) -> Snapshot:
        """Return a copy of the present state for `as_of`."""
        return Snapshot(self.feedback, tuple(array.copy() for array in self._arrays))

    @contextlib.contextmanager
    def as_of(self, earlier: Snapshot) -> Iterator[None]:
        """Return to an earlier state while the body of the `with` statement runs."""
        now = self.snapshot()
        self._load(earlier)
        try:
            yield
        finally:
            self._load(now)

    def _load(self, snapshot: Snapshot) -> None:
        self.feedback = snapshot.feedback
        for array, copy in zip(self._arrays, snapshot.arrays, strict=True):
            array[:] = copy

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.record, self.numbers, self.jumping, self.settling.monitored

    def pose_of(self, sliders: Triple) -> Triple | None:
        """Return the pose that matches slider setpoints, on the branch of the latest pose; None if no pose matches."""
        self.scratch[:] = sliders, self.pose
        self.scratch[0] -= self.backlash[0]["offset"]
        if forward_into(self.legs, self.scratch[0], self.scratch[1], self.scratch[1]):
            return None
        x, y, phi = self.scratch[1].tolist()
        return x, y, phi

    def _pack(self, feedback: Feedback) -> None:
        self.feedback = feedback
        pack_feedback(feedback, self.numbers, self.record)

    def _recorded(self, field: str) -> Triple:
        x, y, z = self.record[field][0].tolist()
        return x, y, z
