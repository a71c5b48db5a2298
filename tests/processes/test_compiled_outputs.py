"""Compiled cycles switch outputs and see inputs as Python does: the same frames, records and events."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from canopen.objectdictionary import ODVariable
from control_rig import CONFIG
from msgspec import structs
from processes.test_compiled_cycles import FULL, Happening, Session, both_ways
from trirail.config import Input, Output
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.marks import Mark
from trirail.wire.packets import CommandRequest, GoalRequest
from trirail.wire.vocabulary import Command, SetOutput
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.simulated.dictionary import ObjectEntry

OUTPUTS = {"valve": Output("A", 16), "light": Output("B", 17, safe=True, always=True)}
INPUTS = {"part": Input("B", 16), "door": Input("C", 20)}
PINS = structs.replace(CONFIG, outputs=OUTPUTS, inputs=INPUTS)
CYCLES = 1000


def session(seed: int) -> dict[int, list[Happening]]:
    """Commands, goals with marks, inputs that change, and a fault at the end."""
    chance, tickets, happens = random.Random(seed), iter(range(1, 10_000)), dict[int, list[Happening]]()

    def at(number: int, does: Callable[[Session], None]) -> None:
        happens.setdefault(number, []).append(Happening(does))

    def order(number: int, name: Command, content: SetOutput | None = None) -> None:
        at(number, partial(Session.ask, request=CommandRequest(next(tickets), "ann", name, content)))

    def send(number: int, goal: Goal) -> None:
        at(number, partial(Session.ask, request=GoalRequest(next(tickets), "ann", f"g{number}", goal, 0)))

    order(20, Command.SET_OUTPUT, SetOutput("light", value=False))
    order(30, Command.ENABLE)
    for number in range(100, CYCLES, 150):
        marks = (
            Mark("valve", start=0.002, end=0.03, increment=0.004, pulse_width=0.001),
            Mark("light", value=bool(chance.randrange(2)), at_path_fraction=chance.random()),
        )
        send(number, PoseGoal(chance.uniform(-0.05, 0.05), chance.uniform(-0.05, 0.05), 0.0, speed=0.5, marks=marks))
    for _ in range(15):
        output = SetOutput(chance.choice(("valve", "light")), value=bool(chance.randrange(2)))
        order(chance.randrange(60, CYCLES), Command.SET_OUTPUT, output)
        drive, pressed = chance.choice((1, 2)), chance.choice((0, 1 << 16, 1 << 20, 1))
        at(chance.randrange(60, CYCLES), lambda session, drive=drive, pressed=pressed: press(session, drive, pressed))  # type: ignore[misc]
    at(CYCLES - 80, lambda session: session.drives.faults.add("B fault 2310"))
    return happens


def press(session: Session, drive: int, pressed: int) -> None:
    session.drives.press(drive, pressed)


def words(session: Session, index: int) -> list[int]:
    """What a drive was sent by its frame of outputs."""
    wanted = canopen_frames.RPDO3 + CONFIG.drives.each[index].node
    frames = (CAN_FRAME.unpack(packet) for packet in session.sent)
    return [int.from_bytes(data[:4], "little") for identifier, _, data in frames if identifier == wanted]


@pytest.mark.parametrize(("carrier", "seed"), [*(("unix", seed) for seed in range(4)), ("captured", 1), ("virtual", 2)])
def test_outputs_and_inputs_are_those_of_python_to_the_last_bit(carrier: str, seed: int, tmp_path: Path) -> None:
    one = both_ways(PINS, tmp_path, partial(session, seed), CYCLES, carrier)
    assert len(words(one, 0)) > 10
    assert len(words(one, 1)) > 3
    assert words(one, 2) == []
    valve = one.drives.drives[0]
    assert isinstance(valve, SimulatedDrive)
    assert [change.bits for change in valve.pins.history] == changes(words(one, 0))
    assert valve.pins.bits == 0, "safe with a fault"


def changes(sent: list[int]) -> list[int]:
    """The words that differ from the one before, from 0 on."""
    return [word for before, word in zip([0, *sent], sent, strict=False) if word != before]


def test_outputs_that_a_full_bus_refuses_come_in_a_later_cycle(tmp_path: Path) -> None:
    happens, chance = session(0), random.Random(0)
    for number in range(60, CYCLES - 100):
        if chance.random() < 0.5:
            refuse = Happening(lambda session: session.ends.refuse(canopen_frames.RPDO3 + 1, FULL))
            happens.setdefault(number, []).append(refuse)
    one = both_ways(PINS, tmp_path, lambda: happens, CYCLES, "virtual")
    assert any("Transmit buffer full" in repr(each) for each in one.heard if isinstance(each, tuple))
    valve = one.drives.drives[0]
    assert isinstance(valve, SimulatedDrive)
    assert [change.bits for change in valve.pins.history] == changes(words(one, 0))


@pytest.mark.parametrize("room", range(1, 9))
def test_a_socket_that_is_full_within_a_cycle_keeps_outputs_for_the_next(room: int, tmp_path: Path) -> None:
    happens = session(3)
    for number in range(101, 450, 9):
        happens.setdefault(number, []).append(Happening(lambda session: setattr(session, "room", room)))
    both_ways(PINS, tmp_path, lambda: happens, 450)


@pytest.fixture
def by_sdo(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives whose outputs, object 60FEh, no PDO takes."""
    made = ObjectEntry.__init__

    def unmappable(entry: ObjectEntry, variable: ODVariable) -> None:
        made(entry, variable)
        entry.mappable = entry.mappable and entry.index != 0x60FE

    monkeypatch.setattr(ObjectEntry, "__init__", unmappable)


@pytest.mark.usefixtures("by_sdo")
def test_outputs_by_sdo_are_left_to_python(tmp_path: Path) -> None:
    """Commands only, since these outputs may not be on a path."""
    happens = dict[int, list[Happening]]()
    requests: list[CommandRequest | GoalRequest] = [
        CommandRequest(30, "ann", Command.ENABLE),
        GoalRequest(100, "ann", "g", PoseGoal(0.05, 0.01, 0.0, speed=0.3), 0),
        *(CommandRequest(at, "ann", Command.SET_OUTPUT, SetOutput("valve", at % 2 == 1)) for at in (75, 150, 151, 232)),
    ]
    for request in requests:
        happens.setdefault(request.ticket, []).append(Happening(partial(Session.ask, request=request)))
    one = both_ways(PINS, tmp_path, lambda: happens, 400)
    assert words(one, 0) == []
    valve = one.drives.drives[0]
    assert isinstance(valve, SimulatedDrive)
    assert [change.bits >> 16 for change in valve.pins.history] == [1, 0, 1, 0]
    assert one.loop.control.fault is None


@pytest.mark.usefixtures("by_sdo")
def test_an_output_by_sdo_whose_request_is_lost_is_sent_again(tmp_path: Path) -> None:
    session = Session(PINS, tmp_path, "unix", compiled=True)
    take, lost = session.ends.take, list[bytes]()

    def lossy() -> bytes | None:
        packet = take()
        while packet is not None and not lost and packet[:2] == b"\x01\x06" and packet[9:11] == b"\xfe\x60":
            lost.append(packet)
            packet = take()
        return packet

    happens: dict[int, list[Happening]] = {
        30: [Happening(lambda session: session.ask(CommandRequest(30, "ann", Command.ENABLE)))],
        300: [
            Happening(lambda session: setattr(session.ends, "take", lossy)),
            Happening(
                lambda session: session.ask(CommandRequest(300, "ann", Command.SET_OUTPUT, SetOutput("valve", True)))
            ),
        ],
    }
    try:
        session.run(happens, 1200)
        valve = session.drives.drives[0]
        assert isinstance(valve, SimulatedDrive)
        assert len(lost) == 1
        assert [change.bits >> 16 for change in valve.pins.history] == [1]
        assert session.loop.compiled_cycles > 300
    finally:
        session.close()
