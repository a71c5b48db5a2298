"""Description of the protocol CiA 402 on CANopen."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Final

from trirail_drivers import config
from trirail_drivers.cia402 import canopen_frames, checks, process_data, units
from trirail_drivers.cia402.backup import restore, save
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.cia402.inspection import inputs, inspect
from trirail_drivers.cia402.objects import PROTECTIONS, describe_protection
from trirail_drivers.cia402.other_masters import check_exclusive
from trirail_drivers.protocols.protocol import Protocol
from trirail_drivers.simulated import EDS, Frames, Mechanics, Servo, SimulatedDevice, SimulatedDrive

FRICTION: Final = 5.0
"""Deceleration of a simulated slider without power, by friction and the brake of its drive [m/s²]."""


def _simulated_drive(
    simulated: config.Simulated,
    drives: config.Drives,  # noqa: ARG001  one signature for all
    drive: config.Drive,
    start: float,
) -> SimulatedDevice:
    """Return a simulated drive.

    The counter of a drive with homing starts at 0 at power-on, and its switch is where [drives] has zero counts.
    Without the manufacturer's EDS, the drive has the objects that the configuration writes, but without any function.
    """
    counts = round(drive.direction * (start - drive.offset) * drive.counts_per_metre)
    switch = None if drive.homing is None else -counts
    servo = Servo.configured(simulated, drive, counts if switch is None else 0)
    eds = Path(drive.eds) if drive.eds is not None else EDS
    friction = FRICTION * drive.counts_per_metre
    device = SimulatedDrive(drive.node, servo, simulated.missed_syncs, switch, eds, mechanics_of(drive), friction)
    for each in drive.write if drive.eds is None else ():
        device.objects.add(each.object, each.sub, each.bits, signed=each.signed)
    return device


def mechanics_of(drive: config.Drive) -> Mechanics:
    """Return the mechanics of the configured axis, and the units that the drive's dictionary does not report."""
    counts, revolutions = drive.counts_per_metre, drive.revolutions_per_metre

    def fixed(key: str, text: str | None, power: int) -> float:
        per_metre = units.parse_unit(key, text, power).per_metre(counts, revolutions) if text is not None else None
        return counts / per_metre if per_metre is not None else 1.0

    configured = ((0x60A9, drive.velocity_unit), (0x60AA, drive.acceleration_unit))
    return Mechanics(
        counts_per_metre=counts,
        counts_per_revolution=math.nan if revolutions is None else counts / revolutions,
        velocity=fixed("velocity_unit", drive.velocity_unit, 1),
        acceleration=fixed("acceleration_unit", drive.acceleration_unit, 2),
        # Without the manufacturer's EDS, this simulates a drive that does not report the configured units.
        untold=tuple(index for index, unit in configured if unit is not None and drive.eds is None),
    )


CIA402 = Protocol(
    name="cia402",
    driver=Cia402,
    rules=checks.rules,
    files=checks.files,
    traffic=canopen_frames.TRAFFIC,
    plan_traffic=process_data.plan_traffic,
    simulated_drive=_simulated_drive,
    inspect=inspect,
    inputs=inputs,
    check_exclusive=check_exclusive,
    save=save,
    restore=restore,
    protections={name: describe_protection(name) for name in PROTECTIONS},
    without_io="",
    without_fd="",
    states=lambda node: {canopen_frames.TPDO1 + node, canopen_frames.TPDO2 + node},
    sync=canopen_frames.SYNC,
    setpoints=range(canopen_frames.RPDO1, canopen_frames.SDO_ANSWER),  # a drive may use any of its RPDOs
    fault_frames={
        "nmt": Frames(True, canopen_frames.NMT),
        "sync": Frames(True, canopen_frames.SYNC),
        "rpdo1": Frames(True, canopen_frames.RPDO1, 1),
        "rpdo2": Frames(True, canopen_frames.RPDO2, 1),
        "rpdo3": Frames(True, canopen_frames.RPDO3, 1),
        "sdo-request": Frames(True, canopen_frames.SDO_REQUEST, 1),
        "emcy": Frames(False, canopen_frames.EMCY, 1),
        "tpdo1": Frames(False, canopen_frames.TPDO1, 1),
        "tpdo2": Frames(False, canopen_frames.TPDO2, 1),
        "tpdo3": Frames(False, canopen_frames.TPDO3, 1),
        "sdo-answer": Frames(False, canopen_frames.SDO_ANSWER, 1),
        "heartbeat": Frames(False, canopen_frames.HEARTBEAT, 1),
    },
)
"""CiA 402 on CANopen, in cyclic synchronous position mode."""
