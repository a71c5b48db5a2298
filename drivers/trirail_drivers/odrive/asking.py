"""Sends to ODrives and waits for what they answer, before the cycle runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import can

from trirail_drivers.bus.wire import Wire
from trirail_drivers.errors import BusError
from trirail_drivers.interface import Clock
from trirail_drivers.odrive.axis import OdriveAxis


def late(
    wire: Wire, axes: Sequence[OdriveAxis], clock: Clock, seconds: float, lacks: Callable[[OdriveAxis], object]
) -> list[OdriveAxis]:
    """Take in frames until no drive lacks anything; those that still do when the time is over."""
    deadline = clock() + seconds
    while (lacking := [axis for axis in axes if lacks(axis)]) and (left := deadline - clock()) > 0.0:
        try:
            wire.wait(left, clock)
        except (can.CanError, OSError) as error:
            raise BusError(f"cannot receive on {wire.bus.channel_info}: {error}") from error
    return lacking
