"""Detection of frames that only the master of the bus may send (CiA 301).

The service is the master. If it receives such a frame, there is another master on the bus, and the robot stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Final

import can

from trirail_drivers.bus.wire import Handler, Wire
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.config import Drives
from trirail_drivers.driver.exclusive_bus import ExclusiveBus, Recognition, check_unused, watched_bus
from trirail_drivers.interface import Clock, DriveFault

_COMMANDS: Final = {
    0x01: "start",
    0x02: "stop",
    0x80: "enter pre-operational",
    0x81: "reset node",
    0x82: "reset communication",
}
_NMT_START: Final = 0x01
_NMT_STOP: Final = 0x02
_DOWNLOADS: Final = (1, 6)
"""Client command specifiers, bits 5 to 7 of the first byte of an SDO request, which begin a download (CiA 301)."""


class OtherMasters:
    """Detection of other masters on the bus by frames that only this service may send.

    These frames are NMT commands, SYNC, PDOs and SDO downloads to the drives, and heartbeats with this service's node
    id. The bus does not return the frames that this service sends.
    """

    def __init__(self, wire: Wire, axes: Sequence[Cia402Axis], master_node: int) -> None:
        self._wire = wire
        self._axes = {axis.node: axis for axis in axes}
        self._master_node = master_node
        wire.listen(canopen_frames.NMT, self, self._on_nmt)
        wire.listen(canopen_frames.SYNC, self, self._sends("sends SYNC"))
        wire.listen(canopen_frames.HEARTBEAT + master_node, self, self._on_heartbeat)
        for axis in axes:
            wire.listen(canopen_frames.SDO_REQUEST + axis.node, self, partial(self._on_sdo_request, axis.name))
            self.listen_to(axis)

    def listen_to(self, axis: Cia402Axis) -> None:
        """Listen for setpoints, controlwords and outputs that another sender sends to a drive."""
        exchange = axis.exchange
        for identifier in {exchange.setpoints.identifier, exchange.controlword, exchange.outputs} - {None}:
            self._wire.listen(identifier or 0, self, self._sends(f"sends drive {axis.name} PDOs ({identifier:03X})"))

    def note_fault(self, cause: str, code: int, text: str) -> None:
        """Latch a fault, because another master has sent a malformed frame."""
        self._wire.fail(DriveFault("", "bus", code, f"CAN bus: another master is on the bus: {text} ({cause})"))

    def _sends(self, text: str) -> Handler:
        return lambda data, now: self._warn(text)  # noqa: ARG005  one signature for all

    def _warn(self, text: str) -> None:
        self._wire.fail(
            DriveFault("", "bus", 0, f"CAN bus: another master is on the bus and {text}; only one master is allowed")
        )

    def _on_nmt(self, data: bytearray, now: float) -> None:  # noqa: ARG002  one signature for all
        command, node = canopen_frames.NMT_COMMAND.unpack(data)
        addressed = [axis for each, axis in self._axes.items() if node in (0, each)]
        if not addressed:
            return
        if command != _NMT_START:
            for axis in addressed:
                axis.leave_operational()
                axis.stopped = command == _NMT_STOP
        name = _COMMANDS.get(command, f"{command:02X}h")
        whom = "all nodes" if node == 0 else f"drive {addressed[0].name}"
        self._warn(f'commands {whom} by NMT "{name}"')

    def _on_sdo_request(self, name: str, data: bytearray, now: float) -> None:  # noqa: ARG002
        """Handle an SDO request of another client. A program that only reads values does not disturb the robot."""
        if data and data[0] >> 5 in _DOWNLOADS:
            self._warn(f"writes to drive {name} by SDO")

    def _on_heartbeat(self, data: bytearray, now: float) -> None:  # noqa: ARG002
        canopen_frames.NMT_STATE.unpack(data)
        self._warn(f"has this service's node id {self._master_node}")


def master_frames(drives: Drives, *, allow_sync: bool = False) -> Recognition:
    """Return a function that recognises the frames of another master. With `allow_sync`, any node may send SYNC."""
    nodes, master_node = [drive.node for drive in drives.each], drives.master_node
    bases = {
        canopen_frames.SDO_REQUEST: "accesses drives by SDO",
        canopen_frames.RPDO1: "sends PDOs",
        canopen_frames.RPDO2: "sends PDOs",
    }
    masters = {base + node: text for base, text in bases.items() for node in nodes}
    masters[canopen_frames.NMT] = "commands by NMT"
    if not allow_sync:
        masters[canopen_frames.SYNC] = "sends SYNC"
    masters[canopen_frames.HEARTBEAT + master_node] = f"sends the heartbeat of node {master_node}"
    guarded = {canopen_frames.HEARTBEAT + node for node in nodes}

    def recognise(frame: can.Message) -> str:
        if frame.is_remote_frame and frame.arbitration_id in guarded:
            return "polls drives by node guarding"
        return masters.get(frame.arbitration_id, "")

    return recognise


def exclusive_bus(
    bus: can.BusABC, drives: Drives, clock: Clock, *, allow_sync: bool = False
) -> AbstractContextManager[ExclusiveBus]:
    """Listen for another master without sending a frame, and return a bus that continues to watch for one.

    With `allow_sync`, SYNC may come from other nodes. Raises DriveError if another master sends a frame.
    """
    return watched_bus(bus, clock, master_frames(drives, allow_sync=allow_sync), 3.0 * drives.heartbeat)


def check_exclusive(bus: can.BusABC, drives: Drives, clock: Clock) -> None:
    """Raise DriveError if another master sends a frame before the drives are set up."""
    check_unused(bus, clock, master_frames(drives, allow_sync=True), 3.0 * drives.heartbeat)
