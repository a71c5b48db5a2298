"""Simulated CANopen device (CiA 301) with NMT, heartbeat, SYNC, PDO, SDO and EMCY, without a thread."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Final

from canopen import SdoAbortedError

from trirail_drivers.simulated.dictionary import INVALID_VALUE, Dictionary, ObjectEntry
from trirail_drivers.simulated.emergency import Emergencies
from trirail_drivers.simulated.errorcontrol import ErrorControl
from trirail_drivers.simulated.pdo import ReceivePdo, TransmitPdo
from trirail_drivers.simulated.sdo_queue import SdoQueue
from trirail_drivers.simulated.sdo_server import SdoServer

CONNECTION_LOST = 0x8100
HEARTBEAT_LOST = 0x8130
PDO_TOO_SHORT = 0x8210
PDO_TOO_LONG = 0x8220
SYNC_LENGTH = 0x8240

_SYNC = 0x080
_CAN_ID = 0x7FF
_NOT_VALID = 1 << 31
_MOST_PDOS = 512
_COMMUNICATION = range(0x1000, 0x2000)
_ALL = range(0x10000)


class Nmt(IntEnum):
    """NMT states, as encoded in a heartbeat."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


_ON_ERROR: Final = {0: Nmt.PRE_OPERATIONAL, 2: Nmt.STOPPED}
"""State that an OPERATIONAL device enters on a communication error, by the value of 1029h:01. With 1, it does not
change.
"""


def _emergency_id_written(entry: ObjectEntry, old: int) -> None:
    """Refuse another identifier while the EMCY exists, bit 31 = 0 (CiA 301, 1014h)."""
    if not old & _NOT_VALID and (entry.value ^ old) & ~_NOT_VALID:
        raise SdoAbortedError(INVALID_VALUE)


def _discard(can_id: int, data: bytes) -> None:
    """Drop a frame from a device that is not on a bus."""


class Device:
    """Simulated node on a CAN bus. Its owner passes frames and the time to it by calling `receive` and `poll`."""

    def __init__(self, node: int, eds: Path) -> None:
        self.node = node
        self.objects = Dictionary(eds, node)
        self.nmt = Nmt.INITIALISING
        self.fault = 0
        """Code of the error that the device profile has latched until a fault reset; 0 if there is none."""
        self.silent = False
        """Whether the wire is cut: the device receives and sends nothing, but keeps running."""
        self._now = 0.0
        self._up_to_date = False
        """Whether all work due at the present time has been done, and nothing has changed since then."""
        self._transmit: Callable[[int, bytes], None] = _discard
        self._handlers: dict[int, Callable[[bytes], None]] = {}
        self._emergency_id = self.objects.internal(0x1014, 0, 0x80 + node)
        self.errors = Emergencies(self.objects, self._send_emergency)
        self._sdo = SdoServer(self.objects, partial(self._send, 0x580 + node))
        self.sdo_requests = SdoQueue(self._sdo.request)
        self._rpdos = [ReceivePdo(self.objects, 0x1400 + n, 0x1600 + n, self._route) for n in self._pdos(0x1400)]
        self._tpdos = [TransmitPdo(self.objects, 0x1800 + n, 0x1A00 + n, self._route) for n in self._pdos(0x1800)]
        self._sync_rpdos: list[ReceivePdo] = []
        self._sync_tpdos: list[TransmitPdo] = []
        self._event_tpdos: list[TransmitPdo] = []
        self._error_control = ErrorControl(self.objects, self._master_lost, self._route)
        self._sync_due = math.inf
        self._last_sync = -math.inf
        self._sync_id = self.objects.internal(0x1005, 0, _SYNC)
        self._sync_period = self.objects.internal(0x1006, 0)
        self._sync_window = self.objects.internal(0x1007, 0)
        self._on_error = self.objects.internal(0x1029, 1)
        self.objects.on_write(0x1005, self._sync_written)
        self.objects.on_write(0x1014, _emergency_id_written)

    def _pdos(self, communication: int) -> list[int]:
        """Return the numbers of the PDOs that the EDS describes, counted from 0."""
        return [n for n in range(_MOST_PDOS) if (communication + n, 1) in self.objects]

    @property
    def emergencies(self) -> Emergencies:
        """Errors that the device reports by EMCY."""
        return self.errors

    def connect(self, transmit: Callable[[int, bytes], None], now: float) -> None:
        """Connect the device to a bus and switch the device on at time `now` [s].

        The device sends each frame by calling `transmit(can_id, data)`.
        """
        self._transmit = transmit
        self._now = now
        self._reset(_ALL)

    def restart(self, now: float) -> None:
        """Cycle the power supply at time `now` [s]."""
        self._now = now
        self._reset(_ALL)

    def receive(self, can_id: int, data: bytes, now: float) -> None:
        """Receive a data frame at time `now` [s]."""
        if can_id not in self._handlers or self.silent:
            return
        self.poll(now)  # work that was due before may decide whether the device accepts the frame
        handler = self._handlers.get(can_id)
        if handler is not None:
            handler(data)
            self._up_to_date = False
        if self._event_tpdos:
            self._send_events()

    def receive_remote(self, can_id: int, now: float) -> None:
        """Receive a remote frame at time `now` [s]; it requests a TPDO or guards the node."""
        if self.silent:
            return
        self.poll(now)
        self._up_to_date = False
        if can_id == 0x700 + self.node:
            answer = self._error_control.guarded(self.nmt, now)
            if answer is not None:
                self._send(can_id, answer)
                self._master_back()
        for pdo in self._tpdos:
            if self.nmt is Nmt.OPERATIONAL and pdo.valid and pdo.remote and pdo.can_id == can_id:
                self._send(can_id, pdo.pack())

    def poll(self, now: float) -> None:
        """Do the work due at time `now` [s]."""
        if now == self._now and self._up_to_date:
            return
        self._now, self._up_to_date = now, True
        if now >= self._sync_due:
            due, self._sync_due = self._sync_due, math.inf
            self.sync_lost(due)
        if self._error_control.poll(now):
            self._send(0x700 + self.node, bytes([self.nmt]))
        self.time_passed(now)
        if self.sdo_requests.poll(now):
            self._up_to_date = False
        if self._event_tpdos:
            self._send_events()

    # Methods that a device profile overrides.

    def before_sync(self) -> None:
        """Update the values that TPDOs are about to sample, because a SYNC has arrived."""

    def time_passed(self, now: float) -> None:
        """Advance to time `now` [s]; called whether or not frames have arrived."""

    def sync_timeout(self) -> float:
        """Return the time-out for the next SYNC [s]; inf if there is none."""
        return math.inf

    def sync_lost(self, at: float) -> None:
        """Handle the loss of SYNC, which was due `at` this time [s], `sync_timeout` seconds after the last SYNC."""

    def connection_lost(self, code: int) -> None:
        """Handle the loss of the master, or the end of the NMT state OPERATIONAL. `code` is the EMCY error code."""

    def restarted(self) -> None:
        """Restart the device profile, after the objects have received their power-on values."""

    # NMT and heartbeat.

    def _reset(self, indices: range) -> None:
        """Reset the node (all objects) or the communication (1000h to 1FFFh), boot up, and enter PRE-OPERATIONAL."""
        if self.nmt is Nmt.OPERATIONAL:
            self.connection_lost(CONNECTION_LOST)
        self.nmt, self._up_to_date = Nmt.INITIALISING, False
        self.objects.restore(indices)
        if indices is _ALL:
            self._sync_due = math.inf
            self.restarted()
        self.errors.forget(but=self.fault)
        self._error_control.restart(self._now)
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.power_on()
        self._send(0x700 + self.node, bytes([Nmt.INITIALISING]))
        self._enter(Nmt.PRE_OPERATIONAL)

    def _nmt_command(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self.node):
            return
        match data[0]:
            case 1:
                self._enter(Nmt.OPERATIONAL)
            case 2:
                self._enter(Nmt.STOPPED)
            case 128:
                self._enter(Nmt.PRE_OPERATIONAL)
            case 129:
                self._reset(_ALL)
            case 130:
                self._reset(_COMMUNICATION)

    def _enter(self, state: Nmt) -> None:
        if state is self.nmt:
            return
        if self.nmt is Nmt.OPERATIONAL:
            self.connection_lost(CONNECTION_LOST)
        was, self.nmt = self.nmt, state
        self._sdo.reset()
        if state is Nmt.STOPPED or was is Nmt.INITIALISING:
            self.sdo_requests.clear()
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.reset()
        self._route()
        self.errors.suppress(state is Nmt.STOPPED)

    def _route(self) -> None:
        """Select the frames to accept (CiA 301, NMT states and communication object relation)."""
        operational = self.nmt is Nmt.OPERATIONAL
        rpdos = [pdo for pdo in self._rpdos if operational and pdo.valid and pdo.entries]
        tpdos = [pdo for pdo in self._tpdos if operational and pdo.valid and pdo.entries]
        handlers: dict[int, Callable[[bytes], None]] = {pdo.can_id: partial(self._receive_pdo, pdo) for pdo in rpdos}
        handlers[0x000] = self._nmt_command
        if self._error_control.watched is not None:
            handlers[0x700 + self._error_control.watched] = self._heartbeat
        if self.nmt is not Nmt.STOPPED:
            handlers[0x600 + self.node] = self._sdo_request
            handlers[self._sync_id.value & _CAN_ID] = self._sync
        self._sync_rpdos = [pdo for pdo in rpdos if pdo.synchronous]
        self._sync_tpdos = [pdo for pdo in tpdos if pdo.synchronous]
        self._event_tpdos = [pdo for pdo in tpdos if not pdo.synchronous]
        self._handlers = handlers

    def _sdo_request(self, data: bytes) -> None:
        self.sdo_requests.receive(data, self._now)

    def _heartbeat(self, _data: bytes) -> None:
        self._error_control.on_heartbeat(self._now)
        self._master_back()

    def _master_back(self) -> None:
        if self.fault != HEARTBEAT_LOST:
            self.errors.clear(HEARTBEAT_LOST)

    def _master_lost(self) -> None:
        self.errors.report(HEARTBEAT_LOST)
        self.connection_lost(HEARTBEAT_LOST)
        if self.nmt is Nmt.OPERATIONAL:
            self._enter(_ON_ERROR.get(self._on_error.value, self.nmt))

    def _send_emergency(self, data: bytes) -> None:
        if not self._emergency_id.value & _NOT_VALID:
            self._send(self._emergency_id.value & _CAN_ID, data)

    # SYNC and PDO.

    def _sync_written(self, _entry: ObjectEntry, _old: int) -> None:
        self._route()

    def _sync(self, data: bytes) -> None:
        if data:
            self.errors.report(SYNC_LENGTH)
            return
        if self.errors:
            self.errors.clear(SYNC_LENGTH)
        self._last_sync = self._now
        self.before_sync()
        for tpdo in self._sync_tpdos:
            sample = tpdo.at_sync()
            if sample is not None:
                self._send(tpdo.can_id, sample)
        for rpdo in self._sync_rpdos:
            rpdo.write_latched()
        self._sync_due = self._now + self.sync_timeout()

    def _receive_pdo(self, pdo: ReceivePdo, data: bytes) -> None:
        if len(data) < pdo.layout.size:
            self.errors.report(PDO_TOO_SHORT, pdo.number)
            return
        if len(data) > pdo.layout.size:  # CiA 301: use the mapped bytes and report the excess length
            self.errors.report(PDO_TOO_LONG, pdo.number)
        elif self.errors:
            self.errors.clear(PDO_TOO_SHORT, pdo.number)
            self.errors.clear(PDO_TOO_LONG, pdo.number)
        window = self._sync_window.value * 1e-6
        if not (window and pdo.synchronous and self._now > self._last_sync + window):
            pdo.receive(data)

    def _send_events(self) -> None:
        for pdo in self._event_tpdos:
            data = pdo.on_event(self._now)
            if data is not None:
                self._send(pdo.can_id, data)

    def _send(self, can_id: int, data: bytes) -> None:
        if not self.silent:
            self._transmit(can_id, data)
