"""What programs hand to the clients: numbers of any library, arrays, files, and what is none; after the end, too."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import inspect
import math
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, cast

import msgspec
import numpy as np
import pytest
import zenoh
from control_rig import carried
from cyclopts import App, CycloptsError
from msgspec import structs
from refusals import refused_as
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.cli.app import app
from trirail.cli.options import Service
from trirail.cli.robot_commands import command_line_of
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.client.outgoing import number, seconds
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import boundary
from trirail.wire.goals import KINDS as EVERY_KIND
from trirail.wire.goals import Goal, OwnLimits, PathGoal, PoseGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.messages import CommandReply, Event, GoalReply
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Override, ReleaseLease, Stop
from trirail.wire.zenoh_session import open_service

ENDED = Event(seq=1, t=0.0, cycle=0, time=1.0, kind="goal", level="info", message="so it ended", outcome="done")


class Taken:
    """A service that takes whatever it can read, keeps it, and ends a goal that is to stand."""

    def __init__(self, session: zenoh.Session) -> None:
        self.said: list[Any] = []
        self._events = 0
        self._session = session
        self._declared = session.declare_queryable(
            "trirail/demo/**", zenoh.handlers.Callback(self._answer, indirect=False)
        )

    def _answer(self, query: zenoh.Query) -> None:
        _, _, what, *rest = str(query.key_expr).split("/")
        payload = query.payload.to_bytes() if query.payload is not None else b""
        with query:
            reply: msgspec.Struct
            if what in ("goal", "check"):
                goal = boundary.decode(payload, Goal if what == "goal" else PathGoal, "not a goal")
                self.said.append(goal)
                reply = GoalReply(goal.id or "", 1.0)
                if isinstance(goal, VelocityGoal) and not any((goal.x, goal.y, goal.phi)):
                    self._end(goal.id)
            else:
                command = Command(rest[-1])
                content = boundary.decode(payload, command.accepts, "not that") if payload else None
                self.said.append(content)
                if isinstance(content, Stop):
                    self._end(content.goal)
                reply = CommandReply(command, "holding", 1)
            query.reply(query.key_expr, msgspec.json.encode(reply))

    def _end(self, goal_id: str | None) -> None:
        self._events += 1
        event = msgspec.structs.replace(ENDED, seq=self._events, id=goal_id)
        self._session.put("trirail/demo/event", msgspec.json.encode(event))

    def taken(self) -> list[Any]:
        """Return what was said since the last time, but for ids that clients make."""
        said, self.said = self.said, []
        return [
            msgspec.structs.replace(each, id=None) if getattr(each, "id", None) is not None else each
            for each in said
            if not isinstance(each, ReleaseLease | Stop)
        ]


@pytest.fixture(scope="module")
def connect(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    locator = f"unixsock-stream/{tmp_path_factory.mktemp('outgoing')}/zenoh"
    with open_service([locator]) as session:
        SERVICE.append(Taken(session))
        yield locator
        SERVICE.clear()


SERVICE: list[Taken] = []


# ---------------------------------------------------------------------- one way to call both clients


async def done(robot: Any, call: Call, value: Any) -> None:
    """Call a method of either client, and enter what it returns."""
    result = call(robot, value)
    if inspect.isawaitable(result):
        result = await result
    if hasattr(result, "__aenter__"):
        async with result as entered:
            if hasattr(entered, "update"):
                await entered.update(*updated(value))
    elif hasattr(result, "__enter__"):
        with result as entered:
            if hasattr(entered, "update"):
                entered.update(*updated(value))


def updated(value: Any) -> tuple[Any, Any, Any]:
    return (value, value, value), (value, value, value), value


@asynccontextmanager
async def client(kind: type[Robot | AsyncRobot], connect: str) -> AsyncIterator[Any]:
    if issubclass(kind, AsyncRobot):
        async with AsyncRobot("demo", connect, "ann") as opened:
            yield opened
    else:
        with Robot("demo", connect, "ann") as robot:
            yield robot


def limits(n: Any) -> OwnLimits:
    return OwnLimits((n, n, n), (n, n, n), (n, n, n))


Call = Callable[[Any, Any], Any]
CALLS: dict[str, Call] = {
    "move_to": lambda robot, n: robot.move_to(n, n, n),
    "move_to, all": lambda robot, n: robot.move_to(
        x=n, y=n, phi=n, speed=n, limits=limits(n), blend=n, valid_for=n, tool=(n, n)
    ),
    "move": lambda robot, n: robot.move(n, n, n, speed=n, limits=limits(n), blend=n, valid_for=n, tool=(n, n)),
    "move_to_named": lambda robot, n: robot.move_to_named("out", speed=n, limits=limits(n), blend=n, valid_for=n),
    "move_sliders": lambda robot, n: robot.move_sliders(n, n, n, speed=n, valid_for=n),
    "follow": lambda robot, n: robot.follow([TrajectoryPoint(0.0, n, n, n), TrajectoryPoint(n, n, n, n, (n, n, n))]),
    "follow, rows": lambda robot, n: robot.follow([(0.0, n, n, n), [n, n, n, n]]),
    "marks": lambda robot, n: robot.move(
        marks=[{"output": "lamp", "after_start": n}, {"output": "lamp", "at": {"phi": n}, "pulse_width": n}]
    ),
    "jog": lambda robot, n: robot.jog(n, n, n, timeout=n, tool=(n, n)),
    "track": lambda robot, n: robot.track(timeout=n),
    "check": lambda robot, n: robot.check(PoseGoal(n, n, n, speed=n, limits=limits(n), valid_for=n)),
    "override": lambda robot, n: robot.override(n),
    "lease": lambda robot, n: robot.lease(timeout=n),
    "acquire": lambda robot, n: robot.acquire(AcquireLease("mine", n)),
}


class Floatlike:
    def __init__(self, value: float) -> None:
        self.value = float(value)

    def __float__(self) -> float:
        return self.value


class Indexlike:
    def __init__(self, value: float) -> None:
        self.value = int(value)

    def __index__(self) -> int:
        return self.value


KINDS: dict[str, tuple[Callable[[float], Any], float]] = {
    **{kind.__name__: (kind, 0.5) for kind in (np.float16, np.float32, np.float64, np.longdouble, Decimal, Fraction)},
    **{kind.__name__: (kind, 1) for kind in (int, np.int8, np.int64, np.uint16, Indexlike)},
    "Floatlike": (Floatlike, 0.5),
    "0-d array": (lambda value: np.array(value, np.float32), 0.5),
    "0-d integer": (lambda value: np.array(value, np.int32), 1),
}
"""Each with what both its maker and every method take."""


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_every_method_takes_every_kind_of_number(kind: type[Robot | AsyncRobot], connect: str) -> None:
    async def run() -> None:
        async with client(kind, connect) as robot:
            for name, call in CALLS.items():
                for made, (make, value) in KINDS.items():
                    asked = 1 if name == "override" else value  # half a percent is none
                    await done(robot, call, float(asked))
                    plain = SERVICE[0].taken()
                    await done(robot, call, make(asked))
                    assert SERVICE[0].taken()[:1] == plain[:1] != [], (name, made)

    asyncio.run(run())


GUIDE = (Path(__file__).parents[2] / "service/talking.md").read_text(encoding="utf-8")
EXAMPLES = [
    line for line in GUIDE.splitlines() if line.startswith("{") and '"kind": ' in line and '"seq": ' not in line
]
"""Of goals, one at least of each kind: tests/motion/test_kinds.py."""


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_a_goal_of_any_kind_and_any_command_with_its_content_are_sent_as_they_are(
    kind: type[Robot | AsyncRobot], connect: str
) -> None:
    goals: list[Goal] = [boundary.decode(line.encode(), Goal, "no goal") for line in EXAMPLES]
    contents = {name: carried(name) for name in Command}

    async def run() -> None:
        async with client(kind, connect) as robot:
            for goal in goals:
                await done(robot, lambda robot, goal: robot.send(goal), goal)
                assert SERVICE[0].taken() == [structs.replace(goal, id=None)]
                if type(goal).renewed:
                    with refused_as(RefusalCode.MALFORMED):
                        await done(robot, lambda robot, goal: robot.check(goal), goal)
                else:
                    await done(robot, lambda robot, goal: robot.check(goal), goal)
                    assert SERVICE[0].taken() == [structs.replace(goal, id=None)]
            for name, content in contents.items():
                if name not in STOPS:
                    await done(robot, lambda robot, order: robot.command(*order), (name, content))
                    assert SERVICE[0].taken() == [content] * (name is not Command.RELEASE)  # which is not kept

    asyncio.run(run())
    assert {type(goal) for goal in goals} == set(EVERY_KIND)


@pytest.mark.parametrize("line", EXAMPLES)
def test_the_command_line_sends_a_goal_of_any_kind(line: str, connect: str) -> None:
    assert app(["goal", line, "--connect", connect], exit_on_error=False, result_action="return_value") == 0
    goal = boundary.decode(line.encode(), Goal, "no goal")
    assert SERVICE[0].taken() == [structs.replace(goal, id=None)]


def test_the_command_line_sends_a_command_with_the_numbers_that_it_cannot_come_without(connect: str) -> None:
    made = App()
    made.command(command_line_of(Command.OVERRIDE), name="override")
    made(["override", "50", "--connect", connect], exit_on_error=False, result_action="return_value")
    assert SERVICE[0].taken() == [Override(50.0)]
    with pytest.raises(CycloptsError):
        made(["override", "--connect", connect], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
@pytest.mark.parametrize("content", [None, b"{}", Stop()])
@pytest.mark.parametrize("name", ["bogus", "", "STOP", "stop/now", "st*", "stop#", "stop?", "*", "/", "$"])
def test_a_command_that_there_is_not_is_refused_and_not_sent(
    name: str, content: CommandContent | bytes | None, kind: type[Robot | AsyncRobot], connect: str
) -> None:
    async def run() -> None:
        async with client(kind, connect) as robot:
            with refused_as(RefusalCode.UNKNOWN_COMMAND):
                await done(robot, lambda robot, order: robot.command(*order), (name, content))
            assert SERVICE[0].taken() == []

    asyncio.run(run())


class Label(CommandContent, frozen=True):
    """A content that no command has yet, with a field of each plain type."""

    text: Annotated[str, msgspec.Meta(max_length=64)]
    size: float
    count: int
    bold: bool = False


def test_a_new_commands_fields_of_any_type_are_arguments_of_its_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[object] = []

    class Robot:
        def command(self, _name: str, content: object) -> CommandReply:
            sent.append(content)
            return CommandReply("label", "holding", 1)

    monkeypatch.setattr(Service, "open", lambda _: contextlib.nullcontext(Robot()))
    command = SimpleNamespace(content=Label)
    made = App()
    made.command(command_line_of(command), name="label")  # type: ignore[arg-type]
    made(["label", "hello there", "0.5", "3"], exit_on_error=False, result_action="return_value")
    assert sent == [Label("hello there", 0.5, 3)]


NONE: tuple[Any, ...] = (
    *("0.5", b"0.5", bytearray(b"1"), np.str_("0.5"), np.bytes_(b"1"), "", None, True, np.True_, [0.5], (0.5,), {}),
    *(np.array([0.5]), np.array([[0.5]]), np.array([]), np.array("0.5"), np.array(True), np.array(0.5 + 1j)),
    *(object(), 0.5j, np.complex128(0.5), float("nan"), math.inf, np.float64("nan"), np.float32("inf"), 10**400),
    *(Floatlike(math.nan), Fraction(10**400), Decimal("nan"), Decimal("1e999"), datetime.timedelta(seconds=1)),
    *(np.timedelta64(1, "s"), np.datetime64("2026-01-01"), print, float),
)


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_what_is_no_number_is_refused_by_every_method_and_not_sent(
    kind: type[Robot | AsyncRobot], connect: str
) -> None:
    refused: dict[str, Call] = CALLS | {
        "move_to": lambda robot, n: robot.move_to(0.0, 0.0, n),
        "move": lambda robot, n: robot.move(y=n),
        "speed": lambda robot, n: robot.move(speed=n),
        "limits": lambda robot, n: robot.move(limits=OwnLimits(velocity=(1.0, n, 1.0))),
        "tool": lambda robot, n: robot.move(tool=(0.0, n)),
        "third slider": lambda robot, n: robot.move_sliders(0.0, 0.0, n),
        "last row": lambda robot, n: robot.follow([(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, n)]),
        "jog's timeout": lambda robot, n: robot.jog(timeout=n),
    }

    async def run() -> None:
        async with client(kind, connect) as robot:
            for name, call in refused.items():
                for value in NONE:
                    with pytest.raises((RefusedError, ValueError)) as found:
                        await done(robot, call, value)
                    of_record = "is not a finite number" in str(found.value)  # before the client gets it
                    assert of_record or getattr(found.value, "code", None) is RefusalCode.MALFORMED, (name, value)
                    assert SERVICE[0].taken() == [], (name, value)

    asyncio.run(run())


WAITS: dict[str, Call] = {
    "state": lambda robot, n: robot.state(n),
    "states": lambda robot, n: robot.states(n),
    "events": lambda robot, n: robot.events(timeout=n),
    "wait": lambda robot, n: robot.lease().wait(n),
}


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_a_timeout_is_any_number_or_none_and_nothing_else(kind: type[Robot | AsyncRobot], connect: str) -> None:
    async def run() -> None:
        async with client(kind, connect) as robot:
            goal = robot.move_to(0.0, 0.0, 0.0)
            goal = await goal if inspect.isawaitable(goal) else goal
            waits = WAITS | {"goal": lambda _, n: goal.wait(n)}
            for call in waits.values():
                for value in (value for value in (*NONE, -1.0) if value is not None and value is not math.inf):
                    with refused_as(RefusalCode.MALFORMED):
                        await done(robot, call, value)
                for make, value in KINDS.values():
                    with contextlib.suppress(ServiceError, TimeoutError):
                        waiting = call(robot, make(0 * value))
                        if inspect.isawaitable(waiting):
                            await waiting
            SERVICE[0].taken()

    asyncio.run(run())


def test_a_timeout_longer_than_can_be_waited_is_none() -> None:
    assert [seconds(value) for value in (None, math.inf, 1e30, np.float32(1e30), Decimal(10) ** 40, 10**300)] == 6 * [
        None
    ]
    assert seconds(np.float32(0.5)) == 0.5
    assert number(Fraction(1, 2), "x") == 0.5


# ---------------------------------------------------------------------- trajectories

ROWS = [(0.0, 0.0, 0.0, 0.0), (1.0, 0.25, 0.5, 0.125), (2.0, 0.5, 0.0, 0.0)]
POINTS = tuple(TrajectoryPoint(*row) for row in ROWS)


def forms(folder: Path) -> list[Any]:
    """Return the same trajectory in every form that can be meant."""
    table, listed = folder / "path.csv", folder / "path.json"
    table.write_text("t,x,y,phi\n" + "\n".join(",".join(map(str, row)) for row in ROWS))
    listed.write_bytes(msgspec.json.encode(POINTS))
    array = np.array(ROWS)
    return [
        *(POINTS, list(POINTS), iter(POINTS), ROWS, tuple(ROWS), iter(ROWS), list(array), [*POINTS[:1], *ROWS[1:]]),
        *(array, array.astype(np.float32), np.asfortranarray(array), np.ma.array(array), array.astype(object)),
        *(table, str(table), listed, str(listed)),
    ]


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_a_trajectory_is_points_rows_an_array_or_a_file(
    kind: type[Robot | AsyncRobot], connect: str, tmp_path: Path
) -> None:
    async def run() -> None:
        async with client(kind, connect) as robot:
            for form in forms(tmp_path):
                await done(robot, lambda robot, form: robot.follow(form), form)
                assert SERVICE[0].taken() == [TrajectoryGoal(POINTS)], form
            for none in (
                *(5, None, True, object(), {}, {"t": 0.0}, [], [1.0, 2.0], [None, None], ["0,0,0,0", "1,0,0,0"]),
                *(np.zeros((4, 9)), np.zeros((9, 3)), np.zeros(4), np.array(5.0), np.full((2, 4), np.nan), ROWS[:1]),
                *("", "none.csv", tmp_path, tmp_path / "none.json", b"path.csv", ROWS[::-1], [*ROWS, "end"]),
            ):
                with pytest.raises(TrirailError):
                    await done(robot, lambda robot, form: robot.follow(form), none)
                assert SERVICE[0].taken() == [], none

    asyncio.run(run())


def test_a_transposed_array_is_told_what_a_row_is(connect: str) -> None:
    with Robot("demo", connect, "ann") as robot, pytest.raises(RefusedError) as found:
        robot.follow(np.zeros((4, 9)))
    assert str(found.value).startswith("points: row 0 is 9 values; expected TrajectoryPoints, rows of t [s], x, y [m],")


# ---------------------------------------------------------------------- ids, names and the end


@pytest.mark.parametrize("name", [5, None, b"out", ["out"], np.int64(5), object()])
def test_a_name_or_an_id_is_a_text(name: Any, connect: str) -> None:
    with Robot("demo", connect, "ann") as robot:
        for call in (robot.move_to_named, robot.teach, robot.forget):
            with refused_as(RefusalCode.BAD_NAME):
                call(name)
        if name is not None and not isinstance(name, bytes):
            with refused_as(RefusalCode.MALFORMED):
                robot.move_to(0.0, 0.0, 0.0, id=name)


def of_name(name: str) -> Call:
    return lambda robot, _: getattr(robot, name)()


CALIBRATION = CameraCalibration({}, {"a": cast(Any, None)}, 0.0, (), (), {}, confirmed=True)
"""Of a camera: nobody gets as far as to look into it."""
CLOSED: dict[str, Call] = {
    **{name: of_name(name) for name in ("enable", "disable", "stop", "quick_stop", "reset", "home")},
    **{name: of_name(name) for name in ("pause", "resume", "release")},
    **CALLS,
    "send": lambda robot, _: robot.send(lambda name: VelocityGoal(0.0, 0.0, 0.0, id=name)),
    "command": lambda robot, _: robot.command("stop"),
    "info": lambda robot, _: robot.info(),
    "role": lambda robot, _: robot.role(),
    "users": lambda robot, _: robot.users(),
    "poses": lambda robot, _: robot.poses(),
    "teach": lambda robot, _: robot.teach("out"),
    "forget": lambda robot, _: robot.forget("out"),
    "state": lambda robot, _: robot.state(),
    "records": lambda robot, _: robot.records(print),
    "set_output": lambda robot, _: robot.set_output("valve", True),
    "calibrate_camera": lambda robot, _: robot.calibrate_camera(dict),
    "calibrate_geometry": lambda robot, _: robot.calibrate_geometry(dict, (1.0, 1.0)),
    "align": lambda robot, _: robot.align(dict, {"a": (0.0, 0.0)}, CALIBRATION),
}


@pytest.mark.parametrize("kind", [Robot, AsyncRobot])
def test_whatever_is_asked_after_the_end_is_a_service_error(kind: type[Robot | AsyncRobot], connect: str) -> None:
    async def run() -> None:
        async with client(kind, connect) as robot:
            closing = robot.close()
            if inspect.isawaitable(closing):
                await closing
            called = {name.split(",")[0] for name in CLOSED}
            public = {name for name in vars(kind) if not name.startswith("_")}
            assert public - called == {"close", "skipped", "states", "events"}
            for name, call in CLOSED.items():
                with pytest.raises(ServiceError, match=r"closed|not connected"):
                    await done(robot, call, 1.0)
                assert SERVICE[0].taken() == [], name
            for heard in (robot.states, robot.events):
                with pytest.raises(ServiceError, match=r"closed|not connected"):
                    next(heard(timeout=0.0)) if kind is Robot else await anext(heard(timeout=0.0))

    asyncio.run(run())
