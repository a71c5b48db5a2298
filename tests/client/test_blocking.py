"""The client with threads: interrupted, shared and closed at any time, and nothing is left of it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import operator
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import FrameType
from typing import Any, Self

import msgspec
import pytest
import zenoh
from trirail.client import async_client, blocking
from trirail.client.blocking import Jog, Lease, LoopThread
from trirail.client.client import Robot
from trirail.client.connection import Connection
from trirail.client.new_stop import NewStop
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import zenoh_session
from trirail.wire.call_mark import CallMark, mark_in
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import Command, Stop
from waiting import WITHIN, wait_until

CLOSED = "the connection is closed"


class Slow:
    """A robot's keys, on which what is asked is kept, and answered when the test says so."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.asked: queue.Queue[zenoh.Query] = queue.Queue()
        self.answer: Callable[[zenoh.Query], object] = self.asked.put
        keep: Any = zenoh.handlers.Callback(lambda query: self.answer(query), indirect=False)  # noqa: PLW0108 - it changes
        self._declared = session.declare_queryable("trirail/demo/**", keep)

    def next(self) -> zenoh.Query:
        return self.asked.get(timeout=WITHIN)


@pytest.fixture
def slow(tmp_path: Path) -> Iterator[Slow]:
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/zenoh"]) as session:
        yield Slow(session)


@pytest.fixture
def answered(slow: Slow) -> list[str]:
    """Keys and contents of what is asked, each of which is confirmed at once."""
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        kind, *names = str(query.key_expr).split("/")[2:]
        content = query.payload.to_string() if query.payload is not None else ""
        asked.append(f"{query.key_expr} {content}")
        if kind != "goal":
            reply(query, CommandReply(names[-1], "holding", 1))
            return
        goal_id = msgspec.json.decode(content)["id"]
        reply(query, GoalReply(goal_id, 1.0))
        if '"kind":"velocity","x":0.0,' in content:  # the end of a jog
            event = Event("goal", "info", "done", id=goal_id, outcome="done", seq=len(asked), t=0.0, cycle=0, time=1.0)
            slow.session.put("trirail/demo/event", msgspec.json.encode(event))

    slow.answer = answer
    return asked


@pytest.fixture
def robot(slow: Slow, tmp_path: Path) -> Iterator[Robot]:
    with Robot("demo", f"unixsock-stream/{tmp_path}/zenoh", user="ann") as robot:
        yield robot


def reply(query: zenoh.Query, message: msgspec.Struct) -> None:
    with query:
        query.reply(query.key_expr, msgspec.json.encode(message))


class Call:
    """A call in a thread of its own."""

    def __init__(self, do: Callable[[], Any]) -> None:
        self._do = do
        self.outcome: Any = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.outcome = self._do()
        except TrirailError as error:
            self.outcome = error

    def wait_until_called(self) -> None:
        """Wait until the thread waits for the robot."""
        wait_until(lambda: waits(self._thread.ident or 0))

    def end(self) -> Any:
        self._thread.join(WITHIN)
        assert not self._thread.is_alive()
        return self.outcome


def waits(thread: int) -> bool:
    """Whether a thread waits for the end of a call of the robot."""
    frame = sys._current_frames()[thread]
    codes = [frame.f_code for frame, _ in traceback.walk_stack(frame)]
    return codes[0] is threading.Condition.wait.__code__ and LoopThread.call.__code__ in codes


def interrupt(do: Callable[[], object], when: Callable[[], object] = lambda: None) -> None:
    """Press Ctrl-C in a call of the main thread once something has come, and the thread waits."""
    main = threading.get_ident()

    def press() -> None:
        when()
        wait_until(lambda: waits(main))
        signal.pthread_kill(main, signal.SIGINT)

    pressing = threading.Thread(target=press)
    pressing.start()
    with pytest.raises(KeyboardInterrupt):
        do()
    pressing.join()


STOPPING: dict[str, Callable[[Robot], object]] = {
    "stop": Robot.stop,
    "quick_stop": Robot.quick_stop,
    "disable": lambda robot: robot.command("disable"),
}


@contextlib.contextmanager
def congested(robot: Robot) -> Iterator[threading.Event]:
    """Hold up the robot's calls, as a link without room does; yield the event that ends this."""
    free, held = threading.Event(), threading.Event()

    async def send() -> None:
        held.set()
        free.wait()  # as Zenoh's own send does, in the thread of the event loop

    robot._loop.start(send())
    assert held.wait(WITHIN)
    try:
        yield free
    finally:
        free.set()


@pytest.mark.parametrize("name", STOPPING)
def test_a_stop_waits_for_no_call_that_a_congested_link_holds_up(name: str, robot: Robot, slow: Slow) -> None:
    with congested(robot) as free:
        stopping = Call(lambda: STOPPING[name](robot))
        query = slow.next()
        assert str(query.key_expr) == f"trirail/demo/cmd/ann/{name}"
        reply(query, CommandReply(name, "holding", 1))
        stopping.end()
        assert not free.is_set()


def test_a_stop_that_a_congested_link_holds_up_delays_no_other_stop(
    robot: Robot, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    free, held, post = threading.Event(), threading.Event(), Connection._post

    def hold(self: Connection, query: dict[str, Any], *rest: Any) -> None:
        if str(query["selector"]).endswith("/stop"):
            held.set()
            free.wait()
        post(self, query, *rest)

    monkeypatch.setattr(Connection, "_post", hold)
    stopping = Call(robot.stop)
    try:
        assert held.wait(WITHIN)
        quick = Call(robot.quick_stop)
        reply(slow.next(), CommandReply("quick_stop", "fault", 1))
        quick.end()
        assert not free.is_set()
    finally:
        free.set()
    reply(slow.next(), CommandReply("stop", "fault", 2))
    stopping.end()


@pytest.mark.parametrize("name", STOPPING)
def test_a_stop_is_sent_where_no_thread_can_be_started(
    name: str, robot: Robot, answered: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    STOPPING[name](robot)
    assert answered == [f"trirail/demo/cmd/ann/{name} "]


def test_a_stop_without_a_session_is_sent_where_no_thread_can_be_started(
    answered: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    NewStop("stop", "demo", f"unixsock-stream/{tmp_path}/zenoh").wait()
    assert [asked.rpartition("/")[2] for asked in answered] == ["stop "]


STARTING: dict[str, Callable[[Robot], object]] = {
    "goal": lambda robot: robot.move_to(0.01, 0.0, 0.0),
    "path": lambda robot: robot.follow([(0.0, 0.0, 0.0, 0.0), (1.0, 0.01, 0.0, 0.0)]),
    "jog": lambda robot: held(robot.jog(x=0.01, timeout=0.3)),
    "track": lambda robot: robot.track().update((0.0, 0.0, 0.0)),
    **{name: operator.methodcaller("command", name) for name in Command if name.starts},
}


def stop_and_confirm(robot: Robot, slow: Slow, name: str = "stop") -> None:
    stopping = Call(lambda: robot.command(name))
    reply(slow.next(), CommandReply(name, "holding", 1))
    assert stopping.end().mode == "holding"


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("name", STARTING)
def test_what_was_called_before_a_stop_is_not_sent_after_it(robot: Robot, slow: Slow, name: str, stop: str) -> None:
    with congested(robot):
        starting = Call(lambda: STARTING[name](robot))
        starting.wait_until_called()
        stop_and_confirm(robot, slow, stop)
    refused = starting.end()
    assert (refused.code, slow.asked.qsize()) == (RefusalCode.STOPPED, 0)
    robot._loop.start(robot._robot.command("enable"))  # what is called afterwards is sent
    assert str(slow.next().key_expr).endswith("/enable")


@pytest.mark.parametrize("stop", [name for name in Command if name.stops])
def test_a_path_that_is_read_while_a_stop_is_carried_out_is_not_followed(robot: Robot, slow: Slow, stop: str) -> None:
    reading, read = threading.Event(), threading.Event()

    def rows() -> Iterator[tuple[float, float, float, float]]:
        reading.set()
        assert read.wait(WITHIN)
        yield from ((0.0, 0.0, 0.0, 0.0), (1.0, 0.01, 0.0, 0.0))

    following = Call(lambda: robot.follow(rows()))
    assert reading.wait(WITHIN)
    stop_and_confirm(robot, slow, stop)
    read.set()
    assert (following.end().code, slow.asked.qsize()) == (RefusalCode.STOPPED, 0)


@pytest.fixture
def stopping_signal(robot: Robot) -> Iterator[int]:
    """A signal whose handler stops the robot."""
    before = signal.signal(signal.SIGUSR1, lambda *_: robot.stop())
    yield signal.SIGUSR1
    signal.signal(signal.SIGUSR1, before)


def test_a_path_that_is_read_while_a_signal_handler_stops_is_not_followed(
    robot: Robot, answered: list[str], stopping_signal: int
) -> None:
    def rows() -> Iterator[tuple[float, float, float, float]]:
        yield (0.0, 0.0, 0.0, 0.0)
        signal.raise_signal(stopping_signal)
        yield (1.0, 0.01, 0.0, 0.0)

    with pytest.raises(RefusedError, match="came first"):
        robot.follow(rows())
    assert answered == ["trirail/demo/cmd/ann/stop "]


@pytest.mark.parametrize("name", STARTING)
def test_a_call_that_a_signal_handler_interrupts_to_stop_sends_nothing_after_the_stop(
    robot: Robot, answered: list[str], stopping_signal: int, name: str
) -> None:
    main = threading.get_ident()
    with congested(robot) as free:

        def press() -> None:
            wait_until(lambda: waits(main))
            signal.pthread_kill(main, stopping_signal)
            wait_until(lambda: bool(answered))
            free.set()

        pressing = threading.Thread(target=press)
        pressing.start()
        with pytest.raises(RefusedError, match="came first"):
            STARTING[name](robot)
    pressing.join()
    assert answered == ["trirail/demo/cmd/ann/stop "]


@pytest.mark.parametrize("name", STOPPING)
def test_what_a_signal_handler_sends_after_its_stop_is_sent(
    robot: Robot, slow: Slow, stopping_signal: int, name: str
) -> None:
    """Also if the handler interrupts a stop."""
    handled: list[object] = []

    def stop_and_go(*_: object) -> None:
        robot.stop()
        handled.append(robot.move_to(0.01, 0.0, 0.0, id="g"))

    def press() -> None:
        first = slow.next()
        signal.pthread_kill(main, stopping_signal)
        reply(slow.next(), CommandReply("stop", "holding", 1))
        reply(slow.next(), GoalReply("g", 1.0))
        wait_until(lambda: bool(handled))
        reply(first, CommandReply(name, "holding", 1))

    signal.signal(stopping_signal, stop_and_go)
    main = threading.get_ident()
    pressing = threading.Thread(target=press)
    pressing.start()
    STOPPING[name](robot)
    pressing.join()


def on_the_way(robot: Robot, slow: Slow) -> tuple[Call, str]:
    """Follow a path, and accept the goal at its first point; return the call, and the id of this goal."""
    following = Call(lambda: robot.follow([(0.0, 0.0, 0.0, 0.0), (1.0, 0.01, 0.0, 0.0)], go_there=True))
    way = slow.next()
    assert way.payload is not None
    goal_id = msgspec.json.decode(way.payload.to_bytes())["id"]
    reply(way, GoalReply(goal_id, 1.0))
    return following, goal_id


def end_goal(slow: Slow, goal_id: str) -> None:
    ended = Event("goal", "info", "done", id=goal_id, outcome="done", seq=1, t=0.0, cycle=0, time=1.0)
    slow.session.put("trirail/demo/event", msgspec.json.encode(ended))


@pytest.mark.parametrize("taken_back", ["resumed", "refused"])
def test_a_path_begins_after_a_pause_that_was_taken_back_on_the_way_to_its_first_point(
    robot: Robot, slow: Slow, taken_back: str
) -> None:
    following, goal_id = on_the_way(robot, slow)
    pausing = Call(robot.pause)
    with slow.next() as query:
        if taken_back == "resumed":
            query.reply(query.key_expr, msgspec.json.encode(CommandReply("pause", "holding", 1)))
        else:
            query.reply_err(msgspec.json.encode(ErrorReply(RefusalCode.NO_GOAL, "no goal is in progress")))
    pausing.end()
    if taken_back == "resumed":
        resuming = Call(robot.resume)
        reply(slow.next(), CommandReply("resume", "moving", 2))
        resuming.end()
    end_goal(slow, goal_id)
    path = slow.next()
    assert str(path.key_expr).startswith("trirail/demo/goal/ann")
    reply(path, GoalReply("p", 1.0))
    following.end()


def test_a_path_does_not_begin_after_a_stop_that_came_when_its_first_point_was_reached(
    robot: Robot, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrived, go_on = threading.Event(), threading.Event()

    def check(_: object) -> None:
        arrived.set()
        assert go_on.wait(WITHIN)

    monkeypatch.setattr(async_client, "check_arrived", check)
    following, goal_id = on_the_way(robot, slow)
    end_goal(slow, goal_id)
    assert arrived.wait(WITHIN)
    stop_and_confirm(robot, slow)
    go_on.set()
    assert (following.end().code, slow.asked.qsize()) == (RefusalCode.STOPPED, 0)


@pytest.mark.parametrize("stop", STOPPING)
@pytest.mark.parametrize("name", STARTING)
def test_the_service_sees_which_requests_were_called_for_before_a_stop(
    robot: Robot, slow: Slow, name: str, stop: str
) -> None:
    """The stop may overtake them, since it is also sent to the stop port."""
    marks: list[CallMark | None] = []
    for do in (STARTING[name], STOPPING[stop], STARTING[name]):
        calling = Call(functools.partial(do, robot))
        with slow.next() as query:
            assert query.attachment is not None
            marks.append(mark_in(query.attachment.to_string()))
            query.reply_err(msgspec.json.encode(ErrorReply(RefusalCode.BUSY, "busy")))
        calling.end()
    first, second, third = filter(None, marks)
    assert first.connection == second.connection == third.connection
    assert first.called_ns < second.called_ns < third.called_ns


@pytest.mark.parametrize("name", ["pause", "the stop of another goal"])
def test_a_goal_under_way_outlives_what_does_not_stop_it(robot: Robot, slow: Slow, name: str) -> None:
    with congested(robot):
        sending = Call(lambda: robot.move_to(0.01, 0.0, 0.0, id="g"))
        sending.wait_until_called()
        if name == "pause":
            halting = Call(robot.pause)
            halting.wait_until_called()
        else:
            halting = Call(lambda: robot.command("stop", Stop("other")))
            reply(slow.next(), CommandReply("stop", "holding", 1))
            halting.end()
    goal = slow.next()
    if name == "pause":
        reply(slow.next(), CommandReply("pause", "holding", 1))
        halting.end()
    reply(goal, GoalReply("g", 1.0))
    assert sending.end().id == "g"
    robot._loop.start(robot._robot.command("enable"))
    assert str(slow.next().key_expr).endswith("/enable")  # and no stop


# ---------------------------------------------------------------------- Ctrl-C


def test_ctrl_c_while_a_goal_is_sent_stops_it_if_it_was_taken(robot: Robot, slow: Slow) -> None:
    kept: list[zenoh.Query] = []
    interrupt(lambda: robot.move_to(0.0, 0.0, 0.0, id="g"), lambda: kept.append(slow.next()))
    with slow.next() as stop:
        assert stop.payload is not None
        assert f"{stop.key_expr} {stop.payload.to_string()}" == 'trirail/demo/cmd/ann/stop {"goal":"g"}'
    wait_until(lambda: not robot._robot._goals)
    kept.clear()


@pytest.mark.generated(*range(6))
def test_ctrl_c_in_a_program_that_then_closes_its_robot_stops_the_goal_all_the_same(
    slow: Slow, tmp_path: Path, seed: int
) -> None:
    kept: list[zenoh.Query] = []

    def program() -> None:
        with Robot("demo", f"unixsock-stream/{tmp_path}/zenoh", user="ann") as robot:
            robot.move_to(0.0, 0.0, 0.0, id=f"g{seed}")

    interrupt(program, lambda: kept.append(slow.next()))
    with slow.next() as stop:
        assert stop.payload is not None
        assert msgspec.json.decode(stop.payload.to_bytes()) == {"goal": f"g{seed}"}
    kept.clear()


def test_ctrl_c_on_the_way_to_the_first_point_of_a_path_stops_the_robot(robot: Robot, slow: Slow) -> None:
    ids: list[str] = []

    def accept() -> None:
        way = slow.next()
        assert way.payload is not None
        ids.append(msgspec.json.decode(way.payload.to_bytes())["id"])
        reply(way, GoalReply(ids[0], 10.0))
        wait_until(lambda: bool(robot._robot._goals._accepted))

    interrupt(lambda: robot.follow([(0.0, 0.0, 0.0, 0.0), (1.0, 0.01, 0.0, 0.0)], go_there=True), accept)
    with slow.next() as stop:
        assert stop.payload is not None
        assert str(stop.key_expr) == "trirail/demo/cmd/ann/stop"
        assert msgspec.json.decode(stop.payload.to_bytes()) == {"goal": ids[0]}


def test_ctrl_c_while_a_jog_ends_brakes_all_the_same(robot: Robot, slow: Slow) -> None:
    jog = robot.jog(x=0.01, timeout=0.3)
    entering = Call(jog.__enter__)
    reply(slow.next(), GoalReply("any", 1.0))
    entering.end()
    renewal = slow.next()  # without a reply
    interrupt(lambda: jog.__exit__(None, None, None))
    with slow.next() as brake, renewal:
        assert brake.payload is not None
        assert msgspec.json.decode(brake.payload.to_bytes())["x"] == 0.0


class InterruptedAt:
    """Raise KeyboardInterrupt in this thread before the line with a number, of those that a call executes."""

    def __init__(self, number: int) -> None:
        self._left = number
        self.pressed = False

    def __enter__(self) -> Self:
        sys.settrace(self._trace)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _trace(self, frame: FrameType, event: str, _: object) -> Any:
        called = [each.f_code for each, _ in traceback.walk_stack(frame)]
        ours = called[0].co_filename == blocking.__file__ or called[0] is Future.result.__code__
        if not self.pressed and ours and LoopThread.call.__code__ in called:
            self._left -= event == "line"
            if self._left < 0:
                self.pressed = True
                raise KeyboardInterrupt
        return self._trace


MOVING: dict[str, Callable[[Robot], object]] = {
    "goal": lambda robot: robot.move_to(0.01, 0.0, 0.0),
    "path": lambda robot: robot.follow([(0.0, 0.0, 0.0, 0.0), (1.0, 0.01, 0.0, 0.0)]),
    "jog": lambda robot: held(robot.jog(x=0.01, timeout=0.3)),
    "lease": lambda robot: held(robot.lease(timeout=0.3)),
}


def held(context: Jog | Lease) -> None:
    with context:
        pass


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a coroutine that never began
@pytest.mark.parametrize("name", MOVING)
def test_wherever_ctrl_c_interrupts_a_call_nothing_that_it_began_is_left(
    robot: Robot, answered: list[str], name: str
) -> None:
    numbers = itertools.count()
    pressed = True
    while pressed:
        answered.clear()
        with contextlib.suppress(KeyboardInterrupt), InterruptedAt(next(numbers)) as interrupted:
            MOVING[name](robot)
        pressed = interrupted.pressed
        if pressed and name in ("goal", "path") and answered:
            wait_until(lambda: "cmd/ann/stop" in answered[-1])
        wait_until(lambda: not _renewing(robot))
    assert next(numbers) > 10


def _renewing(robot: Robot) -> bool:
    """Whether the event loop renews anything."""

    async def names() -> set[str]:
        return {task.get_name() for task in asyncio.all_tasks()}

    return bool(robot._loop.call(names()) & {"jog", "lease"})


def test_ctrl_c_ends_a_command_and_the_next_one_is_answered(robot: Robot, slow: Slow) -> None:
    kept: list[zenoh.Query] = []
    interrupt(robot.enable, lambda: kept.append(slow.next()))
    kept.clear()
    enabling = Call(lambda: robot.command("enable").mode)
    reply(slow.next(), CommandReply("enable", "holding", 1))
    assert enabling.end() == "holding"


def test_ctrl_c_in_a_wait_leaves_the_goal(robot: Robot, slow: Slow) -> None:
    sending = Call(lambda: robot.move_to(0.0, 0.0, 0.0, id="g"))
    reply(slow.next(), GoalReply("g", 1.0))
    goal = sending.end()
    interrupt(goal.wait)
    ended = Event("goal", "info", "done", id="g", outcome="done", seq=1, t=0.0, cycle=0, time=1.0)
    waiting = Call(lambda: goal.wait(WITHIN))
    slow.session.put("trirail/demo/event", msgspec.json.encode(ended))
    assert waiting.end().outcome == "done"
    assert slow.asked.empty()


@pytest.mark.parametrize("name", ["states", "events"])
def test_ctrl_c_while_it_listens_ends_the_iteration_alone(robot: Robot, slow: Slow, name: str) -> None:
    told = getattr(robot, name)()
    interrupt(lambda: next(told))
    assert list(told) == []
    assert list(getattr(robot, name)(timeout=0.01)) == []


def test_a_signal_handler_may_call_the_robot_wherever_it_interrupts_a_call(robot: Robot, answered: list[str]) -> None:
    numbers = itertools.count()
    interrupted = True
    while interrupted:
        left = next(numbers)
        interrupted = False

        def trace(frame: FrameType, event: str, _: object) -> Any:
            nonlocal left, interrupted
            called = [each.f_code for each, _ in traceback.walk_stack(frame)]
            if not interrupted and called[0].co_filename == blocking.__file__ and LoopThread.call.__code__ in called:
                left -= event == "line"
                if left < 0:
                    interrupted = True
                    sys.settrace(None)
                    robot.home()
            return trace

        sys.settrace(trace)
        try:
            robot.home()
        finally:
            sys.settrace(None)
    assert next(numbers) > 5


@pytest.mark.parametrize("name", ["state", "stop", "move_to", "users", "close"])
def test_a_forked_process_is_told_to_open_a_robot_of_its_own(robot: Robot, name: str) -> None:
    arguments = (0.0, 0.0, 0.0) if name == "move_to" else ()
    codes: list[int] = []

    def ended() -> bool:
        pid, code = os.waitpid(child, os.WNOHANG)
        codes.extend([code] if pid else [])
        return bool(codes)

    child = os.fork()
    if child == 0:
        try:
            getattr(robot, name)(*arguments)
        except ServiceError as error:
            os._exit(1 if "open a new one in the forked process" in str(error) else 2)
        os._exit(0)
    wait_until(ended)
    assert codes == [0 if name == "close" else 1 << 8]


# ---------------------------------------------------------------------- several threads


def test_calls_of_several_threads_are_under_way_at_once(robot: Robot, slow: Slow) -> None:
    calls = [Call(lambda: robot.command("enable").seq) for _ in range(8)]
    queries = [slow.next() for _ in calls]
    for number, query in enumerate(queries):
        reply(query, CommandReply("enable", "holding", number))
    assert {call.end() for call in calls} == set(range(8))


def test_a_jog_and_a_lease_are_kept_while_the_program_does_other_things(robot: Robot, slow: Slow) -> None:
    """Whatever the thread does that has entered them."""
    entering = Call(lambda: (robot.jog(x=0.01, timeout=0.3).__enter__(), robot.lease(timeout=0.4).__enter__()))
    kinds: dict[str, int] = {}
    while not (kinds.get("goal", 0) > 2 and kinds.get("cmd", 0) > 2):
        query = slow.next()
        kind = str(query.key_expr).split("/")[2]
        kinds[kind] = kinds.get(kind, 0) + 1
        reply(query, GoalReply("g", 1.0) if kind == "goal" else CommandReply("acquire", "holding", 1))
    jog, lease = entering.end()
    assert jog.error is None
    assert lease.lost is None


def test_a_function_that_a_call_calls_cannot_wait_for_the_same_robot(robot: Robot) -> None:
    """It would wait for itself, for ever."""

    def make(name: str) -> Goal:
        robot.state()
        return PoseGoal(0.0, 0.0, 0.0, id=name)

    with pytest.raises(ServiceError, match="must not call the robot"):
        robot.send(make)


def test_points_are_taken_in_the_callers_thread(robot: Robot, slow: Slow) -> None:
    threads: list[int] = []

    def points() -> Iterator[tuple[float, ...]]:
        for t in (0.0, 1.0):
            threads.append(threading.get_ident())
            yield t, 0.0, 0.0, 0.0

    answering = Call(lambda: reply(slow.next(), GoalReply("g", 1.0)))
    robot.follow(points(), id="g")
    answering.end()
    assert set(threads) == {threading.get_ident()}


# ---------------------------------------------------------------------- the end


@pytest.mark.parametrize(
    "call",
    [
        lambda robot: robot.home(),
        lambda robot: robot.stop(),
        lambda robot: robot.move_to(0.0, 0.0, 0.0),
        lambda robot: next(robot.states()),
        lambda robot: next(robot.events()),
        lambda robot: robot.lease().__enter__(),
    ],
)
def test_closing_ends_what_other_threads_wait_for(
    robot: Robot, slow: Slow, call: Callable[[Robot], object], caplog: pytest.LogCaptureFixture
) -> None:
    started = threading.Event()

    def do() -> object:
        started.set()
        return call(robot)

    calling = Call(do)
    started.wait(WITHIN)
    robot.close()
    assert CLOSED in str(calling.end()) or "no robot" in str(calling.end())
    assert caplog.records == []


def test_after_closing_every_call_says_so_and_no_thread_is_left(robot: Robot, slow: Slow) -> None:
    sending = Call(lambda: robot.move_to(0.0, 0.0, 0.0, id="g"))
    reply(slow.next(), GoalReply("g", 1.0))
    goal = sending.end()
    robot.close()
    robot.close()
    assert not robot._loop._thread.is_alive()
    for call in (robot.state, robot.enable, goal.wait, goal.cancel, lambda: next(robot.states()), robot.users):
        with pytest.raises(ServiceError, match=CLOSED):
            call()


@pytest.mark.parametrize("in_loop", [False, True])
def test_a_context_that_is_discarded_ends_whichever_thread_discards_it(in_loop: bool) -> None:
    ended = threading.Event()

    class Held:
        async def __aenter__(self) -> None: ...

        async def __aexit__(self, *_: object) -> None:
            ended.set()

    held: Any = Held()
    with contextlib.closing(LoopThread()) as loop:
        contexts = [Jog(held, loop).__enter__()]

        async def discard() -> None:
            contexts.clear()

        if in_loop:
            loop.start(discard())
        else:
            contexts.clear()
        assert ended.wait(WITHIN)
