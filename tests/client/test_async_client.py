"""The client for asyncio: the names of Robot, no thread for a call, and nothing left of what is cancelled."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import json
import queue
import socket
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from panel.fake_robot import FakeRobot
from trirail.client import goal as goal_module
from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import GoalHandle, Jog, Lease, Track
from trirail.client.call_time import called
from trirail.client.client import Robot
from trirail.client.connection import Connection
from trirail.client.goal import AsyncGoalHandle, AsyncJog, Result
from trirail.client.lease import AsyncLease
from trirail.client.track import AsyncTrack
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import zenoh_session
from trirail.wire.call_mark import mark_in
from trirail.wire.goals import Goal, VelocityGoal
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply, RoleReply
from trirail.wire.state import GoalState, State
from trirail.wire.stop_protocol import StopRequest, stop_address
from trirail.wire.vocabulary import Command, Stop
from waiting import WITHIN


def public(kind: type) -> list[str]:
    return [name for name in vars(kind) if not name.startswith("_")]


# ---------------------------------------------------------------------- the same names


@pytest.mark.parametrize("name", public(Robot))
def test_every_public_name_of_robot_has_its_twin(name: str) -> None:
    ours, theirs = getattr(AsyncRobot, name), getattr(Robot, name)
    if isinstance(theirs, property):
        assert isinstance(ours, property)
        return
    assert list(inspect.signature(ours).parameters.values()) == list(inspect.signature(theirs).parameters.values())
    assert inspect.getdoc(ours)
    waits = not (
        inspect.isgeneratorfunction(theirs) or name in ("jog", "lease", "track", "states", "events", "records")
    )
    assert inspect.iscoroutinefunction(ours) == waits


async def nothing(*_: object) -> Any:
    """Take the place of a robot's calls."""


TWINS = [
    (AsyncGoalHandle("g", nothing, nothing, nothing), GoalHandle),
    (AsyncJog(nothing, (0.0, 0.0, 0.0), 1.0), Jog),
    (AsyncLease(nothing, force=False, timeout=1.0), Lease),
    (AsyncTrack(nothing, lambda *_: None, "g", 1.0), Track),
]


@pytest.mark.parametrize(("ours", "theirs"), TWINS)
def test_goals_jogs_leases_and_tracks_have_the_same_names_too(ours: object, theirs: type) -> None:
    told = {"end"} if theirs is GoalHandle else set()  # by the connection
    assert {name for name in dir(ours) if name[0] != "_"} - told == {name for name in dir(theirs) if name[0] != "_"}


def test_robot_has_no_name_that_robots_have_not() -> None:
    assert set(public(AsyncRobot)) == set(public(Robot))


# ---------------------------------------------------------------------- before a service that says nothing


class Silent:
    """A robot's keys, on which what is asked is kept and answered when the test says so."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.asked: queue.Queue[zenoh.Query] = queue.Queue()
        keep = zenoh.handlers.Callback(self.asked.put, indirect=False)
        self._declared = session.declare_queryable("trirail/demo/**", keep)

    def answer(self, message: msgspec.Struct) -> str:
        with self.asked.get(timeout=WITHIN) as query:
            payload = msgspec.json.encode(message)
            if isinstance(message, ErrorReply):
                query.reply_err(payload)
            else:
                query.reply(query.key_expr, payload)
            return str(query.key_expr).removeprefix("trirail/demo/")

    def publish(self, key: str, message: msgspec.Struct) -> None:
        self._session.put(f"trirail/demo/{key}", msgspec.json.encode(message))


@pytest.fixture
def locator(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path}/zenoh"


@pytest.fixture
def silent(locator: str) -> Iterator[Silent]:
    with zenoh_session.open_service([locator]) as session:
        yield Silent(session)


Work = Callable[[AsyncRobot], Coroutine[Any, Any, None]]


def run(locator: str, work: Work) -> None:
    """Run work with a robot; afterwards nothing may be left of it in the event loop."""

    async def main() -> None:
        async with asyncio.timeout(WITHIN), AsyncRobot("demo", locator, user="ann") as robot:
            await work(robot)
            await asyncio.sleep(0)
            left = asyncio.all_tasks() - {asyncio.current_task()}
            assert not left
            assert not robot._goals

    asyncio.run(main())


async def cancel(task: asyncio.Future[Any]) -> None:
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def cancel_when_asked(awaitable: Awaitable[object], silent: Silent) -> str:
    """Cancel a call whose query has come; return its key. The query stays open: its end would be an answer too."""
    task = asyncio.ensure_future(awaitable)
    with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:
        await cancel(task)
        return str(query.key_expr).removeprefix("trirail/demo/")


def test_a_hundred_calls_at_once_take_no_thread(silent: Silent, locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        before = threading.active_count()
        calls = [asyncio.ensure_future(robot.enable()) for _ in range(100)]
        queries = await asyncio.to_thread(lambda: [silent.asked.get(timeout=WITHIN) for _ in range(100)])
        assert threading.active_count() <= before + 1  # the one in which this test waits
        for query in queries:
            with query:
                query.reply(query.key_expr, msgspec.json.encode(CommandReply("enable", "holding", 1)))
        await asyncio.gather(*calls)

    run(locator, work)


@pytest.mark.parametrize("how", ["resumed", "refused", "stop of one goal"])
def test_a_pause_that_is_over_or_was_refused_keeps_no_earlier_call_back(silent: Silent, locator: str, how: str) -> None:
    async def answered(call: Awaitable[object], answer: msgspec.Struct) -> object:
        task = asyncio.ensure_future(call)
        await asyncio.to_thread(silent.answer, answer)
        return await task

    async def work(robot: AsyncRobot) -> None:
        began = time.monotonic()
        if how == "refused":
            with pytest.raises(RefusedError):
                await answered(robot.pause(), ErrorReply(RefusalCode.NO_GOAL, "no goal is in progress"))
        elif how == "stop of one goal":
            await answered(robot.command("stop", Stop("g")), CommandReply("stop", "holding", 1))
        else:
            await answered(robot.pause(), CommandReply("pause", "holding", 1))
            with called(began), pytest.raises(RefusedError, match="pause was called later"):
                await robot.enable()
            await answered(robot.resume(), CommandReply("resume", "moving", 1))
        with called(began):
            await answered(robot.enable(), CommandReply("enable", "holding", 1))

    run(locator, work)


def test_the_newest_call_of_a_stop_counts_and_a_pause_is_forgotten_up_to_a_call(silent: Silent, locator: str) -> None:
    connection = Connection("demo", locator)
    for at in (5.0, 3.0):
        connection.note_stop(Command.PAUSE, at)
    for until in (4.0, 5.0):
        with pytest.raises(RefusedError, match="pause was called later"):
            connection.check_stops(4.0)
        connection.check_stops(6.0)
        connection.forget_pause(until)
    connection.check_stops(4.0)
    connection.close()


def test_events_that_are_repeated_are_not_missed_and_end_no_goal() -> None:
    robot = AsyncRobot("demo")

    def hear(seq: int, run: str) -> None:
        robot._on_event(Event("mode", "info", "holding", seq=seq, t=0.0, cycle=seq, time=0.0, run=run))

    hear(9, "r1")
    hear(5, "r2")
    goal = robot._goals.open(AsyncGoalHandle("g", nothing, nothing, nothing))
    robot._goals.accept(goal, GoalReply("g", 1.0, run="r2"))
    for seq, run in ((3, "r2"), (10, "r1"), (6, "r2")):
        hear(seq, run)
    missed = [goal._missed]
    hear(8, "r2")
    assert [*missed, goal._missed] == ["", "events 7 to 7"]
    assert not goal._ended.is_set()


CALLS: dict[str, Callable[[AsyncRobot], Awaitable[object]]] = {
    "cmd/ann/enable": lambda robot: robot.enable(),
    "info": lambda robot: robot.info(),
    "poses": lambda robot: robot.poses(),
    "teach/ann/pick": lambda robot: robot.teach("pick"),
}


@pytest.mark.parametrize("key", CALLS)
def test_a_call_that_is_cancelled_leaves_nothing(silent: Silent, locator: str, key: str) -> None:
    keys: list[str] = []

    async def work(robot: AsyncRobot) -> None:
        keys.append(await cancel_when_asked(CALLS[key](robot), silent))

    run(locator, work)
    assert keys == [key]
    assert silent.asked.empty()


def test_a_goal_whose_sending_is_cancelled_is_stopped_if_it_was_taken(silent: Silent, locator: str) -> None:
    keys: list[str] = []

    async def work(robot: AsyncRobot) -> None:
        keys.append(await cancel_when_asked(robot.move_to(x=0.0, y=0.0, phi=0.0, id="g"), silent))
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:
            assert query.payload is not None
            keys.append(f"{query.key_expr} {query.payload.to_string()}")

    run(locator, work)
    assert keys == ["goal/ann", 'trirail/demo/cmd/ann/stop {"goal":"g"}']


@pytest.mark.parametrize("name", ["home", "resume"])
def test_homing_and_a_resumed_goal_are_stopped_if_the_call_is_cancelled(
    silent: Silent, locator: str, name: str
) -> None:
    """The robot would move, for minutes, without a program that knows of it."""
    keys: list[str] = []

    async def work(robot: AsyncRobot) -> None:
        keys.append(await cancel_when_asked(getattr(robot, name)(), silent))
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:
            keys.append(str(query.key_expr))
            assert query.payload is not None
            assert query.payload.to_string() == '{"goal":null}'

    run(locator, work)
    assert keys == [f"cmd/ann/{name}", "trirail/demo/cmd/ann/stop"]


def test_resuming_without_a_reply_stops_the_robot(silent: Silent, locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        resuming = asyncio.ensure_future(robot.resume())
        keys: list[str] = []
        while not keys or not keys[-1].endswith("/stop"):
            with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:  # without a reply
                keys.append(str(query.key_expr))
        with pytest.raises(ServiceError):
            await resuming

    run(locator, work)


def test_a_goal_that_is_not_answered_is_stopped_if_it_was_taken(silent: Silent, locator: str) -> None:
    """Whoever gets an error expects no motion."""

    async def work(robot: AsyncRobot) -> None:
        sending = asyncio.ensure_future(robot.move_to(x=0.0, y=0.0, phi=0.0, id="g"))
        asked: list[tuple[str, bytes]] = []
        while not asked or not asked[-1][0].endswith("/stop"):
            with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:  # without a reply
                asked.append((str(query.key_expr), query.payload.to_bytes() if query.payload is not None else b""))
        with pytest.raises(ServiceError):
            await sending
        assert asked[-1][1] == b'{"goal":"g"}'

    run(locator, work)


def received_at_port(listener: socket.socket) -> StopRequest:
    """Return the next request at a stop port; it gets no answer."""
    caller, _ = listener.accept()
    with caller, caller.makefile("rb") as lines:
        return msgspec.json.decode(lines.readline(), type=StopRequest)


@pytest.fixture
def port(locator: str) -> Iterator[socket.socket]:
    address = stop_address(locator)
    assert address is not None
    with socket.socket(socket.AF_UNIX) as listener:
        listener.settimeout(WITHIN)
        listener.bind(str(address))
        listener.listen()
        yield listener


@pytest.mark.parametrize("name", ["goal", "home"])
def test_what_is_cancelled_is_stopped_at_the_stop_port_too(
    silent: Silent, locator: str, port: socket.socket, name: str
) -> None:
    """The Zenoh link may be interrupted, which may also be why no reply arrives."""

    async def work(robot: AsyncRobot) -> None:
        call = robot.move_to(x=0.0, y=0.0, phi=0.0, id="g") if name == "goal" else robot.home()
        began = time.monotonic_ns()
        task = asyncio.ensure_future(call)
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as query:
            assert query.attachment is not None
            sent = mark_in(query.attachment.to_string())
            await cancel(task)
        request = await asyncio.to_thread(received_at_port, port)
        assert request.key == "trirail/demo/cmd/ann/stop"
        assert msgspec.json.decode(request.content, type=Stop) == Stop("g" if name == "goal" else None)
        mark = mark_in(request.id)
        assert mark is not None
        assert sent is not None
        assert mark.connection == sent.connection
        assert began <= sent.called_ns < mark.called_ns, "the service would carry the call out after the stop"
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as copy:
            shared = copy.attachment is not None and copy.attachment.to_string() == request.id
            # The stop at the port may overtake the goal, so the service must carry out the other stop as well.
            assert shared == (name == "home")

    run(locator, work)


def test_a_goal_that_is_refused_is_forgotten_and_one_that_is_none_is_not_sent(silent: Silent, locator: str) -> None:
    async def work(robot: AsyncRobot) -> None:
        sending = asyncio.ensure_future(robot.move_to(x=9.0, y=0.0, phi=0.0))
        await asyncio.to_thread(silent.answer, ErrorReply(RefusalCode.OUT_OF_WORKSPACE, "too far"))
        with pytest.raises(RefusedError):
            await sending
        wrong: list[Callable[[], Awaitable[object]]] = [
            lambda: robot.move_to(x=0.0, y=0.0, phi=0.0, id="\n"),
            lambda: robot.override(0.5),
            lambda: robot.teach("a b"),
        ]
        for call in wrong:
            with pytest.raises(RefusedError):
                await call()

    run(locator, work)
    assert silent.asked.empty()


def test_a_goal_is_waited_for_and_cancelling_the_wait_does_not_stop_it(silent: Silent, locator: str) -> None:
    end = Event(
        "goal", "info", "goal g done: arrived", id="g", outcome="done", settle=0.01, seq=7, t=0.0, cycle=0, time=5.0
    )

    async def work(robot: AsyncRobot) -> None:
        sending = asyncio.ensure_future(robot.move_to(x=0.0, y=0.0, phi=0.0, id="g"))
        await asyncio.to_thread(silent.answer, GoalReply("g", 1.0))
        goal = await sending
        assert (goal.duration, goal.result) == (1.0, None)
        with pytest.raises(TimeoutError, match=r"goal g has not ended within 0\.01 s"):
            await goal.wait(0.01)
        forgotten = asyncio.ensure_future(goal.wait())
        await asyncio.sleep(0)
        await cancel(forgotten)
        waiting = [asyncio.ensure_future(goal.wait(WITHIN)) for _ in range(3)]
        await asyncio.to_thread(silent.publish, "event", end)
        assert {(await each).outcome for each in waiting} == {"done"}
        assert goal.result is not None
        assert goal.result.settle == 0.01

    run(locator, work)
    assert silent.asked.empty()


@pytest.mark.parametrize("present", [None, "another", "g"])
def test_a_wait_for_a_goal_whose_end_was_missed_asks_for_the_present_goal(
    silent: Silent, locator: str, monkeypatch: pytest.MonkeyPatch, present: str | None
) -> None:
    """Such as after a loss of the network, during which there were more events than the service keeps."""
    monkeypatch.setattr(goal_module, "CHECK_PERIOD_S", 0.01)
    event = Event("service", "info", "x", seq=1, t=0.0, cycle=0, time=5.0, run="r")
    over = threading.Event()
    fake = FakeRobot()
    fake.goal = None if present is None else GoalState(present, 0.5, 1.0)

    def publish_states() -> None:
        while not over.wait(0.01):
            silent.publish("state", fake.state())

    def answer_roles() -> None:
        while not over.is_set():
            with contextlib.suppress(queue.Empty), silent.asked.get(timeout=0.01) as query:
                query.reply(query.key_expr, msgspec.json.encode(RoleReply("ann", "maintainer")))

    async def work(robot: AsyncRobot) -> None:
        sending = asyncio.ensure_future(robot.move_to(x=0.0, y=0.0, phi=0.0, id="g"))
        await asyncio.to_thread(silent.answer, GoalReply("g", 1.0, run="r"))
        goal = await sending
        threads = [asyncio.to_thread(each) for each in (publish_states, answer_roles)]
        others = asyncio.gather(*threads)
        for seq in (1, 2):
            silent.publish("event", msgspec.structs.replace(event, seq=seq))
        silent.publish("event", msgspec.structs.replace(event, seq=1004))
        try:
            if present == "g":
                while not goal._missed:
                    await asyncio.sleep(0.01)
                waits = asyncio.ensure_future(goal.wait())
                while goal._missed:
                    await asyncio.sleep(0.01)
                ended = {"kind": "goal", "id": "g", "outcome": "done", "seq": 1005}
                silent.publish("event", msgspec.structs.replace(event, **ended))
                assert (await waits).outcome == "done"
            else:
                with pytest.raises(ServiceError, match="has missed events 3 to 1003, and the goal is not in progress"):
                    await goal.wait()
                silent.publish("event", msgspec.structs.replace(event, run="next"))
                while robot._goals:
                    await asyncio.sleep(0.01)
                with pytest.raises(ServiceError, match="started again"):
                    await goal.wait()
        finally:
            over.set()
            await others

    run(locator, work)


async def renewed_jog(robot: AsyncRobot, silent: Silent) -> tuple[AsyncJog, zenoh.Query, str]:
    """Return a jog, a renewal of it that has not been answered, and its id."""
    jog = robot.jog(x=0.01)
    entering = asyncio.ensure_future(jog.__aenter__())
    await asyncio.to_thread(silent.answer, GoalReply("any", 1.0))
    await entering
    renewal = await asyncio.to_thread(silent.asked.get, timeout=WITHIN)
    assert renewal.payload is not None
    return jog, renewal, json.loads(renewal.payload.to_string())["id"]


def assert_brakes(query: zenoh.Query, name: str) -> None:
    assert query.payload is not None
    sent = json.loads(query.payload.to_string())
    assert (sent["id"], sent["x"], sent["y"], sent["phi"]) == (name, 0.0, 0.0, 0.0)


def test_a_jog_that_is_left_while_it_is_renewed_brakes_at_once_and_hears_its_end(silent: Silent, locator: str) -> None:
    """The reply to the renewal may be late, or be lost."""

    async def work(robot: AsyncRobot) -> None:
        jog, renewal, name = await renewed_jog(robot, silent)
        leaving = asyncio.ensure_future(jog.__aexit__())
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as braking, renewal:
            assert_brakes(braking, name)
            for query in (renewal, braking):
                query.reply(query.key_expr, msgspec.json.encode(GoalReply(name, 1.0)))
        end = Event("goal", "info", "goal done: not renewed", id=name, outcome="done", seq=7, t=0.0, cycle=0, time=5.0)
        await asyncio.to_thread(silent.publish, "event", end)
        await leaving
        assert jog.result is not None
        assert jog.result.outcome == "done"

    run(locator, work)
    assert silent.asked.empty()


@pytest.mark.parametrize("turns", [1, 2, 5])
def test_a_jog_brakes_although_its_end_is_cancelled(silent: Silent, locator: str, turns: int) -> None:
    async def work(robot: AsyncRobot) -> None:
        jog, renewal, name = await renewed_jog(robot, silent)
        leaving = asyncio.ensure_future(jog.__aexit__())
        for _ in range(turns):
            await asyncio.sleep(0)
        await cancel(leaving)
        with await asyncio.to_thread(silent.asked.get, timeout=WITHIN) as braking, renewal:
            assert_brakes(braking, name)
        await asyncio.sleep(0)
        robot._goals.end(Result(name, "done", ""))

    run(locator, work)


def test_a_subscription_ends_with_who_iterates(silent: Silent, locator: str) -> None:
    """However it ends: by its time-out, by being left, by being cancelled."""
    heard: list[object] = []

    async def work(robot: AsyncRobot) -> None:
        async def iterate(states: AsyncIterator[State | Event]) -> None:
            heard.extend([state async for state in states])

        for states in (robot.states, robot.events):
            await iterate(states(timeout=0.01))
            iterating = asyncio.ensure_future(iterate(states()))
            await asyncio.sleep(0.01)
            await cancel(iterating)
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(anext(states()), 0.01)
        with pytest.raises(ServiceError, match="no robot"):
            await robot.state(timeout=0.01)

    run(locator, work)
    assert heard == []


def test_an_event_loop_that_was_blocked_hears_what_came_meanwhile(silent: Silent, locator: str) -> None:
    """A silence of the service is one in which this program could have heard it."""
    event = Event("goal", "info", "", seq=7, t=0.0, cycle=0, time=5.0)

    async def work(robot: AsyncRobot) -> None:
        for came in (True, False):
            heard = robot.events(timeout=0.2)
            waiting = asyncio.ensure_future(anext(heard))
            await asyncio.sleep(0.1)
            if came:
                silent.publish("event", event)
            time.sleep(0.6)  # what a detector that reads synchronously does
            if not came:
                asyncio.get_running_loop().call_later(0.05, silent.publish, "event", event)
            assert (await waiting).seq == 7
            with pytest.raises(StopAsyncIteration):
                await anext(heard)

    run(locator, work)


def test_whoever_waits_is_told_that_the_robot_was_closed(silent: Silent, locator: str) -> None:
    async def main() -> None:
        async with asyncio.timeout(WITHIN), AsyncRobot("demo", locator, user="ann") as robot:
            sending = asyncio.ensure_future(robot.move_to(x=0.0, y=0.0, phi=0.0, id="g"))
            await asyncio.to_thread(silent.answer, GoalReply("g", 1.0))
            goal = await sending
            first: list[Awaitable[object]] = [anext(robot.states()), anext(robot.events())]
            calls = [call(robot) for call in CALLS.values()]
            waiting = [asyncio.ensure_future(each) for each in (goal.wait(), robot.stop(), *first, *calls)]
            await asyncio.sleep(0.05)
            assert not any(task.done() for task in waiting)
            await robot.close()
            for task in (*waiting, asyncio.ensure_future(goal.wait())):
                with pytest.raises(ServiceError, match="the connection is closed"):
                    await task

    asyncio.run(main())


@pytest.mark.long
def test_opening_that_is_cancelled_leaves_no_connection(silent: Silent, locator: str) -> None:
    async def main() -> None:
        opening = asyncio.ensure_future(AsyncRobot("demo", locator).__aenter__())
        await asyncio.sleep(0)
        opening.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await opening

    asyncio.run(main())  # which waits for the thread that opens
    with pytest.raises(ServiceError, match="no service at"):
        asyncio.run(AsyncRobot("demo", "tcp/127.0.0.1:1").__aenter__())


def test_outside_of_its_context_it_says_so() -> None:
    with pytest.raises(ServiceError, match="use the robot within `async with AsyncRobot"):
        asyncio.run(AsyncRobot("demo").enable())


@pytest.mark.parametrize("name", ["state", "stop", "info", "users", "enable"])
def test_another_event_loop_is_told_to_enter_a_robot_of_its_own(silent: Silent, tmp_path: Path, name: str) -> None:
    robot = AsyncRobot("demo", f"unixsock-stream/{tmp_path}/zenoh")
    asyncio.run(robot.__aenter__())
    with pytest.raises(ServiceError, match="another event loop"):
        asyncio.run(getattr(robot, name)())
    asyncio.run(robot.close())


@pytest.mark.parametrize("failed", [2, 3])
@pytest.mark.parametrize(
    "error",
    [
        ServiceError("no robot answers"),
        RefusedError(RefusalCode.BUSY, "too many"),
        RefusedError(RefusalCode.AT_LIMIT, "the jog has ended at a limit"),
    ],
)
def test_a_jog_brakes_at_its_end_although_a_renewal_has_failed(error: TrirailError, failed: int) -> None:
    """A jog may last for up to ten seconds without a renewal."""
    sent: list[float] = []

    async def send(make: Callable[[str], Goal], goal_id: str) -> AsyncGoalHandle:
        goal = make(goal_id)
        assert isinstance(goal, VelocityGoal)
        sent.append(goal.x)
        if len(sent) == failed:
            raise error
        return handle

    regular = isinstance(error, RefusedError) and error.code is RefusalCode.AT_LIMIT

    async def wait(_timeout: float) -> None:
        if not regular:
            raise ServiceError("the end of goal g is unknown")

    handle = AsyncGoalHandle("g", nothing, nothing, nothing)
    vars(handle).update(wait=wait)

    async def main() -> AsyncJog:
        async with AsyncJog(send, (0.05, 0.0, 0.0), 0.3) as jog:
            while len(sent) < failed:
                await asyncio.sleep(0.01)
        return jog

    assert asyncio.run(main()).error is (None if regular else error)
    assert sent == [*[0.05] * failed, 0.0]
