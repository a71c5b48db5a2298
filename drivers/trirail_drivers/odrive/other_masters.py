"""Detection of messages that only the master of the drives may send (CANSimple).

The service is the master. If it receives such a message, another program commands the drives, and the robot stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import can

from trirail_drivers.bus.wire import Handler, Wire
from trirail_drivers.config import Drives
from trirail_drivers.driver.exclusive_bus import Recognition, check_unused
from trirail_drivers.interface import Clock, DriveFault
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import OdriveAxis

_COMMANDS: Final = {
    cansimple.ESTOP: "sends Estop",
    cansimple.RX_SDO: "writes or reads parameters",
    cansimple.SET_AXIS_STATE: "commands axis states",
    cansimple.SET_CONTROLLER_MODE: "sets controller modes",
    cansimple.SET_INPUT_POS: "sends setpoints",
    cansimple.CLEAR_ERRORS: "clears errors",
    # Set_Input_Vel to Set_Limits, Set_Traj_Vel_Limit to Set_Traj_Inertia, Reboot, Set_Absolute_Position to
    # Set_Vel_Gains, and Enter_DFU_Mode, which this service never sends.
    0x0D: "sends velocities",
    0x0E: "sends torques",
    0x0F: "sets limits",
    0x11: "sets trajectory limits",
    0x12: "sets trajectory limits",
    0x13: "sets the inertia",
    0x16: "restarts drives",
    0x19: "sets positions",
    0x1A: "sets gains",
    0x1B: "sets gains",
    0x1F: "updates firmware",
}
"""Messages to a drive that are no requests, by their commands."""
_REQUESTS: Final = (cansimple.GET_ENCODER_ESTIMATES, cansimple.GET_ERROR)
"""Messages that a service requests in its cycles by remote frames."""


def listen_for_masters(wire: Wire, axes: Sequence[OdriveAxis]) -> None:
    """Latch a fault if another program sends a command to a drive."""

    def handler(name: str, text: str) -> Handler:
        fault = f"CAN bus: another master is on the bus and {text} (drive {name}); only one master is allowed"
        return lambda data, now: wire.fail(DriveFault("", "bus", 0, fault))  # noqa: ARG005  one signature for all

    for axis in axes:
        for number, text in _COMMANDS.items():
            wire.listen(cansimple.identifier(axis.node, number), axis, handler(axis.name, text))


def master_frames(drives: Drives) -> Recognition:
    """Return a function that recognises the messages of another master."""
    nodes = [drive.node for drive in drives.each]
    commands = {cansimple.identifier(node, number): text for node in nodes for number, text in _COMMANDS.items()}
    requests = {cansimple.identifier(node, number) for node in nodes for number in _REQUESTS}

    def recognise(frame: can.Message) -> str:
        if frame.is_remote_frame:
            return "requests values of drives" if frame.arbitration_id in requests else ""
        return commands.get(frame.arbitration_id, "")

    return recognise


def check_exclusive(bus: can.BusABC, drives: Drives, clock: Clock) -> None:
    """Raise DriveError if another master sends a message before the drives are set up."""
    check_unused(bus, clock, master_frames(drives))
