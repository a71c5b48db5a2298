"""Setpoints of three ODrives, and the ramp of these setpoints in a quick stop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from trirail_drivers.bus.can_frame import DATA_AT
from trirail_drivers.bus.packed_frames import PackedFrames
from trirail_drivers.bus.wire import Wire
from trirail_drivers.driver.ramp import brake
from trirail_drivers.driver.row_updates import put_setpoint, scale_setpoint
from trirail_drivers.interface import Triple
from trirail_drivers.odrive.axis import OdriveAxis

SETTLE_TIME_S: Final = 0.05
"""Time at the end of a quick stop during which the setpoints are constant, before power is removed [s]. The servos need
this time to reach their setpoints.
"""


class SetpointSender:
    """Sender of the written setpoints, and of the ramp of a quick stop.

    Each axis stores the setpoint written last, the setpoint sent last, and the position that the bus accepted last.
    """

    def __init__(self, axes: Sequence[OdriveAxis], frames: PackedFrames, wire: Wire, deceleration: float) -> None:
        """`frames` are those of Set_Input_Pos, and `deceleration` is that of the quick-stop ramp [m/s²]."""
        self.period = 0.0
        """Cycle period [s]."""
        self._axes = axes
        self._frames = frames
        self._wire = wire
        self._deceleration = deceleration
        self._standstill_time: float | None = None
        """Time since the ramp of a quick stop came to rest [s]; None if no quick stop is in progress."""

    @property
    def stopping(self) -> bool:
        """Whether a quick stop is in progress."""
        return self._standstill_time is not None

    @property
    def written(self) -> bool:
        """Whether setpoints are waiting for the next SYNC."""
        return not math.isnan(self._axes[0].wanted)

    @property
    def sent(self) -> bool:
        """Whether the drives have received setpoints since they were enabled."""
        return not math.isnan(self._axes[0].sent)

    def forget(self) -> None:
        """Forget the setpoints sent, and abandon a ramp, since the drives get or lose their power.

        A drive that then has power by itself must not be sent to an earlier position.
        """
        self._standstill_time = None
        for axis in self._axes:
            axis.sent = axis.sent_rate = axis.in_force = math.nan

    def set_next(self, position: Triple, velocity: Triple) -> OdriveAxis | None:
        """Store setpoints for the next SYNC.

        Return the first axis whose setpoint does not fit into a message, or None.
        """
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            if not scale_setpoint(axis, metres, rate):
                return axis
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            axis.wanted, axis.wanted_rate = metres, rate
        return None

    def step(self, enabled: bool, sent: int = 0) -> int:
        """Send the setpoints that are due at a SYNC; return their number.

        The first `sent` setpoints are already on the bus and are not sent again.
        """
        self._brake()
        # Disabled drives are sent no setpoints: a drive that missed the command must stay where the ramp ended.
        if self.written and (enabled or self.stopping):
            self._send([(axis.wanted, axis.wanted_rate) for axis in self._axes], sent)
            return len(self._axes)
        return 0

    def stop(self) -> None:
        """Begin the ramp of a quick stop now; the drives must have received setpoints."""
        self._standstill_time = 0.0
        # The position setpoint does not change yet; the velocity feed-forward decreases from now on.
        self._send([(axis.in_force, self._braked_setpoint(axis)[1]) for axis in self._axes])
        for axis in self._axes:
            axis.wanted = math.nan

    def _send(self, setpoints: Sequence[tuple[float, float]], sent: int = 0) -> None:
        """Send setpoints except the first `sent`, which are already on the bus. Each takes effect when it arrives.

        A drive that has returned is sent none, since its positions may count from another place.
        """
        for axis, (metres, rate) in zip(self._axes, setpoints, strict=True):
            axis.sent, axis.sent_rate = metres, rate
            if math.isnan(axis.in_force):
                axis.in_force = metres
        stopping = self.stopping
        for number, (axis, (metres, rate)) in enumerate(zip(self._axes, setpoints, strict=True)):
            if axis.has_returned:
                continue
            scale_setpoint(axis, metres, rate)
            put_setpoint(axis, self._frames.frames[number, DATA_AT:])
            if number < sent or self._wire.send(self._frames.frame(number)):
                axis.in_force = metres
            else:
                axis.setpoints_lost += 1
            if self.stopping != stopping:
                return  # a failed send has begun a quick stop, whose setpoints are newer

    def _brake(self) -> None:
        """Advance the ramp of a quick stop by one period. When it has ended, end the quick stop; then power is removed.

        While the bus accepts no setpoints, the velocity of the ramp decreases but its position does not change. A drive
        without setpoints soon stops, and must not catch up with the ramp when the bus works again.
        """
        if self._standstill_time is None:
            return
        moving = any(axis.sent_rate for axis in self._axes)
        for axis in self._axes:
            axis.wanted, axis.wanted_rate = self._braked_setpoint(axis)
        if moving:
            return
        self._standstill_time += self.period
        if self._standstill_time > SETTLE_TIME_S:
            self.forget()

    def _braked_setpoint(self, axis: OdriveAxis) -> tuple[float, float]:
        """Return the ramp's next setpoint, one period after the position that the bus accepted last."""
        return brake(axis.in_force, axis.sent_rate, self._deceleration, self.period)
