"""What three ODrives are to follow, and the ramp down which a quick stop leads it."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

from trirail_drivers.bus.wire import Wire
from trirail_drivers.driver.ramp import braked
from trirail_drivers.interface import Triple
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import OdriveAxis

SETTLING: Final = 0.05
"""How long a drive holds at the end of a quick stop before its power is taken off, for its servo to catch up [s]."""


class SetpointSender:
    """Sends the setpoints that were written; these, those sent last and the positions in force are in the axes."""

    def __init__(self, axes: Sequence[OdriveAxis], wire: Wire, deceleration: float) -> None:
        """`deceleration` is that of the quick-stop ramp [m/s²]."""
        self.period = 0.0
        """Of the cycle [s]."""
        self._axes = axes
        self._wire = wire
        self._deceleration = deceleration
        self._braking: float | None = None
        """Time since a quick stop has brought the setpoints to a standstill [s]; None where none is under way."""

    @property
    def stopping(self) -> bool:
        """Whether a quick stop is under way."""
        return self._braking is not None

    @property
    def written(self) -> bool:
        """Whether setpoints are to be sent at the next SYNC."""
        return not math.isnan(self._axes[0].wanted)

    @property
    def sent(self) -> bool:
        """Whether drives have been sent setpoints since enabling."""
        return not math.isnan(self._axes[0].sent)

    def begin(self) -> None:
        """Forget what was sent before the drives are to get power."""
        self._braking = None
        for axis in self._axes:
            axis.sent = axis.sent_rate = axis.in_force = math.nan

    def set_next(self, position: Triple, velocity: Triple) -> OdriveAxis | None:
        """Take what is to be sent at the next SYNC; the axis whose message cannot hold it, if there is one."""
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            if not _is_sendable(axis, metres, rate):
                return axis
        for axis, metres, rate in zip(self._axes, position, velocity, strict=True):
            axis.wanted, axis.wanted_rate = metres, rate
        return None

    def step(self, enabled: bool, sent: int = 0) -> int:
        """Send what is due at a SYNC, where somebody else has sent so many frames; return how many frames are due."""
        if self._braking is not None:
            self._brake()
        # Without power none is sent: a drive that has missed losing it is to stay where the ramp has ended.
        if self.written and (enabled or self.stopping):
            self._send([(axis.wanted, axis.wanted_rate) for axis in self._axes], sent)
            return len(self._axes)
        return 0

    def stop(self) -> None:
        """Begin to lead the drives down the ramp, now; they must have been sent setpoints."""
        if not self.sent:
            return
        self._braking = 0.0
        # The position in force stays; what the drives are to run on with is less from now on.
        self._send([(axis.in_force, self._braked(axis)[1]) for axis in self._axes])
        for axis in self._axes:
            axis.wanted = math.nan

    def abandon(self) -> None:
        """Lead the drives down the ramp no longer."""
        self._braking = None

    def _send(self, setpoints: Sequence[tuple[float, float]], taken: int = 0) -> None:
        """Send setpoints, but for so many that the bus has taken; each is in force when it arrives."""
        for axis, (metres, rate) in zip(self._axes, setpoints, strict=True):
            axis.sent, axis.sent_rate = metres, rate
            if math.isnan(axis.in_force):
                axis.in_force = metres
        stopping = self.stopping
        for number, (axis, (metres, rate)) in enumerate(zip(self._axes, setpoints, strict=True)):
            data = axis.input_pos(metres, rate)
            if number < taken or self._wire.send(cansimple.command(axis.node, cansimple.SET_INPUT_POS, data)):
                axis.in_force = metres
            else:
                axis.setpoints_lost += 1
            if self.stopping != stopping:
                return  # what could not be sent has begun a quick stop, whose setpoints are newer

    def _brake(self) -> None:
        """One period further down the ramp; at its end, power off.

        Where the bus takes no setpoint the time goes on, but the place does not: a drive that hears nothing stands
        soon, and is not to catch up with the ramp when the bus is back.
        """
        if not self.sent or self._braking is None:
            return
        moving = any(axis.sent_rate for axis in self._axes)
        for axis in self._axes:
            axis.wanted, axis.wanted_rate = self._braked(axis)
        if moving:
            return
        self._braking += self.period
        if self._braking > SETTLING:
            self._braking = None

    def _braked(self, axis: OdriveAxis) -> tuple[float, float]:
        """The setpoint one period further down the ramp from that in force, of the velocity sent last."""
        return braked(axis.in_force, axis.sent_rate, self._deceleration, self.period)


def _is_sendable(axis: OdriveAxis, metres: float, rate: float) -> bool:
    try:
        axis.input_pos(metres, rate)
    except (ValueError, OverflowError, struct.error):
        return False
    return math.isfinite(metres)  # a float that is not a number is packed like any other
