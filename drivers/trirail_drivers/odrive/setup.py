"""Finds the ODrives on the bus, takes their power off and reads how they are set, before the cycle runs.

Nothing is written: a drive must have been given by ODrive's own tools, and have saved,

- `axis0.config.can.node_id`, `heartbeat_msg_rate_ms` as [drives] says, `encoder_msg_rate_ms = 0` and the other cyclic
  messages off: the driver asks for what it needs, and nothing else takes a share of the bus;
- `axis0.config.can.input_vel_scale = 1000`, which is the default;
- `axis0.config.enable_watchdog = True` with a `watchdog_timeout` that bridges a few cycles. It is all that disarms a
  drive whose host is gone, and every setpoint feeds it;
- its gains, velocity and current limits, and a calibrated encoder whose position survives power-off.

All but the last are read by RxSdo and TxSdo, and count as protections, see trirail_drivers.odrive.protections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.bus.wire import Wire
from trirail_drivers.config import Drives
from trirail_drivers.driver.axis import MISSED_HEARTBEATS
from trirail_drivers.driver.refusals import judged, raise_all
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import NAMES, Clock
from trirail_drivers.odrive import cansimple, settings
from trirail_drivers.odrive.asking import late
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.cansimple import AxisState
from trirail_drivers.odrive.protections import PROTECTIONS, Settings, check_watchdog, lacking

OLDEST_FIRMWARE = (0, 6, 0)
"""Since then errors and heartbeats are laid out as this driver reads them."""


def check_nodes(drives: Drives) -> None:
    """Refuse node ids that CANSimple does not have, or that two drives share, with DriveError."""
    nodes = {f"drives.{name}.node": drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    for key, node in nodes.items():
        if node not in cansimple.NODES:
            raise DriveError(f"{key} = {node}: an ODrive has 0 to {cansimple.NODES[-1]}")
    if len(set(nodes.values())) < len(nodes):
        raise DriveError(f"node ids must differ, but are {', '.join(f'{key} = {node}' for key, node in nodes.items())}")


class Allowed(NamedTuple):
    """What a drive does without, as its configuration allows."""

    name: str
    lacking: tuple[str, ...]
    """Protections, as `accept_without` names them."""
    notes: tuple[str, ...]
    """Lines for people."""


def configure(
    wire: Wire, axes: Sequence[OdriveAxis], drives: Drives, period: float, clock: Clock
) -> tuple[Allowed, ...]:
    """Take power off, and see that every drive answers, lives, is set as it must be and knows its position.

    Raises DriveError; of its kinds, DriveTimeout for a drive that does not answer. Errors of a drive are none here.
    """
    for axis in axes:
        send_in_setup(
            wire.bus, cansimple.command(axis.node, cansimple.SET_AXIS_STATE, cansimple.AXIS_STATE.pack(AxisState.IDLE))
        )
        axis.note_request(AxisState.IDLE)
        axis.sync_sent()
        for number in (cansimple.GET_VERSION, cansimple.GET_ERROR, cansimple.GET_ENCODER_ESTIMATES):
            send_in_setup(wire.bus, cansimple.request(axis.node, number))
    for axis in late(wire, axes, clock, drives.sdo_timeout, _missing):
        raise DriveTimeout(axis.name, f"answer to {_missing(axis)}", drives.sdo_timeout)
    for axis in axes:
        _check(axis)
    done = _judge(axes, settings.read(wire, axes, drives, clock), drives, period)
    timeout = MISSED_HEARTBEATS * drives.heartbeat
    for axis in late(wire, axes, clock, timeout, _not_idle):
        if axis.state == AxisState.UNDEFINED:
            raise DriveTimeout(axis.name, "heartbeat (heartbeat_msg_rate_ms)", timeout)
        raise DriveError(
            f"drive {axis.name}: keeps its power on when told off (it is in {cansimple.state_name(axis.state)})"
        )
    return done


def _judge(
    axes: Sequence[OdriveAxis], found: Sequence[Settings | None], drives: Drives, period: float
) -> tuple[Allowed, ...]:
    """Refuse drives whose settings are not as they must be, all in one; tell what their configuration accepts."""
    done, refused = [], []
    for axis, drive, read in zip(axes, drives.each, found, strict=True):
        lacks = lacking(read, drives)
        why, notes = judged(axis.name, lacks, drive.accept_without, PROTECTIONS)
        refused += [DriveError(why)] if why else []
        try:
            check_watchdog(axis.name, read, period)
        except DriveError as error:
            refused.append(error)
        done.append(Allowed(axis.name, tuple(lacks), tuple(notes)))
    raise_all(refused)
    return tuple(done)


def _missing(axis: OdriveAxis) -> str:
    """What the drive has not answered yet, or ""."""
    if axis.version is None:
        return "Get_Version"
    if not axis.reported:
        return "Get_Error"
    return "Get_Encoder_Estimates" if axis.age else ""


def _not_idle(axis: OdriveAxis) -> bool:
    return axis.state != AxisState.IDLE


def _check(axis: OdriveAxis) -> None:
    if axis.version is not None and axis.version.firmware < OLDEST_FIRMWARE:
        raise DriveError(f"drive {axis.name}: it has {axis.version.words}; wanted firmware 0.6.0 or newer")
    if axis.event is not None:
        raise DriveError(axis.event.message)
