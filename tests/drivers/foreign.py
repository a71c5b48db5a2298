"""Drives that others made: python-canopen's own SDO server over the dictionary of a real drive, on python-can's bus.

Nothing here is of this project: frames come and go by python-can, requests are served by canopen's LocalNode, and the
servo believes only its own units. No threads: whoever waits for a frame turns the clock.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any, Final

import can
import canopen
from canopen.objectdictionary import ODRecord, ODVariable
from canopen.sdo.exceptions import SdoAbortedError
from edsfiles import rows
from rigs import Clock
from trirail_drivers.simulated.sdo_queue import SdoQueue

Key = tuple[int, int]

FITTED: Final[dict[str, dict[Key, int]]] = {
    "elmo_gold": {(0x6502, 0): 0x3ED},
    "maxon_epos4_compact50_5": {(0x1000, 0): 0x0002_0192, (0x6502, 0): 0x3ED},
    "nanotec_pd4n": {},
    "pilz_prbt": {(0x1000, 0): 0x0002_0192},
    "ros2_cia402_slave": {},
    "technosoft_ipos": {},
}
"""What these drives answer where their EDS names no default: device type and supported modes."""

_NODE_BASED: Final = (0x80, 0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500, 0x580, 0x600)
_ACCESS: Final = {"rwr": "rw", "rww": "rw"}
_WIDTH: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}
_SIGNED: Final = (2, 3, 4)

_names = count()


@dataclass
class Truth:
    """What the axis is, whatever its dictionary says: its units per metre, per m/s and per m/s²."""

    position: float = 1e6
    velocity: float = 1e6
    acceleration: float = 1e6


@dataclass
class Habits:
    """How a make behaves beyond its dictionary."""

    without: frozenset[int] = frozenset()
    """Indices that it lacks after all."""
    values: dict[Key, int] = field(default_factory=dict)
    """What objects hold at power-on."""
    access: dict[Key, str] = field(default_factory=dict)
    """Access that differs from the dictionary's."""
    more: tuple[tuple[int, int, int, str, int | None, bool], ...] = ()
    """Objects that its dictionary lacks: rows as `rows` has them."""
    refuses: dict[Key, Callable[[int], bool]] = field(default_factory=dict)
    """Values that it does not take."""
    fixed_pdos: bool = False
    """Mappings and COB-IDs cannot be written."""
    answers_guarding: bool = True
    answers_unset_guarding: bool = True
    """It answers guarding also while 100Ch or 100Dh is zero; lely-core does not."""
    has_bit_12: bool = True
    tells_error_reset: bool = True
    """It sends EMCY 0000 when errors are over."""


def dictionary(name: str, node: int, habits: Habits, *, rebased: bool = True) -> canopen.ObjectDictionary:
    """An object dictionary of canopen with one drive's objects."""
    objects = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    facts = [*(row for row in rows(name) if row[0] not in habits.without), *habits.more]
    records = {row[0] for row in facts if row[1] > 0}
    for index, subindex, kind, access, default, mappable in facts:
        variable = ODVariable(f"{index:04X}:{subindex:02X}", index, subindex)
        variable.data_type = kind
        variable.access_type = habits.access.get((index, subindex), _ACCESS.get(access, access))
        if habits.fixed_pdos and (0x1400 <= index < 0x1C00) and (subindex == 1 or index & 0x200):
            variable.access_type = "ro"
        variable.pdo_mappable = mappable
        value = habits.values.get((index, subindex), FITTED[name].get((index, subindex), default))
        assert isinstance(value, int | None)
        if (
            rebased
            and isinstance(value, int)
            and (index == 0x1014 or (0x1400 <= index < 0x1C00 and not index & 0x200 and subindex == 1))
        ):
            based = (value & 0x7FF) - 1 in _NODE_BASED
            value += (node - 1) * based
        variable.default = value
        if index in records:
            if index not in objects:
                objects.add_object(ODRecord(f"{index:04X}", index))
            record = objects[index]
            assert isinstance(record, ODRecord)
            record.add_member(variable)
        else:
            objects.add_object(variable)
    return objects


# ---------------------------------------------------------------------- the axis


class Servo:
    """A slider that follows its setpoint with a lag, helped by what it is told of the velocity. In metres."""

    LAG: Final = 0.02
    """First order [s]."""

    def __init__(self, position: float) -> None:
        self.position = position
        self.velocity = 0.0

    def follow(self, target: float, feed_forward: float, seconds: float) -> None:
        """Move for so long towards a target [m] with a feed-forward [m/s]."""
        error = target - self.position
        self.velocity = feed_forward + error / self.LAG
        # Exact for a target that moves by its feed-forward.
        self.position += feed_forward * seconds + error * (1.0 - math.exp(-seconds / self.LAG))

    def brake(self, deceleration: float, seconds: float) -> None:
        """Move for so long down a ramp [m/s²]."""
        left = max(0.0, abs(self.velocity) - deceleration * seconds)
        velocity = math.copysign(left, self.velocity)
        self.position += 0.5 * (self.velocity + velocity) * seconds
        self.velocity = velocity


# ---------------------------------------------------------------------- the node

# CiA 402-2, figure of the power drive system's states, by their statuswords.
NOT_READY, DISABLED, READY, ON, ENABLED, QUICK_STOP, REACTION, FAULT = 0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08
INITIALISING, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127


class ForeignDrive:
    """One CANopen node with CiA 402's state machine, served by canopen's LocalNode."""

    def __init__(
        self,
        name: str,
        node: int,
        bus: can.BusABC,
        clock: Callable[[], float],
        truth: Truth,
        start: float = 0.0,
        habits: Habits | None = None,
        *,
        rebased: bool = True,
    ) -> None:
        self.node, self.clock, self.truth = node, clock, truth
        self.habits = replace(habits) if habits else Habits()
        self.bus = bus
        self.network = canopen.Network(self.bus)
        self.local = canopen.LocalNode(node, dictionary(name, node, self.habits, rebased=rebased))
        # This node's clock sends the heartbeats, and no thread.
        vars(self.local.nmt).update(start_heartbeat=lambda _ms: None, stop_heartbeat=lambda: None)
        self.local.add_write_callback(self._written)  # type: ignore[no-untyped-call]
        self.local.associate_network(self.network)
        self.sdo_requests = SdoQueue(self._serve)
        self.servo = Servo(start)
        self.nmt = PRE_OPERATIONAL
        self.state = DISABLED
        self.cyclic = False
        """It follows setpoints."""
        self.mode = 0
        self.error = 0
        self.register = 0
        self.target: float | None = None
        self.written: list[tuple[int, int, bytes]] = []
        """What SDO wrote, in order."""
        self._latched: dict[int, bytes] = {}
        self._valid: dict[int, list[int]] = {}
        self._mapped_now: dict[int, list[tuple[int, int, int]]] = {}
        self._last = -math.inf
        self._told: dict[int, bytes] = {}
        self._told_at: dict[int, float] = {}
        self._heard_at: dict[int, float] = {}
        self._synced_at = -math.inf
        self._heartbeat_at = self._guarded_at = self._moved_at = clock()
        self._consumer_heard: float | None = None
        self._toggle = 0
        self._syncs = 0
        self.switched: list[tuple[int, int]] = []
        """Changes of its digital outputs by PDO: number of the SYNC since its start, and the bits of 60FEh:01."""
        self._feedback()

    # ---- its dictionary

    def has(self, index: int, subindex: int = 0) -> bool:
        item = self.local.object_dictionary.get(index)
        return item is not None and (
            (isinstance(item, ODVariable) and subindex == 0) or (not isinstance(item, ODVariable) and subindex in item)
        )

    def value(self, index: int, subindex: int = 0, otherwise: int = 0) -> int:
        """What an object holds."""
        if not self.has(index, subindex):
            return otherwise
        try:
            data = self.local.get_data(index, subindex)
        except SdoAbortedError:
            return otherwise
        return int.from_bytes(data, "little", signed=self._kind(index, subindex) in _SIGNED)

    def _kind(self, index: int, subindex: int) -> int:
        variable = self.local.object_dictionary.get_variable(index, subindex)
        assert variable is not None
        return variable.data_type or 0

    def put(self, index: int, value: int, subindex: int = 0) -> None:
        """The drive itself changes an object."""
        if self.has(index, subindex):
            kind = self._kind(index, subindex)
            data = value.to_bytes(_WIDTH[kind], "little", signed=kind in _SIGNED)
            self.local.data_store.setdefault(index, {})[subindex] = data

    def _written(self, index: int, subindex: int, od: ODVariable, data: bytes, **_: Any) -> None:
        value = int.from_bytes(data, "little", signed=od.data_type in _SIGNED)
        refused = self.habits.refuses.get((index, subindex))
        if refused is not None and refused(value):
            raise SdoAbortedError(0x0609_0030)
        if 0x1400 <= index < 0x1C00 and not index & 0x200 and subindex == 1:
            valid_now, valid_then = not self.value(index, 1) & 1 << 31, not value & 1 << 31
            if valid_now and valid_then and self.value(index, 1) & 0x7FF != value & 0x7FF:
                raise SdoAbortedError(0x0609_0030)  # CiA 301: not while it is valid
        if index & 0x200 and 0x1600 <= index < 0x1C00:
            self._mapped(index, subindex, value)
        if index & 0xFE00 == 0x1800 and subindex == 3 and not self.value(index, 1) & 1 << 31:
            raise SdoAbortedError(0x0609_0030)  # CiA 301: the inhibit time only while it is invalid
        if index == 0x1019 and self.value(0x1006):
            raise SdoAbortedError(0x0800_0022)  # CiA 301: the counter changes only while the period is 0
        self.written.append((index, subindex, bytes(data)))
        if 0x1400 <= index < 0x1C00:
            self._valid.clear()
            self._mapped_now.clear()
        if index == 0x6040:
            self.control(value)
        elif index == 0x6060:
            self.mode = value if self.value(0x6502, otherwise=0x3FF) >> max(0, value - 1) & 1 else self.mode
            self.put(0x6061, self.mode)

    def _mapped(self, index: int, subindex: int, value: int) -> None:
        """CiA 301: a mapping changes while its PDO is invalid and its count is zero."""
        if self.nmt == OPERATIONAL:
            raise SdoAbortedError(0x0800_0022)
        if subindex and self.value(index, 0):
            raise SdoAbortedError(0x0604_0041)
        if not self.value(index - 0x200, 1) & 1 << 31:
            raise SdoAbortedError(0x0601_0000)
        if subindex:
            variable = self.local.object_dictionary.get_variable(value >> 16, value >> 8 & 0xFF)
            if variable is None or not variable.pdo_mappable:
                raise SdoAbortedError(0x0604_0041)
            if len(variable) != value & 0xFF:
                raise SdoAbortedError(0x0604_0041)

    # ---- frames

    def pump(self, wait: float = 0.0) -> None:
        """Take in what is on the bus, which may take so long to come [s], and do what time asks for."""
        while (message := self.bus.recv(wait)) is not None:
            self._take(message)
            wait = 0.0
        if self.clock() > self._last:
            self._last = self.clock()
            self._time()

    def _take(self, message: can.Message) -> None:
        identifier = message.arbitration_id
        if message.is_remote_frame:
            asked = self.habits.answers_unset_guarding or (self.value(0x100C) and self.value(0x100D))
            if identifier == 0x700 + self.node and self.habits.answers_guarding and asked:
                self._guarded_at = self.clock()
                self._send(0x700 + self.node, bytes([self.nmt | self._toggle]))
                self._toggle ^= 0x80
            return
        data = bytes(message.data)
        if identifier == 0 and data[1] in (0, self.node):
            self._nmt(data[0])
        elif identifier == 0x600 + self.node:
            if self.nmt in (OPERATIONAL, PRE_OPERATIONAL):
                self.sdo_requests.receive(data, self.clock())
        elif identifier == 0x700 + (self.value(0x1016, 1) >> 16 & 0x7F or 0xFF):
            self._consumer_heard = self.clock()
        elif identifier == 0x80:
            if bool(data) != bool(self.value(0x1019)):
                self.emergency(0x8240)
            self._sync()
        elif self.nmt == OPERATIONAL:
            self._rpdo(identifier, data)

    def _serve(self, request: bytes) -> None:
        self._feedback()
        self.local.sdo.on_request(0x600 + self.node, bytearray(request), 0.0)  # type: ignore[no-untyped-call]

    def _send(self, identifier: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _nmt(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.boot()
        else:
            self.leave(OPERATIONAL if command == 1 else STOPPED if command == 2 else PRE_OPERATIONAL)

    def leave(self, state: int) -> None:
        """Go into another NMT state; CiA 402-2: 6007h says what the axis does that was operational."""
        was, self.nmt = self.nmt, state
        if state == STOPPED:
            self.sdo_requests.clear()
        if was == OPERATIONAL != state and self.has(0x6007):
            self._connection_lost()

    def _connection_lost(self) -> None:
        if self.state != ENABLED:
            return
        self.cyclic = self.cyclic and self.value(0x6007) == 0
        match self.value(0x6007):
            case 1:
                self.fail(0x8130)
            case 2:
                self.state = DISABLED
            case 3:
                self.state = QUICK_STOP

    def boot(self) -> None:
        """Restart."""
        self.local.data_store.clear()
        self._valid.clear()
        self._mapped_now.clear()
        self.nmt, self.state, self.mode, self.error = PRE_OPERATIONAL, DISABLED, 0, 0
        self._consumer_heard = None
        self.sdo_requests.clear()
        self._send(0x700 + self.node, b"\x00")

    def _pdos(self, base: int) -> list[int]:
        """PDOs that are valid; looked up once, until a parameter is written."""
        if base not in self._valid:
            every = (index for index in range(base, base + 16) if self.has(index, 1))
            self._valid[base] = [index for index in every if not self.value(index, 1) & 1 << 31]
        return self._valid[base]

    def _mapping(self, index: int) -> list[tuple[int, int, int]]:
        if index not in self._mapped_now:
            self._mapped_now[index] = self._read_mapping(index)
        return self._mapped_now[index]

    def _read_mapping(self, index: int) -> list[tuple[int, int, int]]:
        entries = [self.value(index, n + 1) for n in range(self.value(index, 0))]
        return [(entry >> 16, entry >> 8 & 0xFF, (entry & 0xFF) // 8) for entry in entries if entry]

    def _rpdo(self, identifier: int, data: bytes) -> None:
        for index in self._pdos(0x1400):
            if self.value(index, 1) & 0x7FF == identifier:
                self._heard_at[index] = self.clock()
                window = self.value(0x1007) * 1e-6
                if self.value(index, 2) <= 240:
                    if not window or self.clock() <= self._synced_at + window:
                        self._latched[index] = data
                else:
                    self._unpack(index, data)

    def _unpack(self, index: int, data: bytes) -> None:
        mapping = self._mapping(index + 0x200)
        if len(data) < sum(size for *_, size in mapping):
            self.emergency(0x8210)
            return
        at = 0
        for mapped, subindex, size in mapping:
            piece = data[at : at + size]
            at += size
            if not self.has(mapped, subindex):
                continue
            if (mapped, subindex) == (0x60FE, 1) and self.value(mapped, subindex) != int.from_bytes(piece, "little"):
                self.switched.append((self._syncs, int.from_bytes(piece, "little")))
            self.local.data_store.setdefault(mapped, {})[subindex] = piece
            value = int.from_bytes(piece, "little", signed=True)
            if mapped == 0x6040:
                self.control(value & 0xFFFF)
            elif mapped == self._setpoint[0] and subindex == self._setpoint[1]:
                self.target = value / self.truth.position

    @property
    def _setpoint(self) -> Key:
        return (0x60C1, 1) if self.mode == 7 else (0x607A, 0)

    def _sync(self) -> None:
        self._move()
        self._feedback()
        if self.nmt != OPERATIONAL:
            return
        self._syncs += 1
        self._synced_at = self.clock()
        for index in self._pdos(0x1800):
            kind = self.value(index, 2)
            if 1 <= kind <= 240 and self._syncs % kind == 0:
                self._send(self.value(index, 1) & 0x7FF, self._packed(index))
        latched, self._latched = self._latched, {}
        for index, data in latched.items():
            self._unpack(index, data)

    def _packed(self, index: int) -> bytes:
        mapping = self._mapping(index + 0x200)
        return b"".join((self.value(i, s) & (1 << 8 * n) - 1).to_bytes(n, "little") for i, s, n in mapping)

    # ---- time

    def _time(self) -> None:
        now = self.clock()
        self.sdo_requests.poll(now)
        if self.state in (QUICK_STOP, REACTION):
            self._move()
        self._feedback()
        period = self.value(0x1017) * 1e-3
        if period and now - self._heartbeat_at >= period - 1e-9:
            self._heartbeat_at = now
            self._send(0x700 + self.node, bytes([self.nmt]))
        watched = (self.value(0x1016, 1) & 0xFFFF) * 1e-3
        if watched and self._consumer_heard is not None and now - self._consumer_heard > watched:
            self._consumer_heard = None
            self._master_lost()
        life = self.value(0x100C) * 1e-3 * self.value(0x100D)
        if life and now - self._guarded_at > life:
            self._guarded_at = math.inf
            self._master_lost()
        if self.nmt == OPERATIONAL:
            for index, heard in list(self._heard_at.items()):
                deadline = self.value(index, 5) * 1e-3
                if deadline and now - heard > deadline:
                    del self._heard_at[index]
                    self.emergency(0x8250)
            for index in self._pdos(0x1800):
                if self.value(index, 2) >= 254:
                    self._event(index, now)

    def _master_lost(self) -> None:
        self.emergency(0x8130)
        self._connection_lost()
        if self.nmt == OPERATIONAL and self.value(0x1029, 1) == 0:
            self.nmt = PRE_OPERATIONAL

    def _event(self, index: int, now: float) -> None:
        data, timer = self._packed(index), self.value(index, 5) * 1e-3
        inhibited = now - self._told_at.get(index, -math.inf) < self.value(index, 3) * 1e-4 - 1e-9
        repeated = timer and now - self._told_at.get(index, -math.inf) >= timer - 1e-9
        if (data != self._told.get(index) and not inhibited) or repeated:
            self._told[index], self._told_at[index] = data, now
            self._send(self.value(index, 1) & 0x7FF, data)

    # ---- the axis

    def control(self, word: int) -> None:  # noqa: PLR0912  the transitions of one figure
        """CiA 402-2, controlword 6040h."""
        command = word & 0x8F
        before = self.state
        if self.state == FAULT:
            if word & 0x80:
                self.state, self.error, self.register = DISABLED, 0, 0
                if self.habits.tells_error_reset:
                    self._send(0x80 + self.node, bytes(8))
        elif self.state == REACTION:
            pass
        elif not command & 0x02:
            self.state = DISABLED
        elif not command & 0x04:
            if self.state == ENABLED:
                self.state = QUICK_STOP
            elif self.state != QUICK_STOP:
                self.state = DISABLED
        elif self.state == QUICK_STOP:
            pass
        elif command & 0x0F == 0x06:
            self.state = READY
        elif command & 0x0F == 0x07 and self.state in (READY, ON, ENABLED):
            self.state = ON
        elif command & 0x0F == 0x0F and self.state in (ON, ENABLED):
            self.state = ENABLED
        if self.state == ENABLED and before != ENABLED and self.target is None:
            self.target = self.servo.position
        if self.state != ENABLED:
            self.target = self.target if self.state in (READY, ON) else None
        interpolates = self.mode == 7 and bool(word & 0x10)
        self.cyclic = self.state == ENABLED and (self.mode == 8 or interpolates)
        if self.state == DISABLED:
            self.servo.velocity = 0.0

    def fail(self, code: int) -> None:
        """Break down."""
        self.error, self.register, self.state, self.cyclic = code, 1, REACTION, False
        self.emergency(code)

    def emergency(self, code: int, register: int | None = None) -> None:
        """Send an EMCY."""
        self._send(0x80 + self.node, struct.pack("<HB5x", code, self.register if register is None else register))

    def _move(self) -> None:
        now = self.clock()
        seconds, self._moved_at = now - self._moved_at, now
        if self.cyclic and self.target is not None:
            feed_forward = self.value(0x60B1) / self.truth.velocity if self.mode == 8 else 0.0
            self.servo.follow(self.target, feed_forward, seconds)
        elif self.state in (QUICK_STOP, REACTION):
            ramp = self.value(0x6085, otherwise=round(5.0 * self.truth.acceleration)) / abs(self.truth.acceleration)
            self.servo.brake(ramp, seconds)
            if self.servo.velocity == 0.0:
                stays = self.state == QUICK_STOP and self.value(0x605A, otherwise=2) >= 5
                self.state = FAULT if self.state == REACTION else QUICK_STOP if stays else DISABLED
        else:
            self.servo.velocity = 0.0

    def _feedback(self) -> None:
        self.put(0x6064, round(self.servo.position * self.truth.position))
        follows = self.cyclic and self.habits.has_bit_12
        self.put(0x6041, self.state | 0x0210 | follows << 12)
        self.put(0x603F, self.error)
        self.put(0x1001, self.register)
        self.put(0x6061, self.mode)

    def shutdown(self) -> None:
        self.bus.shutdown()


# ---------------------------------------------------------------------- the bus, as the driver under test sees it


class Wires(can.BusABC):
    """python-can's virtual bus; whoever waits on it lets the foreign nodes work and the time pass."""

    STEP: Final = 0.002

    def __init__(self, channel: str, clock: Clock) -> None:
        self.inner = can.Bus(channel, interface="virtual")
        self.nodes: list[ForeignDrive] = []
        self.turn = clock
        self.sent: list[can.Message] = []
        super().__init__(channel)
        self.channel_info = f"foreign drives on {channel}"

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent.append(msg)
        self.inner.send(msg, timeout)
        self.pump()

    def pump(self) -> None:
        for node in self.nodes:
            node.pump()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.pump()
        end = self.turn.now + (timeout or 0.0)
        while (message := self.inner.recv(0)) is None and self.turn.now < end - 1e-12:
            self.turn.now = min(end, self.turn.now + self.STEP)
            self.pump()
        return message

    def shutdown(self) -> None:
        super().shutdown()
        self.inner.shutdown()
        for node in self.nodes:
            node.shutdown()


def three(
    name: str,
    truths: Mapping[int, Truth],
    starts: Iterable[float] = (0.01, -0.02, 0.03),
    habits: Habits | None = None,
    *,
    rebased: bool = True,
) -> tuple[Wires, Clock]:
    """Three drives of one make on a bus of their own: by node id, where each slider stands."""
    clock = Clock()
    channel = f"foreign-{next(_names)}"
    wires = Wires(channel, clock)
    wires.nodes = [
        ForeignDrive(name, node, can.Bus(channel, interface="virtual"), clock, truth, start, habits, rebased=rebased)
        for (node, truth), start in zip(truths.items(), starts, strict=True)
    ]
    return wires, clock
