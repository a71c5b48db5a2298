"""Finds the ODrives on the bus and takes their power off, before the cycle runs.

CANSimple cannot read a drive's configuration back, nor set most of it: the numbers of its parameters differ from one
firmware to the next. So this is what a drive must have been given by ODrive's own tools, and saved:

- `axis0.config.can.node_id`, `heartbeat_msg_rate_ms` as [drives] says, `encoder_msg_rate_ms = 0` and the other cyclic
  messages off: the driver asks for what it needs, and nothing else takes a share of the bus;
- `axis0.config.can.input_vel_scale = 1000`, which is the default;
- `axis0.config.enable_watchdog = True` with a `watchdog_timeout` that bridges a few cycles. It is all that disarms a
  drive whose host is gone, and every setpoint feeds it;
- its gains, velocity and current limits, and a calibrated encoder whose position survives power-off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import can

from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.wire import Wire
from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import MISSED_HEARTBEATS
from trirail_drivers.errors import BusError, DriveError, DriveTimeout
from trirail_drivers.interface import Clock
from trirail_drivers.odrive import frames
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.frames import AxisState

OLDEST_FIRMWARE = (0, 6, 0)
"""Since then errors and heartbeats are laid out as this driver reads them."""


def check_nodes(drives: Drives) -> None:
    """Refuse node ids that CANSimple does not have, or that two drives share, with DriveError."""
    nodes = [drive.node for drive in drives.each]
    if len(set(nodes)) < len(nodes) or not all(node in frames.NODES for node in nodes):
        raise DriveError(
            f"node ids of ODrives A, B and C must differ and be 0 to {frames.NODES[-1]}, "
            f"but are {', '.join(map(str, nodes))}"
        )


def configure(wire: Wire, axes: Sequence[OdriveAxis], drives: Drives, clock: Clock) -> None:
    """Take power off, and see that every drive answers, lives, is of a known firmware and knows its position.

    Raises DriveError; of its kinds, DriveTimeout for a drive that does not answer. Errors of a drive are none here.
    """
    for axis in axes:
        _send(wire, frames.command(axis.node, frames.SET_AXIS_STATE, frames.AXIS_STATE.pack(AxisState.IDLE)))
        axis.ask(AxisState.IDLE)
        axis.answers.sync_sent()
        for number in (frames.GET_VERSION, frames.GET_ERROR, frames.GET_ENCODER_ESTIMATES):
            _send(wire, frames.request(axis.node, number))
    for axis in _late(wire, axes, clock, drives.sdo_timeout, _missing):
        raise DriveTimeout(axis.name, f"answer to {_missing(axis)}", drives.sdo_timeout)
    for axis in axes:
        _check(axis)
    timeout = MISSED_HEARTBEATS * drives.heartbeat
    for axis in _late(wire, axes, clock, timeout, _not_idle):
        if axis.state == AxisState.UNDEFINED:
            raise DriveTimeout(axis.name, "heartbeat (heartbeat_msg_rate_ms)", timeout)
        raise DriveError(
            f"drive {axis.name}: keeps its power on when told off (it is in {frames.state_name(axis.state)})"
        )


def _missing(axis: OdriveAxis) -> str:
    """What the drive has not answered yet, or ""."""
    if axis.firmware is None:
        return "Get_Version"
    if not axis.told:
        return "Get_Error"
    return "Get_Encoder_Estimates" if axis.answers.age else ""


def _not_idle(axis: OdriveAxis) -> bool:
    return axis.state != AxisState.IDLE


def _check(axis: OdriveAxis) -> None:
    if axis.firmware is not None and axis.firmware < OLDEST_FIRMWARE:
        raise DriveError(
            f"drive {axis.name}: its firmware is {'.'.join(map(str, axis.firmware))}; wanted 0.6.0 or newer"
        )
    if axis.event is not None:
        raise DriveError(axis.event.message)


def _late(
    wire: Wire, axes: Sequence[OdriveAxis], clock: Clock, seconds: float, lacks: Callable[[OdriveAxis], object]
) -> list[OdriveAxis]:
    """Take in frames until no drive lacks anything; those that still do when the time is over."""
    deadline = clock() + seconds
    while (late := [axis for axis in axes if lacks(axis)]) and (left := deadline - clock()) > 0.0:
        try:
            wire.wait(left, clock)
        except (can.CanError, OSError) as error:
            raise BusError(f"cannot receive on {wire.bus.channel_info}: {error}") from error
    return late


def _send(wire: Wire, frame: Frame) -> None:
    try:
        wire.bus.send(frame.message())
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot send on {wire.bus.channel_info}: {error}; is the interface up?") from error
