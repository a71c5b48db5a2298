"""Description of ODrive's protocol CANSimple."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from trirail_drivers import config
from trirail_drivers.bus.load import TrafficPlan
from trirail_drivers.driver.axis import MISSED_HEARTBEATS
from trirail_drivers.odrive import cansimple, checks, flat_endpoints
from trirail_drivers.odrive.drives import Odrive
from trirail_drivers.odrive.other_masters import check_exclusive
from trirail_drivers.odrive.protections import PROTECTIONS, describe_protection
from trirail_drivers.protocols.protocol import Protocol
from trirail_drivers.simulated import Frames, Servo, SimulatedDevice, SimulatedOdrive
from trirail_drivers.timing import BusTiming

FRICTION: Final = 2.0
"""Deceleration of a simulated ODrive's slider while it coasts [m/s²]."""
_NODE: Final = cansimple.identifier(1, 0)
"""Difference between the CAN identifiers of consecutive node ids."""


def _simulated_drive(
    simulated: config.Simulated, drives: config.Drives, drive: config.Drive, start: float
) -> SimulatedDevice:
    turns = drive.direction * (start - drive.offset) * drive.counts_per_metre
    device = SimulatedOdrive(
        drive.node,
        Servo.configured(simulated, drive, turns),
        heartbeat=drives.heartbeat,
        friction=FRICTION * drive.counts_per_metre,
        # A CiA 402 drive waits for its master as long as this. CANSimple has no message that sets the time.
        watchdog=MISSED_HEARTBEATS * drives.heartbeat,
    )
    if drive.endpoints is not None:
        device.tables = flat_endpoints.read(f"node {drive.node}", Path(drive.endpoints)), *device.tables
    return device


def _plan_traffic(
    drives: config.Drives,  # noqa: ARG001  one signature for all
    io: Sequence[config.DigitalIo],  # noqa: ARG001
    rate_hz: float,  # noqa: ARG001
    timing: BusTiming,  # noqa: ARG001
) -> TrafficPlan:
    """Return the traffic of ODrives, which does not depend on the configuration."""
    return TrafficPlan(cansimple.TRAFFIC)


ODRIVE = Protocol(
    name="odrive",
    driver=Odrive,
    rules=checks.rules,
    files=checks.files,
    traffic=cansimple.TRAFFIC,
    plan_traffic=_plan_traffic,
    simulated_drive=_simulated_drive,
    inspect=None,
    inputs=None,
    check_exclusive=check_exclusive,
    save=None,
    restore=None,
    protections={name: describe_protection(name) for name in PROTECTIONS},
    without_io="CANSimple has no message for an ODrive's GPIO",
    without_fd="the driver requests each position by a remote frame, which CAN FD does not have",
    states=lambda node: {
        cansimple.identifier(node, cansimple.HEARTBEAT),
        cansimple.identifier(node, cansimple.GET_ENCODER_ESTIMATES),
    },
    sync=None,
    setpoints=range(0),
    fault_frames={  # named as in the manual
        "set_axis_state": Frames(True, cansimple.SET_AXIS_STATE, _NODE),
        "set_controller_mode": Frames(True, cansimple.SET_CONTROLLER_MODE, _NODE),
        "set_input_pos": Frames(True, cansimple.SET_INPUT_POS, _NODE),
        "clear_errors": Frames(True, cansimple.CLEAR_ERRORS, _NODE),
        "position-request": Frames(True, cansimple.GET_ENCODER_ESTIMATES, _NODE),
        "rxsdo": Frames(True, cansimple.RX_SDO, _NODE),
        "get_version": Frames(False, cansimple.GET_VERSION, _NODE),
        "get_error": Frames(False, cansimple.GET_ERROR, _NODE),
        "get_encoder_estimates": Frames(False, cansimple.GET_ENCODER_ESTIMATES, _NODE),
        "txsdo": Frames(False, cansimple.TX_SDO, _NODE),
        "heartbeat": Frames(False, cansimple.HEARTBEAT, _NODE),
    },
)
"""CANSimple of ODrive, in position control."""
