"""The compiled call runs cycles as Python runs them: the same frames, records and events, whatever happens in between.

Whole sessions are generated, and run twice over a bus by a clock of the test's: once with every cycle run by Python.
"""

from __future__ import annotations

import errno
import math
import random
import re
import struct
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import can
import numpy as np
import pytest
from control_rig import CONFIG, carried
from generated import thinned
from lockstep import CARRIERS, STEP_NS, Lockstep
from msgspec import structs
from trirail.config import Config
from trirail.motion.motion_planner import MotionPlanner
from trirail.motion.runs import Run
from trirail.motion.schedule import Schedule
from trirail.processes.clock import Suspensions, Ticker
from trirail.processes.heartbeats import Heartbeats
from trirail.processes.loop import Loop
from trirail.processes.ports import Ports
from trirail.wire import links
from trirail.wire.goals import Goal, MoveGoal, PoseGoal, TrackGoal, VelocityGoal
from trirail.wire.links import Port
from trirail.wire.messages import Notice
from trirail.wire.packed_trajectory import PackedTrajectory
from trirail.wire.packets import (
    Announcement,
    CheckRequest,
    CommandRequest,
    EventReport,
    GoalRequest,
    Kind,
    Request,
    Status,
    decode_answer,
    message,
)
from trirail.wire.plan_packets import decode_plan_request, encode
from trirail.wire.records import DTYPE, unpack
from trirail.wire.sizes import MAX_PART
from trirail.wire.vocabulary import MODES, AcquireLease, Command, Mode, ReleaseLease
from trirail_drivers.bus.can_frame import BIT_RATE_SWITCH, CAN_FRAME, CANFD_FRAME, CAPTURED, FD_FORMAT
from trirail_drivers.bus.frames import packed, unpacked
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.driver.duplicate_node import FAR_APART_M
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive.drives import Odrive
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import SimulatedBus

CYCLES = 1500
NEVER_MIND = ("parts_ns",)
"""What a record has of the time that the program itself took."""


GENTLE = ("pose", "pose", "pose", "move", "jog", "track", "order")
ROUGH = ("frame", "fault", "time")
"""What may happen in a session: the latter end most of it by a fault."""


class Happening(NamedTuple):
    """What is done to a session before one of its cycles."""

    does: Callable[[Session], None]


class Session:
    """A loop, what is around it, and everything that it has said."""

    begins_ns = 100_000_000_000

    def __init__(self, config: Config, folder: Path, carrier: str, *, compiled: bool) -> None:
        self.now_ns = self.begins_ns
        self.config = config
        self.folder = folder
        self.asleep_s = 0.0
        """How long the computer has been suspended."""
        self.late_ns = 0
        """By how much the next tick comes late."""
        self.room: int | None = None
        """So many frames the bus takes in the next cycle; None for all."""
        self.beats = True
        self.sent: list[bytes] = []
        self.held: list[bytes] = []
        self.setting_up = False
        self.holds = False
        """Whether what the drives say is kept for the next cycle."""
        self._stack = ExitStack()
        self.drives: SimulatedBus = simulated_bus(config.can, config.drives, self.clock)
        self.lives = True
        """Whether the bus does."""
        self.ends = Lockstep(carrier, folder, self)
        self._stack.callback(self.ends.close)
        self.driver = driver = PROTOCOLS[config.drives.protocol].driver(
            self.ends.bus, config.can.timing, config.drives, self.clock_of_driver, None, config.drive_io
        )
        self.setting_up = True
        driver.configure(config.period, config.limits.slider.velocities[0])
        self.setting_up = False
        names = ("gateway", "recorder", "planner")
        ports = Ports(*(Port(links.listen(folder / name)) for name in names))
        self.gateway, self.recorder, self.planner = (links.connect(folder / name) for name in names)
        for closes in (*ports, self.gateway, self.recorder, self.planner):
            self._stack.callback(closes.close)
        self.hearts = Heartbeats.create()
        self.motion = MotionPlanner(config)
        suspensions = Suspensions(lambda: self.asleep_s)
        clocks: dict[str, Any] = {"suspensions": suspensions, "now": lambda: self.now_ns}
        self.loop = Loop(config, driver, ports, self.hearts, compiled=compiled, **clocks)
        self.loop.begin()
        self.ticker = Ticker(round(config.period * 1e9), lambda: self.now_ns, self.sleep)
        self.heard: list[object] = []

    def clock(self) -> float:
        return self.now_ns / 1e9

    def clock_of_driver(self) -> float:
        """The same; while drives are set up it goes on when it is looked at."""
        if self.setting_up:
            self.pass_time(STEP_NS)
        return self.clock()

    def close(self) -> None:
        self._stack.close()

    def sleep(self, deadline_ns: int) -> None:
        """Let a cycle's time pass, with all that others do in it."""
        self.pump()
        while (packet := self.planner.receive()) is not None:
            self.planner.send(encode(self.motion.plan(decode_plan_request(packet))))
        if self.beats:
            self.hearts.heart("gateway").beat()
        self.now_ns = max(self.now_ns, deadline_ns + self.late_ns)
        self.late_ns = 0
        self.pump()
        if self.room is not None:
            self.ends.leave_room(self.room)
            self.room = None

    def pass_time(self, ns: int) -> None:
        self.now_ns += ns
        self.pump()

    def pump(self) -> None:
        """Bring to the drives what has been sent, and back what they say."""
        if not self.lives:
            return
        while (packet := self.ends.take()) is not None:
            self.sent.append(packet)
            self.drives.send(unpacked(packet))
        said, self.held = self.held, []
        while (frame := self.drives.recv(0)) is not None:
            (self.held if self.holds else said).append(packed(frame))
        self.holds = False
        for packet in said:
            self.ends.say(packet)

    def inject(self, packet: bytes) -> None:
        """Somebody else sends a frame."""
        self.ends.say(packet)

    def captured(self) -> list[bytes]:
        """The frames that were noted down."""
        return [frame for chunk in self.ends.capture.drain() for _, frame in CAPTURED.iter_unpack(chunk)]

    def ask(self, request: Request) -> None:
        """Send a request; a stop with haste, as the gateway does."""
        hurries = isinstance(request, CommandRequest) and request.name.stops
        with self.hearts.urgent_section() if hurries else nullcontext():
            self.gateway.send(message(request))

    def run(self, script: dict[int, list[Happening]], cycles: int = CYCLES) -> None:
        for number in range(cycles):
            for what in script.get(number, ()):
                what.does(self)
            before = self.loop.control.cycles
            self.loop.turn(self.ticker)
            assert self.loop.control.cycles > before
            self.listen()
        if self.loop._work is not None:  # the last batch, which is sent beside the next cycles
            self.loop._work()
            self.listen()

    def listen(self) -> None:
        """Receive what the loop has said."""
        while self.gateway.receive() is not None:
            pass
        while (packet := self.recorder.receive()) is not None:
            self.heard += list(_comparable(packet))


def _comparable(packet: bytes) -> Iterator[object]:
    """What a packet says, without wall clocks and the program's own times."""
    if packet[0] == Kind.RECORDS:
        records = np.frombuffer(bytearray(packet[1:]), DTYPE)
        for name in NEVER_MIND:
            records[name] = 0
        yield from (record.tobytes() for record in records)
    elif packet[0] == Kind.MESSAGE:
        said = decode_answer(packet[1:])
        if isinstance(said, EventReport):
            event = said.event
            yield event.seq, event.cycle, event.t, event.kind, CHANNEL.sub("can0", event.message), event.outcome
        else:
            text = repr(said) if type(said).__name__ in ("Status", "ControlInput") else ""
            yield type(said).__name__, CHANNEL.sub("can0", text)


CHANNEL = re.compile(r"Virtual bus channel lockstep-\d+|unix \S+/can\b")
"""Name of a session's bus: each of the two has its own."""


def odrives() -> Config:
    """The same robot on ODrives, of which a metre is so many turns."""
    each = {
        name: structs.replace(drive, counts_per_metre=25.0)
        for name, drive in zip(NAMES, CONFIG.drives.each, strict=True)
    }
    return structs.replace(CONFIG, drives=structs.replace(CONFIG.drives, protocol="odrive", **each))


def fast() -> Config:
    """The same robot at the highest rate; its bus carries it."""
    can_bus, loop = structs.replace(CONFIG.can, bitrate=8_000_000), structs.replace(CONFIG.loop, rate_hz=4000)
    return structs.replace(CONFIG, can=can_bus, loop=loop)


CONFIGS = {"cia402": CONFIG, "odrive": odrives()}
FAULTS = {
    "cia402": ("silent for 0.004", "fault 2310", "drop tpdo2 for 0.002", "emcy 8110", "stuck for 0.05"),
    "odrive": ("silent for 0.004", "fault 2", "stuck for 0.05"),
}


def script(seed: int, protocol: str = "cia402") -> dict[int, list[Happening]]:  # noqa: PLR0912, PLR0915 - what may happen, kind by kind
    """What happens in a session: often much at once, and often nothing for long."""
    chance = random.Random(seed)
    tickets = iter(range(1, 10_000))
    happens: dict[int, list[Happening]] = {}

    def at(number: int, does: Callable[[Session], None]) -> None:
        happens.setdefault(number, []).append(Happening(does))

    def order(number: int, name: Command, value: float | None = None) -> None:
        ticket, content = next(tickets), carried(name, value)
        at(number, lambda session: session.ask(CommandRequest(ticket, "ann", name, content)))

    def send(number: int, goal: Goal, name: str | None = None) -> None:
        ticket = next(tickets)
        given = name or f"g{ticket}"
        at(number, lambda session: session.ask(GoalRequest(ticket, "ann", given, goal, session.now_ns)))

    order(30, Command.ENABLE)
    number = 100
    while number < CYCLES - 50:
        number += chance.choice((1, 2, 7, 20, 50, 150))
        match chance.choice(GENTLE if seed % 3 else GENTLE + ROUGH):
            case "pose":
                x, y, phi = chance.uniform(-0.05, 0.05), chance.uniform(-0.05, 0.05), chance.uniform(-0.3, 0.3)
                blend = chance.choice((None, None, 0.01))
                send(number, PoseGoal(x, y, phi, speed=chance.choice((0.2, 1.0)), blend=blend))
            case "move":
                send(number, MoveGoal(chance.uniform(-0.01, 0.01), 0.0, 0.0))
            case "jog":
                jog = f"j{number}"
                for renewed in range(number, number + chance.choice((1, 3, 8)) * 40, 40):
                    send(renewed, VelocityGoal(0.05, 0.02, 0.0, timeout=0.1), jog)
            case "track":
                track = f"t{number}"
                for told in range(number, number + 200, 20):
                    send(told, TrackGoal(0.001 * (told - number) / 20, 0.0, 0.0, timeout=0.1), track)
            case "order":
                name = chance.choice(
                    (Command.STOP, Command.PAUSE, Command.RESUME, Command.DISABLE, Command.QUICK_STOP, Command.OVERRIDE)
                )
                order(number, name, chance.choice((0.3, 1.5)) if name is Command.OVERRIDE else None)
                if name in (Command.DISABLE, Command.QUICK_STOP):
                    order(number + 150, Command.RESET)
                    order(number + 160, Command.ENABLE)
                    number += 200
            case "frame":
                kind = chance.choice(("strange", "error", "word", "position", "hold"))
                node = chance.randrange(1, 4)
                frames = {
                    "strange": CAN_FRAME.pack(0x123, 2, b"ab"),
                    "error": CAN_FRAME.pack(1 << 29 | 0x20, 8, bytes(8)),
                    "word": CAN_FRAME.pack(0x180 + node, 2, struct.pack("<H", chance.choice((0x1637, 0x0637, 0x0218)))),
                    "position": CAN_FRAME.pack(0x280 + node, chance.choice((3, 4)), struct.pack("<i", 5)),
                }
                if kind == "hold":
                    at(number, lambda session: setattr(session, "holds", True))
                else:
                    at(number, lambda session, frame=frames[kind]: session.inject(frame))  # type: ignore[misc]
            case "fault":
                axis = chance.choice("ABC")
                line = chance.choice(FAULTS[protocol])
                at(number, lambda session, line=f"{axis} {line}": session.drives.faults.add(line))  # type: ignore[misc]
                order(number + 150, Command.RESET)
                order(number + 170, Command.ENABLE)
                number += chance.choice((5, 220))
            case "time":
                late = chance.choice((300_000, 750_000, 900_000, 1_000_000, 2_500_000, 30_000_000))
                at(number, lambda session, late=late: setattr(session, "late_ns", late))  # type: ignore[misc]
                if late > 20_000_000:
                    order(number + 150, Command.RESET)
                    order(number + 170, Command.ENABLE)
    return happens


def requests_of_two(seed: int) -> dict[int, list[Happening]]:
    """What two users ask for at the same robot, much of it in vain: too fast, too late or with the other's lease."""
    chance = random.Random(seed)
    tickets = iter(range(1, 10_000))
    happens: dict[int, list[Happening]] = {}

    def ask(number: int, request: Callable[[int, Session], Request]) -> None:
        ticket = next(tickets)
        happens.setdefault(number, []).append(Happening(lambda session: session.ask(request(ticket, session))))

    def order(number: int, user: str, name: Command, content: Any = None) -> None:
        ask(number, lambda ticket, _: CommandRequest(ticket, user, name, content))

    def send(number: int, user: str, name: str, goal: Goal, age_ns: int = 0) -> None:
        ask(number, lambda ticket, session: GoalRequest(ticket, user, name, goal, session.now_ns - age_ns))

    def place(**more: Any) -> PoseGoal:
        return PoseGoal(chance.uniform(-0.05, 0.05), chance.uniform(-0.05, 0.05), 0.0, **more)

    order(30, "ann", Command.ENABLE)
    number = 60
    while number < CYCLES - 60:
        number += chance.choice((3, 11, 40, 120))
        user, name = chance.choice(("ann", "bob")), f"g{number}"
        match chance.choice(("goal", "queue", "late", "jog", "checks", "acquire", "release", "reset")):
            case "goal":
                send(number, user, name, place())
            case "queue":
                for i in range(4):
                    send(number + 2 * i, user, f"{name}-{i}", place(blend=0.01, valid_for=chance.choice((None, 0.1))))
            case "late":
                send(number, user, name, place(valid_for=chance.choice((0.002, 0.004, 0.05))))
            case "jog":
                jog = VelocityGoal(0.03, 0.0, 0.0, timeout=0.2)
                bad = chance.choice((structs.replace(jog, x=100.0), structs.replace(jog, valid_for=0.001)))
                for i, each in enumerate((jog, bad, jog, jog)[: chance.choice((2, 4))]):
                    send(number + 15 * i, user, name, each, age_ns=5_000_000)
            case "checks":
                for goal in [place(speed=0.3) for _ in range(chance.choice((1, 5)))]:
                    ask(number, lambda ticket, _, user=user, goal=goal: CheckRequest(ticket, user, goal))  # type: ignore[misc]
            case "acquire":
                order(number, user, Command.ACQUIRE, AcquireLease(timeout=0.2, force=chance.choice((False, True))))
            case "release":
                order(number, user, Command.RELEASE, ReleaseLease())
            case "reset":
                order(number, user, Command.RESET)
                order(number + 8, user, Command.ENABLE)
    return happens


def both_ways(
    config: Config,
    folder: Path,
    script: Callable[[], dict[int, list[Happening]]],
    cycles: int,
    carrier: str = "unix",
) -> Session:
    """Run a session with compiled cycles, and once more with every cycle run by Python: the same to the last bit.

    Frames on the bus, records and events; and many cycles were compiled, so there was something to compare.
    """
    sessions = []
    for compiled in (True, False):
        place = folder / str(compiled)
        place.mkdir()
        session = Session(config, place, carrier, compiled=compiled)
        if session.loop._caller is not None:
            session.loop._caller.cycles_beside = 0, 0  # Python's cycles know no cycles beside a decision
        try:
            session.run(script(), cycles)
        finally:
            session.close()
        sessions.append(session)
    one, other = sessions
    assert one.loop.compiled_cycles > min(100, cycles // 12)
    assert other.loop.compiled_cycles == 0
    assert len(one.heard) > 0.9 * cycles
    _compare(one.heard, other.heard)
    assert one.sent == other.sent
    assert one.driver.traffic == other.driver.traffic
    assert one.captured() == other.captured()
    return one


@pytest.mark.parametrize(
    ("carrier", "protocol", "seed"),
    [
        *thinned((("unix", "cia402", seed) for seed in range(6)), every=3),
        *thinned((("unix", "odrive", seed) for seed in range(3)), every=3),
        *((carrier, protocol, 3) for carrier in CARRIERS[1:] for protocol in CONFIGS),
    ],
)
def test_compiled_cycles_are_those_of_python_to_the_last_bit(
    carrier: str, protocol: str, seed: int, tmp_path: Path
) -> None:
    both_ways(CONFIGS[protocol], tmp_path, lambda: script(seed, protocol), CYCLES, carrier)


@pytest.mark.generated(0, 1, 2)
def test_a_session_on_can_fd_sends_what_it_sends_on_classical_can(seed: int, tmp_path: Path) -> None:
    """In the same order and to the last bit; each frame is one of CAN FD. What is injected is of classical CAN."""
    places = [tmp_path / name for name in ("classical", "fd")]
    for place in places:
        place.mkdir()
    fast = structs.replace(CONFIG, can=structs.replace(CONFIG.can, fd=True))
    classical = both_ways(CONFIG, places[0], lambda: script(seed), CYCLES)
    fd = both_ways(fast, places[1], lambda: script(seed), CYCLES, "fd")
    sent = [CANFD_FRAME.unpack(packet) for packet in fd.sent]
    assert {flags for _, _, flags, _ in sent} == {FD_FORMAT | BIT_RATE_SWITCH}
    assert [(identifier, data[:length]) for identifier, length, _, data in sent] == [
        (identifier, data[:length]) for identifier, length, data in map(CAN_FRAME.unpack, classical.sent)
    ]
    assert 0 < fd.driver.traffic < classical.driver.traffic


@pytest.mark.generated(0, 1, 2, 3)
@pytest.mark.parametrize("protocol", CONFIGS)
def test_what_two_users_ask_for_is_answered_alike(protocol: str, seed: int, tmp_path: Path) -> None:
    both_ways(CONFIGS[protocol], tmp_path, lambda: requests_of_two(seed), CYCLES)


@pytest.mark.generated(0, 1, 2, 3)
def test_cycles_at_the_highest_rate_are_those_of_python(seed: int, tmp_path: Path) -> None:
    both_ways(fast(), tmp_path, lambda: script(seed), CYCLES)


@pytest.mark.parametrize("carrier", CARRIERS)
@pytest.mark.parametrize("unread", [False, True])
@pytest.mark.parametrize("moving", [False, True])
def test_a_bus_that_dies_is_a_fault_in_the_same_cycle(moving: bool, unread: bool, carrier: str, tmp_path: Path) -> None:
    """The kernel tells of a broken socket once: who hears of it hands it on."""

    def die(session: Session) -> None:
        if not unread:
            session.pump()
        session.lives = False
        session.ends.die()

    happens = {number: list(what) for number, what in script(1).items() if number < (400 if moving else 31)}
    happens[412] = [Happening(die)]
    one = both_ways(CONFIG, tmp_path, lambda: happens, 500, carrier)
    assert re.match("CAN bus .* is down: cannot", one.loop.control.fault or "")


BEAT: Final = 0x700 + CONFIG.drives.master_node
SENT: Final = {
    "cia402": (0x080, BEAT, 0x301, 0x302, 0x303),
    "odrive": (0x02C, 0x04C, 0x06C, 0x029, 0x049, 0x069, 0x023, 0x043, 0x063),
}
"""Identifiers of the frames that are sent in compiled cycles."""
FULL: Final = can.CanOperationError("Transmit buffer full")
DOWN: Final = OSError(errno.ENETDOWN, "Network is down")


def moves() -> dict[int, list[Happening]]:
    """A session without faults of its own, without power, at rest and in motion."""
    happens: dict[int, list[Happening]] = {}
    requests: list[CommandRequest | GoalRequest] = [
        *(CommandRequest(at, "ann", Command(name)) for at, name in ((30, "enable"), (450, "reset"), (480, "enable"))),
        *(
            GoalRequest(at, "ann", f"g{at}", PoseGoal(x, 0.01, 0.1, speed=0.3), 0)
            for at, x in ((330, 0.02), (780, 0.1))
        ),
    ]
    for request in requests:
        happens[request.ticket] = [Happening(partial(Session.ask, request=request))]
    return happens


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("protocol", CONFIGS)
@pytest.mark.long
def test_frames_that_a_full_bus_refuses_are_lost_alone(protocol: str, seed: int, tmp_path: Path) -> None:
    """Whichever they are, the others go on, and it is told of."""
    chance, happens = random.Random(seed), moves()
    for number in range(60, 900, 7):
        for identifier in chance.sample(SENT[protocol], chance.choice((1, 1, 2, len(SENT[protocol])))):
            if identifier != BEAT or number == 305:  # drives that miss it stop
                refuse = Happening(lambda session, identifier=identifier: session.ends.refuse(identifier, FULL))  # type: ignore[misc]
                happens.setdefault(number, []).append(refuse)
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 900, "virtual")
    assert any("Transmit buffer full" in repr(each) for each in one.heard if isinstance(each, tuple))
    assert one.loop.control.fault is None


@pytest.mark.parametrize("room", range(8))
@pytest.mark.parametrize("protocol", CONFIGS)
def test_a_socket_that_is_full_within_a_cycle_loses_its_last_frames(protocol: str, room: int, tmp_path: Path) -> None:
    happens = moves()
    for number in range(101, 450, 9):
        happens.setdefault(number, []).append(Happening(lambda session: setattr(session, "room", room)))
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 450)
    assert one.loop.control.fault is None


@pytest.mark.parametrize(
    ("protocol", "identifier"),
    [case for protocol in CONFIGS for case in thinned(((protocol, each) for each in SENT[protocol]), every=3)],
)
def test_a_frame_that_is_refused_for_good_stops_the_drives_in_the_same_cycle(
    protocol: str, identifier: int, tmp_path: Path
) -> None:
    """At rest and in motion; the frames behind it are those of a stop."""
    happens = moves()
    for number in (303, 810):
        happens[number] = [Happening(lambda session: session.ends.refuse(identifier, DOWN))]
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 950, "virtual")
    assert sum("Network is down" in repr(each) for each in one.heard if isinstance(each, tuple)) > 1


@pytest.mark.parametrize("number", [250, 251, 257])
def test_an_odrive_that_stands_still_in_motion_is_found_in_the_same_cycle(number: int, tmp_path: Path) -> None:
    """Its driver watches the following error by setpoints of earlier cycles, which compiled code keeps for it."""
    drives = structs.replace(CONFIGS["odrive"].drives, following_error=0.001)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        100: [
            Happening(lambda session: session.ask(GoalRequest(2, "ann", "g", PoseGoal(0.1, 0.05, 0.1), session.now_ns)))
        ],
        number: [Happening(lambda session: session.drives.faults.add("A stuck for 1"))],
    }
    one = both_ways(structs.replace(CONFIGS["odrive"], drives=drives), tmp_path, lambda: happens, 400)
    assert "exceeds its window of 1 mm" in (one.loop.control.fault or "")


@pytest.mark.parametrize("protocol", CONFIGS)
def test_what_the_last_gate_refuses_is_a_fault_in_the_same_cycle(protocol: str, tmp_path: Path) -> None:
    """No goal comes to that: the time that a motion has reached is put ahead, as if it ran backwards from there."""

    def put_ahead(session: Session) -> None:
        session.loop.control.schedule.runs[0].furthest += 1.0

    goal = PoseGoal(0.1, 0.05, 0.1)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        100: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "g", goal, session.now_ns)))],
        250: [Happening(put_ahead)],
    }
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 400)
    assert "time along the path would run backwards" in (one.loop.control.fault or "")


@pytest.mark.parametrize("protocol", CONFIGS)
@pytest.mark.parametrize(("often", "found"), [(37, None), (1, "a second node with id 1 on the bus")])
def test_a_position_that_comes_twice_is_a_second_nodes_only_if_it_does_so_often(
    protocol: str, often: int, found: str | None, tmp_path: Path
) -> None:
    """They are counted over twenty SYNCs, whoever runs the cycles."""

    def say_once_more(session: Session) -> None:
        assert isinstance(session.driver, Cia402 | Odrive)
        axis = next(axis for axis in session.driver._axes if axis.node == 1)
        if protocol == "cia402":
            session.inject(CAN_FRAME.pack(0x281, 4, struct.pack("<i", round(axis.newest) + 1)))
        else:
            other = axis.newest + 2.0 * FAR_APART_M * axis.counts_per_metre
            session.inject(CAN_FRAME.pack(0x029, 8, struct.pack("<ff", other, 0.0)))

    happens = {number: [Happening(say_once_more)] for number in range(300, 900, often)}
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 900)
    fault = one.loop.control.fault
    assert fault is None if found is None else found in (fault or "")


LOSSES = (
    "drop tpdo2 for 1 frame",
    "drop tpdo2 for 2 frames",
    "delay 0.0005 tpdo2 for 1 frame",
    "delay 0.0012 tpdo2 for 3 frames",
)


def cycles_by_python(session: Session) -> int:
    """Number of cycles that Python has run."""
    return session.loop.control.cycles - session.loop.compiled_cycles


@pytest.mark.parametrize("protocol", CONFIGS)
@pytest.mark.long
def test_lost_and_late_positions_and_a_stop_need_no_python(protocol: str, tmp_path: Path) -> None:
    """Otherwise the first cycle that is late makes the next ones late, too."""
    before: list[int] = []

    def script() -> dict[int, list[Happening]]:
        def ask(request: Request) -> Happening:
            return Happening(lambda session: session.ask(request))

        def lose(line: str) -> Happening:
            positions = line if protocol == "cia402" else line.replace("tpdo2", "get_encoder_estimates")
            return Happening(lambda session: session.drives.faults.add(positions))

        happens = {30: [ask(CommandRequest(1, "ann", Command.ENABLE))]}
        happens[299] = [Happening(lambda session: before.append(cycles_by_python(session)))]
        for number, x in enumerate((0.05, -0.05, 0.05, -0.05)):
            begin = 300 + 300 * number
            happens[begin] = [ask(GoalRequest(10 + number, "ann", f"g{number}", PoseGoal(x, 0.0, 0.0), 0))]
            for k, line in enumerate(LOSSES):
                happens[begin + 60 + 20 * k] = [lose(f"{'ABC'[k % 3]} {line}")]
            happens[begin + 150] = [ask(CommandRequest(20 + number, "ann", Command.STOP))]
        return happens

    session = both_ways(CONFIGS[protocol], tmp_path, script, CYCLES)
    assert sum(counts.feedback_lost for counts in session.driver.counts) >= 12
    assert cycles_by_python(session) <= before[0] + 4


def stops_first(seed: int) -> dict[int, list[Happening]]:
    """Goals that are too slow to begin in motion, so that the robot first stops, and changes of the speed override."""
    chance, tickets = random.Random(seed), iter(range(1, 1000))

    def ask(request: Request) -> Happening:
        return Happening(lambda session: session.ask(request))

    happens = {30: [ask(CommandRequest(next(tickets), "ann", Command.ENABLE))]}
    for number, begin in enumerate(range(200, CYCLES - 100, 150)):
        x, y = 0.05 * (-1) ** (number // 2), chance.uniform(-0.02, 0.02)
        goal = PoseGoal(x, y, 0.0, speed=0.02 if number % 2 else 1.0)
        happens[begin] = [ask(GoalRequest(next(tickets), "ann", f"g{number}", goal, 0))]
        rate = CommandRequest(
            next(tickets), "ann", Command.OVERRIDE, carried(Command.OVERRIDE, chance.choice((0.3, 0.8, 1.2)))
        )
        if seed and number % 2:
            happens[begin + chance.randrange(5, 60)] = [ask(rate)]
    return happens


@pytest.mark.generated(1, 2, 3, 0)
@pytest.mark.parametrize("protocol", ["cia402", "odrive"])
def test_a_motion_that_stops_before_the_next_one_needs_no_python(
    protocol: str, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbers: list[int] = []
    by_python: list[int] = []
    replace_runs = Schedule.replace_runs

    def note(schedule: Schedule, runs: deque[Run]) -> None:
        numbers.append(len(runs))
        replace_runs(schedule, runs)

    def generate() -> dict[int, list[Happening]]:
        happens = stops_first(seed)
        happens[199] = [Happening(lambda session: by_python.append(cycles_by_python(session)))]
        return happens

    monkeypatch.setattr(Schedule, "replace_runs", note)
    session = both_ways(CONFIGS[protocol], tmp_path, generate, CYCLES)
    assert numbers.count(2) >= 4
    if not seed:  # a change of the override is computed step by step
        assert cycles_by_python(session) - by_python[0] < 5


def test_a_simulated_time_may_be_ahead_of_the_machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is measured of a cycle is then nothing, in whichever way it is run."""
    monkeypatch.setattr(Session, "begins_ns", time.perf_counter_ns() + 3_600_000_000_000)
    happens = {30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))]}
    both_ways(CONFIG, tmp_path, lambda: happens, 200)


@pytest.mark.parametrize("cycles", [50.0, 50.3, 50.999])
def test_a_jog_that_nobody_renews_ends_also_where_its_time_is_over_within_a_cycle(
    cycles: float, tmp_path: Path
) -> None:
    jog = VelocityGoal(0.02, 0.0, 0.0, timeout=cycles * CONFIG.period)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        100: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "jog", jog, session.now_ns)))],
    }
    one = both_ways(CONFIG, tmp_path, lambda: happens, 400)
    assert one.loop.control.state.mode is Mode.HOLDING


@pytest.mark.parametrize(
    "bad", [VelocityGoal(100.0, 0.0, 0.0, timeout=0.5), VelocityGoal(0.02, 0.0, 0.0, timeout=0.5, valid_for=0.001)]
)
def test_a_jog_whose_renewal_is_refused_ends_alike(bad: VelocityGoal, tmp_path: Path) -> None:
    """The planner refuses it, or it is too old."""
    jog = VelocityGoal(0.02, 0.0, 0.0, timeout=0.5)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        100: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "jog", jog, session.now_ns)))],
        200: [Happening(lambda session: session.ask(GoalRequest(3, "ann", "jog", bad, session.now_ns - 10_000_000)))],
    }
    one = both_ways(CONFIG, tmp_path, lambda: happens, 400)
    assert one.loop.control.state.mode is Mode.HOLDING


@pytest.mark.parametrize("protocol", CONFIGS)
def test_that_a_fault_is_over_is_noted_in_the_same_cycle(protocol: str, tmp_path: Path) -> None:
    """A frame of wrong length is a fault of drives that need nothing but a reset; a replay must know when it ends."""
    position = 0x281 if protocol == "cia402" else 1 << 5 | 9
    happens = {
        60: [Happening(lambda session: session.inject(CAN_FRAME.pack(position, 3, b"abc")))],
        300: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.RESET)))],
        500: [Happening(lambda session: session.ask(CommandRequest(2, "ann", Command.ENABLE)))],
    }
    one = both_ways(CONFIGS[protocol], tmp_path, lambda: happens, 600)
    assert any("wrong length" in repr(each) for each in one.heard)
    assert one.loop.control.state.mode is Mode.HOLDING


def test_two_users_lengthy_goals_are_planned_in_the_same_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each may interrupt the planning of the other, in whichever way the cycles in between are run."""

    def ask(ticket: int, user: str) -> Happening:
        rows = array("d")
        for i in range(MAX_PART + 1):
            rows.extend((0.05 * i, 3e-5 * i, 0.0, 0.0, *(math.nan,) * 6))
        goal = PackedTrajectory(rows.tobytes())
        return Happening(lambda session: session.ask(GoalRequest(ticket, user, user, goal, session.now_ns)))

    def slowly(session: Session, deadline_ns: int) -> None:
        """The planner takes 40 cycles for what it was asked last."""
        cycle = session.loop.control.cycles
        while (packet := session.planner.receive()) is not None:
            asked[session] = cycle + 40, packet
        if session in asked and cycle >= asked[session][0]:
            session.planner.send(encode(session.motion.plan(decode_plan_request(asked.pop(session)[1]))))
        sleep(session, deadline_ns)

    asked, sleep = dict[Session, tuple[int, bytes]](), Session.sleep
    monkeypatch.setattr(Session, "sleep", slowly)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        100: [ask(2, "ann")],
        101: [ask(3, "bob")],
    }
    both_ways(CONFIG, tmp_path, lambda: happens, 400)


@pytest.mark.parametrize("compiled", [True, False])
def test_who_stays_at_the_door_unheard_keeps_no_tick_waiting(compiled: bool, tmp_path: Path) -> None:
    """What a frozen gateway has left is not taken, and it stays there."""

    def freeze(session: Session) -> None:
        session.beats = False

    def leave(session: Session) -> None:
        session.ask(CommandRequest(1, "ann", Command.ENABLE))

    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=compiled)
    try:
        session.run({20: [Happening(freeze)], 600: [Happening(leave)]}, 700)
        assert session.loop.control.cycles >= 700
        assert session.loop.control.state.mode is Mode.DISABLED, "nobody has taken it"
    finally:
        session.close()


@pytest.mark.generated(*range(6))
def test_who_enables_while_sliders_are_pushed_by_hand_is_answered_alike(seed: int, tmp_path: Path) -> None:
    """It depends on where the sliders are now, and whether they stand."""

    def pushes() -> dict[int, list[Happening]]:
        chance, happens = random.Random(seed), dict[int, list[Happening]]()
        for ticket in range(1, 8):
            begin, by = 60 * ticket, chance.choice((1e-5, 3e-4, 1e-3, 0.01))
            slider, command = chance.randrange(3), chance.choice((Command.ENABLE, Command.ENABLE, Command.DISABLE))
            request = CommandRequest(ticket, "ann", command)
            for number in range(begin, begin + 20):
                happens.setdefault(number, []).append(Happening(partial(_push, slider=slider, by=by)))
            asked = begin + chance.randrange(25)
            happens.setdefault(asked, []).append(Happening(partial(Session.ask, request=request)))
        return happens

    both_ways(CONFIGS["cia402"], tmp_path, pushes, 600)


@pytest.mark.parametrize("protocol", CONFIGS)
def test_a_position_that_jumps_without_power_is_reported_alike_and_once(protocol: str, tmp_path: Path) -> None:
    jump = Happening(partial(_push, slider=1, by=0.02))
    session = both_ways(CONFIGS[protocol], tmp_path, lambda: {200: [jump]}, 400)
    assert sum("its position has jumped" in repr(each) for each in session.heard) == 1


@pytest.mark.generated(*range(6))
def test_a_computer_that_was_suspended_does_not_move_on(seed: int, tmp_path: Path) -> None:
    """Nobody may be there any more. What is too short to be one is none, and each is told once."""
    chance = random.Random(seed)
    slept, at = chance.uniform(0.2, 1e5), chance.randrange(340, 700)
    requests: dict[int, Request] = {
        30: CommandRequest(1, "ann", Command.ENABLE),
        330: GoalRequest(2, "ann", "one", PoseGoal(0.05, 0.01, 0.1, speed=0.1, blend=0.005), 0),
        331: GoalRequest(3, "ann", "other", PoseGoal(-0.02, 0.0, 0.0), 0),
    }
    happens = {number: [Happening(partial(Session.ask, request=each))] for number, each in requests.items()}
    for number, seconds in ((310, 0.09), (at, slept)):
        happens[number] = [Happening(partial(_sleep, seconds=seconds))]
    one = both_ways(CONFIGS["cia402"], tmp_path, lambda: happens, 1000)
    events = [each for each in one.heard if isinstance(each, tuple) and len(each) == 6]
    (suspended,) = (each for each in events if each[3] == "service" and "suspended" in each[4])
    assert suspended[4] == f"the computer was suspended for {slept:.1f} s: the robot stops"
    assert at <= suspended[1] <= at + 2
    assert [outcome for _, cycle, *_, outcome in events if outcome and cycle >= at] == ["stopped", "stopped"]
    assert one.loop.control.state.mode is Mode.HOLDING
    assert one.loop.control.fault is None


def _sleep(session: Session, seconds: float) -> None:
    session.asleep_s += seconds


def _push(session: Session, slider: int, by: float) -> None:
    session.drives.faults.carriages.push(slider, by)


def _compare(heard: list[object], heard_of_python: list[object]) -> None:
    first = next((i for i, (a, b) in enumerate(zip(heard, heard_of_python, strict=False)) if a != b), None)
    assert first is None, _difference(heard[first], heard_of_python[first])
    assert len(heard) == len(heard_of_python)


def _difference(one: object, other: object) -> str:
    if isinstance(one, bytes) and isinstance(other, bytes):
        a, b = unpack(one)[0], unpack(other)[0]
        return "; ".join(
            f"{name}: {a[name]} {b[name]}" for name in a.dtype.names if not np.array_equal(a[name], b[name])
        )
    return f"{one}\n{other}"


def test_an_event_belongs_to_the_first_cycle_that_it_shows_in(tmp_path: Path) -> None:
    """Whoever runs the cycle behind which it is said."""

    def ask(number: int) -> Happening:
        goal = PoseGoal(0.01 * (number // 300), 0.0, 0.0)
        return Happening(lambda session: session.ask(GoalRequest(number, "ann", f"g{number}", goal, session.now_ns)))

    def script() -> dict[int, list[Happening]]:
        script = {30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))]}
        for number in range(300, 1500, 300):
            script.setdefault(number, []).append(ask(number))
        return script

    session = both_ways(fast(), tmp_path, script, CYCLES)
    events = [what for what in session.heard if isinstance(what, tuple) and len(what) == 6]
    records = unpack(b"".join(what for what in session.heard if isinstance(what, bytes)))
    moving = records["mode"] == MODES.index(Mode.MOVING)
    begun = records["cycle"][1:][moving[1:] & ~moving[:-1]]
    assert [event[1] for event in events if event[3] == "mode" and event[4].startswith("moving")] == [*begun]
    cycles = [event[1] for event in events]
    assert cycles == sorted(cycles)
    assert cycles[-1] > begun[-1]


@pytest.mark.parametrize("compiled", [True, False])
def test_a_recorder_whose_loss_a_batch_notices_is_missed_at_once(compiled: bool, tmp_path: Path) -> None:
    session = Session(CONFIG, tmp_path, "unix", compiled=compiled)

    def records(session: Session) -> None:
        session.recorder.send(message(Announcement(Notice("service", "info", "recording to x.rrd"))))

    def dies(session: Session) -> None:
        session.recorder.close()
        session.loop._reports.flush()  # the batch of this cycle finds the socket closed
        session.recorder = links.connect(tmp_path / "planner")  # only to have one that can be read
        session._stack.callback(session.recorder.close)

    told: list[str] = []
    real = session.loop._reports._gateway.send

    def send(packet: Any) -> bool:
        if packet[0] == Kind.MESSAGE and isinstance(said := decode_answer(bytes(packet)[1:]), Status):
            told.append(said.unrecorded)
        return real(packet)

    session.loop._reports._gateway.send = send  # type: ignore[method-assign]
    try:
        session.run({100: [Happening(records)], 205: [Happening(dies)]}, 300)
        assert told[-1:] == ["the recorder has died: nothing is recorded until it has restarted"]
    finally:
        session.close()
