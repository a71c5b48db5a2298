"""Decisions beside the cycles: generated sessions keep their motion, and are replayed to the last bit."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from control_rig import carried
from generated import thinned
from msgspec import structs
from numpy.typing import NDArray
from processes.test_compiled_cycles import (
    CONFIGS,
    CYCLES,
    Happening,
    Session,
    cycles_by_python,
    requests_of_two,
    script,
    stops_first,
)
from processes.test_compiled_outputs import CYCLES as OUTPUT_CYCLES
from processes.test_compiled_outputs import INPUTS, OUTPUTS, PINS, changes
from processes.test_compiled_outputs import session as session_with_outputs
from trirail.analysis import replay
from trirail.config import Config
from trirail.control.control import Control
from trirail.processes import loop
from trirail.processes.cycle_caller import CycleCaller
from trirail.processes.cycle_core import Reached
from trirail.telemetry.recording import Recording
from trirail.wire import links
from trirail.wire.goals import PoseGoal, TrajectoryGoal, TrajectoryPoint
from trirail.wire.marks import Mark, StopAt
from trirail.wire.packets import (
    CommandRequest,
    ControlInput,
    DecidedAhead,
    EventReport,
    GoalRequest,
    Kind,
    decode_answer,
)
from trirail.wire.records import DTYPE, Part
from trirail.wire.vocabulary import MODES, Command, Mode
from trirail_drivers.bus.can_frame import CAN_FRAME, ERROR
from trirail_drivers.cia402.canopen_frames import SYNC
from trirail_drivers.simulated import SimulatedDrive

REFUSED = re.compile("no setpoint|setpoint refused")
"""Message of the last gate."""


def caller_of(session: Session) -> CycleCaller:
    """The caller of compiled code of a session."""
    assert session.loop._caller is not None
    return session.loop._caller


def recorded(
    session: Session, happens: dict[int, list[Happening]], cycles: int
) -> tuple[NDArray[np.void], list[ControlInput], list[EventReport]]:
    """Run a session; return its records, its inputs and its events."""
    packets: list[bytes] = []
    receive = session.recorder.receive

    def keep() -> bytes | None:
        if (packet := receive()) is not None:
            packets.append(bytes(packet))
        return packet

    session.recorder.receive = keep  # type: ignore[method-assign]
    session.run(happens, cycles)
    session.loop._flush()
    while keep() is not None:
        pass
    rows = b"".join(packet[1:] for packet in packets if packet[0] == Kind.RECORDS)
    messages = [decode_answer(packet[1:]) for packet in packets if packet[0] == Kind.MESSAGE]
    inputs = [each for each in messages if isinstance(each, ControlInput)]
    return np.frombuffer(rows, DTYPE), inputs, [each for each in messages if isinstance(each, EventReport)]


def replayed(config: Config, records: NDArray[np.void], inputs: list[ControlInput]) -> NDArray[np.bool]:
    """Return for each cycle whether its replay differs from its record."""
    drives, planner = replay._RecordedDrives(records), replay._RecordedPlanner(config)
    clock = replay._SimulatedClock(config.period)
    control = Control(config, drives, planner)
    setpoints, modes, outputs = replay._run(control, drives, planner, clock, records, inputs)
    commanded = np.stack([records[name] for name in replay.SETPOINT_FIELDS], axis=1)
    differs = (setpoints.view(np.int64) != commanded.view(np.int64)).any(axis=(1, 2))
    result: NDArray[np.bool] = differs | (modes != records["mode"]) | (outputs != records["outputs"]).any(axis=1)
    return result


def check_parts(config: Config, records: NDArray[np.void], inputs: list[ControlInput]) -> None:
    """Check replays of a session without one of the inputs around each end of cycles beside a decision."""
    t, wall = records["cycle"] * config.period, np.zeros(len(records), "datetime64[ns]")
    recording = Recording("demo", records, t, wall, [], {}, ())
    ends = [n for n, each in enumerate(inputs) if each.given == DecidedAhead(0)]
    assert ends
    for lacking in sorted({n for end in ends for n in range(end - 2, end + 3) if 0 < n < len(inputs) - 1}):
        requests = (*inputs[:lacking], *inputs[lacking + 1 :])
        compared = replay.replay_session(recording._replace(requests=requests), config, simulated=False)
        assert (compared.differing, compared.lacking > 0) == (0, True), (lacking, inputs[lacking - 3 : lacking + 2])


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize(
    ("protocol", "seed"),
    [
        *thinned((("cia402", seed) for seed in range(6)), every=3),
        *thinned(("odrive", seed) for seed in range(2)),
        ("two", 1),
        ("stops", 1),
    ],
)
def test_a_session_with_every_decision_beside_its_cycles_is_replayed_to_the_last_bit(
    protocol: str, seed: int, number: int, tmp_path: Path
) -> None:
    config = CONFIGS.get(protocol, CONFIGS["cia402"])
    session = Session(config, tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = number, number
    generate = {"two": requests_of_two, "stops": stops_first}.get(protocol)
    happens = generate(seed) if generate is not None else script(seed, protocol)
    try:
        records, inputs, events = recorded(session, happens, CYCLES)
    finally:
        session.close()
    ahead = [each.given.cycles for each in inputs if isinstance(each.given, DecidedAhead)]
    assert ahead.count(number) > 5
    assert np.array_equal(records["cycle"], np.arange(1, len(records) + 1))
    assert not [each.event.message for each in events if REFUSED.search(each.event.message)]
    differs = replayed(config, records, inputs)
    first = int(np.argmax(differs))
    assert not differs.any(), (
        first + 1,
        MODES[records["mode"][first]],
        [each for each in inputs if abs(each.cycle - first) < 5],
    )


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("rate", [20, 50, 100, 250])
@pytest.mark.long
def test_cycles_beside_a_decision_are_recorded_at_a_rate_at_which_a_batch_has_few_records(
    rate: int, number: int, tmp_path: Path
) -> None:
    config = CONFIGS["cia402"]
    config = structs.replace(config, loop=structs.replace(config.loop, rate_hz=rate))
    session = Session(config, tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = number, number
    try:
        records, inputs, events = recorded(session, script(3), CYCLES)
    finally:
        session.close()
    assert [each for each in inputs if isinstance(each.given, DecidedAhead)]
    assert np.array_equal(records["cycle"], np.arange(1, len(records) + 1))
    assert len(records) > 0.9 * CYCLES
    assert not [each.event.message for each in events if REFUSED.search(each.event.message)]
    assert not replayed(config, records, inputs).any()


def ask_before_decision(session: Session, command: Command) -> None:
    """Send a command so that the requested decision reads it, before compiled code notices that it is urgent."""
    session.ask(CommandRequest(8000, "ann", command))
    caller_of(session)._state.requested_called = True


MISHAPS: dict[str, Callable[[Session, random.Random], None]] = {
    "a strange frame": lambda session, _: session.inject(CAN_FRAME.pack(0x123, 2, b"ab")),
    "a statusword": lambda session, chance: session.inject(
        CAN_FRAME.pack(0x181 + chance.randrange(3), 2, struct.pack("<H", chance.choice((0x1637, 0x0637))))
    ),
    "a frame of wrong length": lambda session, chance: session.inject(
        CAN_FRAME.pack(0x281 + chance.randrange(3), 3, struct.pack("<i", 5))
    ),
    "a fault": lambda session, chance: session.drives.faults.add(f"{chance.choice('ABC')} fault 2310"),
    "a following error": lambda session, chance: session.drives.faults.carriages.push(chance.randrange(3), 0.05),
    "silence": lambda session, chance: session.drives.faults.add(f"{chance.choice('ABC')} silent for 0.004"),
    "late frames": lambda session, _: setattr(session, "holds", True),
    "a full bus": lambda session, chance: setattr(session, "room", chance.randrange(4)),
    "a stop": lambda session, _: session.ask(CommandRequest(8000, "ann", Command.STOP, carried(Command.STOP))),
    "a quick stop": lambda session, _: session.ask(CommandRequest(8000, "ann", Command.QUICK_STOP)),
    "a quick stop before the decision": lambda session, _: ask_before_decision(session, Command.QUICK_STOP),
    "a late tick": lambda session, chance: setattr(session, "late_ns", chance.choice((300_000, 900_000, 2_500_000))),
}
"""Events while cycles run beside a decision."""


@pytest.mark.parametrize("number", thinned([2, 1]))
@pytest.mark.parametrize("mishap", MISHAPS)
@pytest.mark.generated(1, 2)
def test_what_happens_beside_a_decision_is_handled_in_its_cycle(
    mishap: str, number: int, seed: int, tmp_path: Path
) -> None:
    """The cycles that were under way go on with the motion from before the decision, or a fault ends them."""
    config, chance = CONFIGS["cia402"], random.Random(seed)
    session = Session(config, tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = number, number
    run_beside, happened, began = caller.run_beside, [], []

    def ambushed(*arguments: Any) -> Any:
        if chance.random() < 0.2:
            MISHAPS[mishap](session, chance)
            began.append(caller._state.requested)
            happened.append(reached := run_beside(*arguments))
            return reached
        return run_beside(*arguments)

    caller.run_beside = ambushed  # type: ignore[assignment, method-assign]
    happens = script(seed)
    for at in range(200, CYCLES, 120):
        for later, name in enumerate((Command.RESET, Command.ENABLE)):
            request = CommandRequest(9000 + at + later, "ann", name)
            happens.setdefault(at + 15 * later, []).append(
                Happening(lambda session, request=request: session.ask(request))  # type: ignore[misc]
            )
    try:
        records, inputs, events = recorded(session, happens, CYCLES)
    finally:
        session.close()
    assert len(happened) > 3
    assert np.array_equal(records["cycle"], np.arange(1, len(records) + 1))
    assert not [each.event.message for each in events if REFUSED.search(each.event.message)]
    differs = replayed(config, records, inputs)
    assert not differs.any(), (int(np.argmax(differs)) + 1, mishap)
    syncs = sum(CAN_FRAME.unpack(packet)[0] == SYNC for packet in session.sent)
    assert mishap == "a full bus" or syncs == len(records), "each cycle sends one SYNC and has one record"
    for cycle in began:
        modes = [MODES[each] for each in records["mode"][cycle : cycle + 3]]
        if mishap.startswith("a quick stop"):
            assert modes[0] is Mode.FAULT
        elif mishap == "a stop":
            assert len(modes) < 3 or modes[2] is not Mode.MOVING
    if mishap not in ("a late tick", "late frames", "silence", "a fault", "a following error"):  # drives answer later
        assert {*happened} - {Reached.DONE}, "some of it needed Python"


def test_a_quick_stop_in_the_second_cycle_beside_a_decision_is_handled_in_it(tmp_path: Path) -> None:
    """The first of these cycles needs Python, so that Python runs the second as well."""
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = 2, 2
    run_beside, record = caller.run_beside, caller.record
    asked: list[int] = []

    def ambushed(*arguments: Any) -> Any:
        state = caller._state
        if state.cycle > 300 and state.until == state.requested + 2 and not asked:
            session.inject(CAN_FRAME.pack(0x123, 2, b"ab"))  # for Python
        return run_beside(*arguments)

    def recorded_first(overruns: Any) -> int:
        number = record(overruns)
        if not asked:
            asked.append(number)
            session.ask(CommandRequest(8000, "ann", Command.QUICK_STOP))
        return number

    caller.run_beside, caller.record = ambushed, recorded_first  # type: ignore[assignment, method-assign]
    try:
        records, inputs, _ = recorded(session, script(1), CYCLES)
    finally:
        session.close()
    assert not replayed(CONFIGS["cia402"], records, inputs).any()
    check_parts(CONFIGS["cia402"], records, inputs)
    assert MODES[records["mode"][asked[0] - 1]] is not Mode.FAULT
    assert MODES[records["mode"][asked[0]]] is Mode.FAULT


@pytest.mark.parametrize("command", [Command.STOP, Command.QUICK_STOP, Command.PAUSE, Command.DISABLE])
@pytest.mark.generated(1, 2)
def test_a_stop_that_arrives_while_nothing_is_decided_takes_effect_in_its_cycle(
    seed: int, command: Command, tmp_path: Path
) -> None:
    chance = random.Random(seed)
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    asked: list[int] = []

    def stop(session: Session) -> None:
        asked.append(session.loop.control.cycles)
        session.ask(CommandRequest(9, "ann", command))

    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        150: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "g", PoseGoal(0.08, 0.0, 0.0), 0)))],
        chance.randrange(180, 300): [Happening(stop)],
    }
    try:
        records, inputs, _ = recorded(session, happens, 400)
    finally:
        session.close()
    at = asked[0]
    assert MODES[records["mode"][at - 1]] is Mode.MOVING
    assert MODES[records["mode"][at]] in (Mode.STOPPING, Mode.FAULT)
    assert not replayed(CONFIGS["cia402"], records, inputs).any()


def restart_gateway(session: Session) -> None:
    """Close the gateway's end, and connect another."""
    session.gateway.close()
    session.gateway = links.connect(session.folder / "gateway")
    session._stack.callback(session.gateway.close)


RAMP_AT = 200
"""Number of a turn in which a lower rate is asked for: decisions are due in each of the next cycles."""
ALLOWED_LATE = CONFIGS["cia402"].watchdogs.max_overruns
DUE: dict[str, Callable[[Session], None]] = {
    "stop": lambda session: session.ask(CommandRequest(9, "ann", Command.STOP)),
    "disable": lambda session: session.ask(CommandRequest(9, "ann", Command.DISABLE)),
    "pause": lambda session: session.ask(CommandRequest(9, "ann", Command.PAUSE)),
    "quick stop": lambda session: session.ask(CommandRequest(9, "ann", Command.QUICK_STOP)),
    "the gateway dies": restart_gateway,
    "a late tick": lambda session: setattr(session, "late_ns", round(1e9 * session.config.period * (ALLOWED_LATE + 2))),
}


def ramping(what: Callable[[Session], None], later: int) -> dict[int, list[Happening]]:
    """A goal whose rate is lowered, and what happens some cycles later."""
    rate = CommandRequest(3, "ann", Command.OVERRIDE, carried(Command.OVERRIDE, 0.2))
    return {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        150: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "g", PoseGoal(0.08, 0.0, 0.0), 0)))],
        RAMP_AT: [Happening(lambda session: session.ask(rate))],
        RAMP_AT + later: [Happening(what)],
    }


@pytest.mark.parametrize("what", DUE)
@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.generated(1, 2)
def test_what_must_not_wait_does_not_although_a_decision_is_due_in_every_cycle(
    seed: int, number: int, what: str, tmp_path: Path
) -> None:
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = 1, number
    began: list[int] = []

    def happens(session: Session) -> None:
        began.append(session.loop.control.cycles)
        DUE[what](session)

    try:
        records, inputs, _ = recorded(session, ramping(happens, random.Random(seed).randrange(3, 6)), 400)
    finally:
        session.close()
    ahead = {each.cycle for each in inputs if isinstance(each.given, DecidedAhead)}
    assert {began[0] - 1, began[0]} & ahead, "decisions are made in every cycle"
    assert MODES[records["mode"][began[0] - 1]] is Mode.MOVING
    allowed = 2 if what == "a late tick" else 0
    assert any(MODES[each] is not Mode.MOVING for each in records["mode"][began[0] : began[0] + 1 + allowed])
    assert not replayed(CONFIGS["cia402"], records, inputs).any()


def test_a_frozen_gateway_is_noticed_although_decisions_are_made_in_every_cycle(tmp_path: Path) -> None:
    stopped: list[int] = []
    goal = GoalRequest(2, "ann", "g", PoseGoal(0.08, 0.0, 0.0, speed=0.05), 0)
    for beside in (0, 0), (1, 1), (2, 2):
        folder = tmp_path / str(beside[0])
        folder.mkdir()
        session = Session(CONFIGS["cia402"], folder, "unix", compiled=True)
        caller_of(session).cycles_beside = beside
        happens = {
            30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
            100: [Happening(lambda session: session.ask(goal))],
            200: [Happening(lambda session: setattr(session, "beats", False))],
        }
        for at in range(201, 900):
            refused = CommandRequest(1000 + at, "ann", Command.ENABLE)
            happens[at] = [Happening(lambda session, refused=refused: session.ask(refused))]  # type: ignore[misc]
        try:
            _, _, events = recorded(session, happens, 900)
        finally:
            session.close()
        stopped.append(next(each.event.cycle for each in events if "the gateway is frozen" in each.event.message))
    assert max(stopped) - min(stopped) <= 3


def test_stops_while_the_robot_brakes_leave_the_cycles_to_compiled_code(tmp_path: Path) -> None:
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    before: list[int] = []

    def stop(session: Session) -> None:
        before.append(cycles_by_python(session))
        session.ask(CommandRequest(10 + len(before), "ann", Command.STOP))

    happens = ramping(stop, 10)
    for later in (14, 18, 22):
        happens[RAMP_AT + later] = [Happening(stop)]
    happens[RAMP_AT + 60] = [Happening(lambda session: before.append(cycles_by_python(session)))]
    try:
        recorded(session, happens, 400)
    finally:
        session.close()
    assert before[-1] - before[0] <= 8, "two for each stop"


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.generated(1, 2, 0)
def test_an_input_that_changes_beside_a_decision_is_reported_and_stops_its_goal(
    seed: int, number: int, tmp_path: Path
) -> None:
    """The edge takes effect after the cycles beside the decision, at the latest."""
    chance = random.Random(seed)
    config = structs.replace(CONFIGS["cia402"], inputs=INPUTS)
    session = Session(config, tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = number, number
    run_beside = caller.run_beside
    pressed: list[tuple[int, bool]] = []

    def ambushed(*arguments: Any) -> Any:
        if chance.random() < 0.3 and caller._state.cycle < CYCLES - 10:
            on = not (pressed and pressed[-1][1])
            pressed.append((caller._state.cycle, on))
            session.drives.press(1, on << INPUTS["part"].bit)
        return run_beside(*arguments)

    caller.run_beside = ambushed  # type: ignore[assignment, method-assign]
    happens = {30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))]}
    for at in range(200, CYCLES - 40, 160):
        for later in (20, 35, 50):
            refused = CommandRequest(5000 + at + later, "ann", Command.ENABLE)
            happens[at + later] = [Happening(lambda session, refused=refused: session.ask(refused))]  # type: ignore[misc]
        stop_at = StopAt("part", chance.choice(("rising", "falling")))
        goal = PoseGoal(chance.uniform(-0.05, 0.05), chance.uniform(-0.05, 0.05), 0.0, stop_at=stop_at)
        request = GoalRequest(at, "ann", f"g{at}", goal, 0)
        happens[at] = [Happening(lambda session, request=request: session.ask(request))]  # type: ignore[misc]
    try:
        records, inputs, events = recorded(session, happens, CYCLES)
    finally:
        session.close()
    reported = [(each.event.cycle, each.event.message) for each in events if each.event.kind == "input"]
    assert len(pressed) > 5
    assert ["switched on" in message for _, message in reported] == [on for _, on in pressed]
    assert all(0 <= at - cycle <= 2 + number for (at, _), (cycle, _) in zip(reported, pressed, strict=True))
    changes_at = np.flatnonzero(np.diff(records["inputs"][:, 1], prepend=0))
    places = [f"at x {x * 1e3:.3f} mm, y {y * 1e3:.3f} mm" for x, y, _ in records["pose"][changes_at].tolist()]
    assert all(place in message for (_, message), place in zip(reported, places, strict=True))
    assert any("done: input part" in each.event.message for each in events)
    differs = replayed(config, records, inputs)
    assert not differs.any(), int(np.argmax(differs)) + 1


def test_an_edge_from_before_the_start_of_a_goal_does_not_end_it(tmp_path: Path) -> None:
    """It is noticed in the last cycle before the goal, beside the decision that starts the goal."""
    config = structs.replace(CONFIGS["cia402"], inputs=INPUTS)
    session = Session(config, tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = 2, 2
    decide = caller._answer

    def press_at_start() -> None:
        before = session.loop.control.ledger.goal
        decide()
        if before is None and session.loop.control.ledger.goal is not None:
            session.drives.press(1, 1 << INPUTS["part"].bit)

    caller._answer = press_at_start  # type: ignore[method-assign]
    goal = PoseGoal(0.03, 0.0, 0.0, stop_at=StopAt("part", "rising"))
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        150: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "g", goal, 0)))],
    }
    try:
        records, inputs, events = recorded(session, happens, 800)
    finally:
        session.close()
    (noticed,) = np.flatnonzero(np.diff(records["inputs"][:, 1]))
    assert MODES[records["mode"][noticed + 1]] is Mode.HOLDING
    assert MODES[records["mode"][noticed + 2]] is Mode.MOVING
    (ended,) = (each.event for each in events if each.event.outcome is not None)
    assert "arrived" in ended.message
    assert not replayed(config, records, inputs).any()


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("follower_ends_there", [False, True])
def test_an_edge_in_the_last_cycles_of_a_goal_stops_the_robot_also_where_it_passes_on(
    number: int, follower_ends_there: bool, tmp_path: Path
) -> None:
    """It is noticed beside the decision that passes on to the next goal."""
    config = structs.replace(CONFIGS["cia402"], inputs=INPUTS)
    session = Session(config, tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = number, number
    decide = caller._answer

    def press_at_passage() -> None:
        goals = [goal.id for goal in session.loop.control.ledger.goals]
        decide()
        if goals == ["first", "second"] and session.loop.control.ledger.goals[0].id == "second":
            session.drives.press(1, 1 << INPUTS["part"].bit)

    caller._answer = press_at_passage  # type: ignore[method-assign]
    edge = StopAt("part", "rising")
    first = PoseGoal(0.03, 0.0, 0.0, blend=0.005, speed=0.3, stop_at=edge)
    second = PoseGoal(0.03, 0.05, 0.0, blend=0.005, speed=0.3, stop_at=edge if follower_ends_there else None)
    happens = {
        30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))],
        150: [Happening(lambda session: session.ask(GoalRequest(2, "ann", "first", first, 0)))],
        170: [Happening(lambda session: session.ask(GoalRequest(3, "ann", "second", second, 0)))],
    }
    try:
        records, inputs, events = recorded(session, happens, 1500)
    finally:
        session.close()
    told = [each.event.message for each in events if each.event.outcome is not None]
    assert told == ["goal first done: passed on the way to goal second", "goal second stopped: input part rising"]
    assert np.abs(records["commanded_pose"][-1] - (0.03, 0.05, 0.0)).max() > 0.04
    assert not replayed(config, records, inputs).any()


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.generated(4125785050, 0, 1, 2, 3)
def test_outputs_switch_as_without_cycles_beside_decisions(seed: int, number: int, tmp_path: Path) -> None:
    session = Session(PINS, tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = number, number
    try:
        records, inputs, events = recorded(session, session_with_outputs(seed), OUTPUT_CYCLES)
    finally:
        session.close()
    ahead = [each.given.cycles for each in inputs if isinstance(each.given, DecidedAhead)]
    assert ahead.count(number) > 10
    differs = replayed(PINS, records, inputs)
    assert not differs.any(), int(np.argmax(differs)) + 1
    valve = session.drives.drives[0]
    assert isinstance(valve, SimulatedDrive)
    recorded_words = [0, *records["outputs"][:, 0].tolist()]
    assert [change.bits for change in valve.pins.history] == changes(recorded_words)
    switches = [switch for each in events for switch in each.event.marks or () if switch.output == "valve"]
    assert len(switches) > 2
    for switch in switches:
        assert records["outputs"][switch.cycle - 1, 0] == (switch.value << OUTPUTS["valve"].bit)


def test_a_warning_of_the_bus_beside_a_decision_is_reported(tmp_path: Path) -> None:
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = 2, 2
    run_beside, began = caller.run_beside, []

    def ambushed(*arguments: Any) -> Any:
        began.append(caller._state.cycle)
        if len(began) == 5:
            session.inject(CAN_FRAME.pack(ERROR | 0x004, 8, bytes((0, 0x10)).ljust(8, b"\0")))  # error-passive
        return run_beside(*arguments)

    caller.run_beside = ambushed  # type: ignore[assignment, method-assign]
    try:
        _, _, events = recorded(session, script(1), CYCLES)
    finally:
        session.close()
    reported = [each.event.cycle for each in events if "error-passive" in each.event.message]
    assert len(reported) == 1
    assert 0 <= reported[0] - began[4] <= 3


@pytest.mark.parametrize("beside", [(0, 0), (1, 1), (2, 2)])
def test_the_override_acts_again_after_a_goal_that_forbids_it_has_been_refused(
    beside: tuple[int, int], tmp_path: Path
) -> None:
    """While the goal is planned, the motion before it slows down; nothing else is decided afterwards."""
    session = Session(PINS, tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = beside
    merged = Mark("valve", start=0.002, end=0.03, increment=0.0004, pulse_width=0.02)
    requests: list[CommandRequest | GoalRequest] = [
        CommandRequest(30, "ann", Command.ENABLE),
        CommandRequest(60, "ann", Command.OVERRIDE, carried(Command.OVERRIDE, 1.5)),
        GoalRequest(100, "ann", "a", PoseGoal(0.09, 0.05, 0.0, speed=0.2, blend=0.01), 0),
        GoalRequest(400, "ann", "b", PoseGoal(0.0, 0.0, 0.0, speed=0.3, blend=0.01, marks=(merged,)), 0),
    ]
    happens: dict[int, list[Happening]] = {
        each.ticket: [Happening(lambda session, each=each: session.ask(each))]  # type: ignore[misc]
        for each in requests
    }
    try:
        records, inputs, events = recorded(session, happens, 1000)
    finally:
        session.close()
    assert [each.event.outcome for each in events if each.event.kind == "goal" and each.event.id == "b"] == ["rejected"]
    speeds = np.linalg.norm(records["commanded_pose_velocity"][:, :2], axis=1)
    assert speeds[800] > 1.9 * speeds[390]
    assert not replayed(PINS, records, inputs).any()


def test_what_a_command_to_the_drives_beside_cycles_warns_of_is_reported(tmp_path: Path) -> None:
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    caller_of(session).cycles_beside = 1, 1
    disable = session.driver.disable

    def refused() -> None:
        session.ends.leave_room(0)
        disable()

    session.driver.disable = refused  # type: ignore[method-assign]
    happens: dict[int, list[Happening]] = {
        30: [Happening(lambda session: session.ask(CommandRequest(30, "ann", Command.ENABLE)))],
        200: [Happening(lambda session: session.ask(GoalRequest(200, "ann", "g", PoseGoal(0.08, 0.0, 0.0), 0)))],
        300: [Happening(lambda session: session.ask(CommandRequest(300, "ann", Command.DISABLE)))],
    }
    try:
        _, _, events = recorded(session, happens, 700)
    finally:
        session.close()
    assert len([each for each in events if "cannot send" in each.event.message]) == 1


def test_the_parts_of_a_cycle_are_measured_from_its_own_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a frame that nobody expected makes Python finish the cycles beside a decision."""
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter_ns=lambda: round(session.clock() * 1e9)))
    caller = caller_of(session)
    caller.cycles_beside = 2, 2
    run_beside, strange = caller.run_beside, list[int]()

    def ambushed(*arguments: Any) -> Any:
        strange.append(session.loop.control.cycles)
        session.inject(CAN_FRAME.pack(0x123, 2, b"ab"))
        return run_beside(*arguments)

    caller.run_beside = ambushed  # type: ignore[assignment, method-assign]
    try:
        records, _, _ = recorded(session, script(1), CYCLES)
    finally:
        session.close()
    assert len(strange) > 5
    period_ns = round(session.loop.control.period * 1e9)
    measured = records["parts_ns"][:, : Part.RECORD]
    assert (measured.sum(axis=1) < period_ns).all(), records["cycle"][measured.sum(axis=1) >= period_ns]


@pytest.mark.parametrize("strange", [False, True])
@pytest.mark.parametrize("number", [1, 2])
def test_commands_to_the_drives_know_the_next_tick(number: int, strange: bool, tmp_path: Path) -> None:
    """They would delay the SYNC; also if a frame that nobody expected has made Python finish the cycles beside."""
    session = Session(CONFIGS["cia402"], tmp_path, "unix", compiled=True)
    caller = caller_of(session)
    caller.cycles_beside = number, number
    run_beside, disable, known = caller.run_beside, session.driver.disable, list[tuple[float, float]]()

    def ambushed(*arguments: Any) -> Any:
        if strange and session.loop.control.cycles > 340:
            session.inject(CAN_FRAME.pack(0x123, 2, b"ab"))
        return run_beside(*arguments)

    def noted() -> None:
        known.append((session.driver.next_sync, session.ticker.deadline_ns * 1e-9 + session.loop.control.period))
        disable()

    caller.run_beside, session.driver.disable = ambushed, noted  # type: ignore[assignment, method-assign]
    happens: dict[int, list[Happening]] = {
        30: [Happening(lambda session: session.ask(CommandRequest(30, "ann", Command.ENABLE)))],
        200: [Happening(lambda session: session.ask(GoalRequest(200, "ann", "g", PoseGoal(0.08, 0.0, 0.0), 0)))],
        300: [Happening(lambda session: session.ask(CommandRequest(300, "ann", Command.DISABLE)))],
    }
    try:
        session.run(happens, 700)
    finally:
        session.close()
    ((next_sync, tick),) = known
    assert next_sync == pytest.approx(tick, abs=1e-6)


PATHS = ((200, 0.2), (500, 0.2345), (800, 0.25), (1100, 0.3))
"""Cycles in which paths are requested, and their durations [s]."""


def path_lengths(session: Session, disturbed_at: list[int]) -> tuple[list[int], bool]:
    """Run a session with paths and requests that are refused; return the cycles of each path.

    Also return whether there were decisions beside the cycles.
    """
    happens = {30: [Happening(lambda session: session.ask(CommandRequest(1, "ann", Command.ENABLE)))]}
    for at, duration in PATHS:
        x = 1e-5 * (at - 200), 1e-5 * (at + 100)
        points = TrajectoryPoint(0.0, x[0], 0.0, 0.0), TrajectoryPoint(duration, x[1], 0.0, 0.0)
        goal = GoalRequest(at, "ann", f"g{at}", TrajectoryGoal(points, settle=False), 0)
        happens[at] = [Happening(lambda session, goal=goal: session.ask(goal))]  # type: ignore[misc]
    for at in disturbed_at:
        request = CommandRequest(5000 + at, "ann", Command.ENABLE)
        happens[at] = [Happening(lambda session, request=request: session.ask(request))]  # type: ignore[misc]
    try:
        records, inputs, _ = recorded(session, happens, CYCLES)
    finally:
        session.close()
    changes = np.flatnonzero(np.diff((records["mode"] == MODES.index(Mode.MOVING)).astype(int)))
    return np.diff(changes)[::2].tolist(), any(isinstance(each.given, DecidedAhead) for each in inputs)


@pytest.mark.generated(0, 2, 3, 4, 5, 1)
def test_a_path_ends_in_the_same_cycle_as_without_cycles_beside_decisions(seed: int, tmp_path: Path) -> None:
    """Other requests arrive in its last cycles, and decisions take more time than expected."""
    chance = random.Random(seed)
    ends = [at + round(1e3 * duration) for at, duration in PATHS]
    disturbed_at = [end - back for end in ends for back in chance.sample(range(-4, 8), 4)] if seed > 0 else []
    lengths = []
    for beside in (0, 0), (1, 1), (2, 2), (0, 2):
        folder = tmp_path / "-".join(map(str, beside))
        folder.mkdir()
        session = Session(CONFIGS["cia402"], folder, "unix", compiled=True)
        caller_of(session).cycles_beside = beside
        if beside == (0, 2):
            budget = session.loop._decision_budget
            budget.note = lambda _, budget=budget: setattr(budget, "ns", chance.randrange(2_000_000))  # type: ignore[method-assign, misc]
        each, ahead = path_lengths(session, disturbed_at)
        lengths.append(each)
        assert ahead == (beside != (0, 0))
    assert len(lengths[0]) == len(PATHS)
    assert lengths == lengths[:1] * 4
