"""Plans of Bluesky on a whole simulated service, run by the real RunEngine."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from bluesky import RunEngine, simulators
from bluesky import plan_stubs as bps
from bluesky import plans as bp
from bluesky import preprocessors as bpp
from bluesky.protocols import Subscribable
from bluesky.utils import FailedStatus, RunEngineInterrupted, SigintHandler
from ophyd_async.core import init_devices
from trirail import RefusedError, Robot, ServiceError, TrirailError
from trirail.bluesky import Stage, UnfinishedError
from trirail.bluesky import mover as mover_module
from trirail.bluesky.flight import COLUMNS
from trirail.bluesky.stage import StageLink
from trirail.client import own_service
from trirail.wire.messages import Event
from trirail.wire.state import State
from waiting import WITHIN, wait_until

pytestmark = pytest.mark.slow
GUIDE = Path(__file__).parents[2] / "service/bluesky.md"
HALF_WINDOW = 1e-4
"""Greatest error of x and y of a pose that is done [m]; that of phi is ten times as large [rad]."""
Documents = list[tuple[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def robot(locator: str) -> Iterator[Robot]:
    with Robot("demo", locator) as robot:
        yield robot


@pytest.fixture(scope="module")
def engine() -> Any:
    return RunEngine({})


@pytest.fixture(scope="module")
def connected(robot: Robot, engine: Any) -> Stage:
    return Stage(robot, "stage")


@pytest.fixture
def stage(connected: Stage, robot: Robot, engine: Any) -> Stage:
    """The stage, powered and at its centre."""
    if engine.state != "idle":
        engine.halt()
    robot.stop()
    if robot.state().mode == "fault":
        robot.reset()
    robot.override(100.0)
    robot.enable()
    assert robot.move_to(0.0, 0.0, 0.0).wait(WITHIN).outcome == "done"
    return connected


@contextmanager
def when(condition: Callable[[], bool], action: Callable[[], object]) -> Iterator[None]:
    """Do something in another thread as soon as a condition holds."""

    def wait() -> None:
        wait_until(condition, "the condition of an action", 0.01)
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    yield
    thread.join()


def run(engine: Any, plan: Any) -> Documents:
    documents: Documents = []
    engine(plan, lambda name, document: documents.append((name, document)))
    return documents


def scans(*arguments: Any, **options: Any) -> Any:
    """Return a list_scan, whose types allow no movable behind the detectors."""
    return bp.list_scan(*arguments, **options)


def limits_of(plan: Any) -> Any:
    """Return the check of a plan without running it, which has no types."""
    check: Any = simulators.check_limits_async
    return check(plan)


def data(documents: Documents) -> list[dict[str, Any]]:
    return [document["data"] for name, document in documents if name == "event"]


def goal_events(robot: Robot, begin: int = 0) -> list[Event]:
    return [e for e in robot.events(history=True, timeout=1.0) if e.kind == "goal" and e.seq > begin]


def newest_event(robot: Robot) -> int:
    return max(event.seq for event in robot.events(history=True, timeout=1.0))


def at(row: dict[str, Any], x: float, y: float = 0.0, phi: float = 0.0) -> bool:
    measured = np.array([row["stage-x"], row["stage-y"], row["stage-phi"]])
    return bool(np.all(np.abs(measured - (x, y, phi)) <= (HALF_WINDOW, HALF_WINDOW, 10.0 * HALF_WINDOW)))


def test_count_has_every_reading_with_its_unit_limits_and_precision(stage: Stage, engine: Any) -> None:
    documents = run(engine, bp.count([stage], num=3))
    keys = next(document["data_keys"] for name, document in documents if name == "descriptor")
    assert {name: key["units"] for name, key in keys.items()} == {
        "stage-x": "m", "stage-y": "m", "stage-phi": "rad", "stage-pose": "m, m, rad",
        "stage-sliders": "m", "stage-following_error": "m", "stage-t": "s",
    }  # fmt: skip
    assert keys["stage-x"]["limits"] == {"control": {"low": -0.15, "high": 0.15}}
    assert keys["stage-x"]["precision"] == 5
    rows = data(documents)
    assert len(rows) == 3
    assert len({row["stage-t"] for row in rows}) == 3
    assert all(at(row, 0.0) for row in rows)


def test_axes_that_are_set_together_are_one_straight_move(stage: Stage, robot: Robot, engine: Any) -> None:
    begin, states = newest_event(robot), list[State]()
    with robot_states(robot, states):
        run(engine, bps.mv(stage.x, 0.03, stage.y, 0.06, stage.phi, 0.15))
    assert [event.outcome for event in goal_events(robot, begin)] == ["done"]
    assert robot.state().commanded.pose == pytest.approx((0.03, 0.06, 0.15), abs=1e-12)
    for x, y, phi in (state.commanded.pose for state in states):
        assert (y, phi) == pytest.approx((2.0 * x, 5.0 * x), abs=1e-9)


@contextmanager
def robot_states(robot: Robot, kept: list[State]) -> Iterator[None]:
    """Keep states while the context lasts."""
    over = threading.Event()

    def keep() -> None:
        for state in robot.states():
            kept.append(state)
            if over.is_set():
                return

    thread = threading.Thread(target=keep)
    thread.start()
    try:
        wait_until(lambda: bool(kept), "the first state", 0.01)
        yield
    finally:
        over.set()
        thread.join()


def test_an_axis_that_is_set_later_leaves_the_others_their_targets(stage: Stage, robot: Robot, engine: Any) -> None:
    async def is_moving() -> None:
        while (await stage.x.locate())["readback"] < 0.002:
            pass  # the next state

    def plan() -> Any:
        yield from bps.abs_set(stage.x, 0.04, group="later")
        yield from bps.wait_for([is_moving])
        yield from bps.abs_set(stage.y, 0.02, group="later")
        yield from bps.wait("later")

    run(engine, plan())
    assert robot.state().commanded.pose == pytest.approx((0.04, 0.02, 0.0), abs=1e-12)


def test_scans_read_each_point_where_it_is(stage: Stage, engine: Any) -> None:
    rows = data(run(engine, bp.scan([stage], stage.x, -0.01, 0.01, 5)))
    assert [at(row, x) for row, x in zip(rows, np.linspace(-0.01, 0.01, 5), strict=True)] == [True] * 5
    rows = data(run(engine, bp.rel_scan([stage], stage.x, 0.0, 0.01, 3)))
    assert [at(row, 0.01 + x) for row, x in zip(rows, (0.0, 0.005, 0.01), strict=True)] == [True] * 3
    rows = data(run(engine, scans([], stage.x, [0.0, 0.002], stage.phi, [0.1, -0.1])))
    assert [sorted(row) for row in rows] == [["stage-phi", "stage-x"]] * 2
    assert [round(row["stage-phi"], 3) for row in rows] == [0.1, -0.1]
    poses = [(0.001, 0.002, 0.03), (-0.001, 0.0, -0.03)]
    rows = data(run(engine, scans([stage], stage.pose, poses)))
    assert [at(row, *pose) for row, pose in zip(rows, poses, strict=True)] == [True] * 2


def test_each_of_two_hundred_readings_is_of_its_own_point(stage: Stage, engine: Any) -> None:
    """Each point differs from every other by more than the window of `done`: the pose tells which one it is."""
    step = 10.0 * HALF_WINDOW
    rows = data(run(engine, bp.grid_scan([stage], stage.x, 0.0, 9 * step, 10, stage.y, 0.0, 19 * step, 20)))
    places = [(round(row["stage-x"] / step), round(row["stage-y"] / step)) for row in rows]
    assert places == [(x, y) for x in range(10) for y in range(20)]
    assert all(at(row, x * step, y * step) for row, (x, y) in zip(rows, places, strict=True))
    times = [row["stage-t"] for row in rows]
    assert times == sorted(set(times))


def test_a_refused_point_ends_the_plan_with_the_reason(stage: Stage, engine: Any) -> None:
    documents: Documents = []
    with pytest.raises(FailedStatus) as caught:
        engine(bp.scan([stage], stage.x, 0.1, 0.2, 3), lambda name, document: documents.append((name, document)))
    assert isinstance(caught.value.__cause__, RefusedError)
    assert len(data(documents)) == 2
    assert documents[-1][0] == "stop"
    assert documents[-1][1]["exit_status"] == "fail"
    assert "150 mm" in documents[-1][1]["reason"]


def test_a_plan_is_checked_without_a_move(stage: Stage, robot: Robot, engine: Any) -> None:
    begin = newest_event(robot)

    def check(value: Any) -> None:
        asyncio.run_coroutine_threadsafe(value, engine.loop).result(WITHIN)

    check(stage.pose.check_value((0.02, 0.03, 0.1)))
    with pytest.raises(RefusedError):
        check(stage.pose.check_value((0.1, 0.1, 0.8)))
    check(limits_of(bp.scan([stage], stage.x, -0.1, 0.1, 3)))
    with pytest.raises(RefusedError, match="150 mm"):
        check(limits_of(bp.scan([stage], stage.x, 0.1, 0.2, 3)))
    assert goal_events(robot, begin) == []


def test_a_paused_plan_stops_the_robot_and_resumes(stage: Stage, robot: Robot, engine: Any) -> None:
    robot.override(10.0)
    documents: Documents = []
    plan = bp.scan([stage], stage.x, 0.02, 0.04, stage.y, 0.0, 0.01, num=2)
    states: list[State] = []
    with robot_states(robot, states):
        with when(lambda: robot.state().pose.x > 0.005, engine.request_pause), pytest.raises(RunEngineInterrupted):
            engine(plan, lambda name, document: documents.append((name, document)))
        state = robot.state()
        assert state.mode == "holding"
        assert 0.0 < state.commanded.pose.x < 0.02
        assert robot.state().commanded.pose == state.commanded.pose
        robot.override(100.0)
        engine.resume()
    assert [at(row, x, y) for row, (x, y) in zip(data(documents), [(0.02, 0.0), (0.04, 0.01)], strict=True)] == [
        True
    ] * 2
    assert (
        np.abs(np.diff([state.commanded.pose.x for state in states])).max() < 0.02
    )  # within 20 ms at full speed, or a few states lost
    assert robot.state().faults == ()


def test_ctrl_c_in_a_move_stops_the_robot(
    stage: Stage, robot: Robot, engine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot.override(10.0)
    begin = newest_event(robot)

    def press_twice() -> None:  # the first asks for a pause at the next checkpoint, the second for one now
        os.kill(os.getpid(), signal.SIGINT)
        wait_until(lambda: engine._deferred_pause_requested, "the first Ctrl-C")
        (handler,) = handlers
        wait_until(lambda: time.monotonic() - handler._last_sigint_time > 0.1, "the handler takes earlier ones as one")
        os.kill(os.getpid(), signal.SIGINT)

    handlers: list[Any] = []

    def keep_handler(engine: Any) -> Any:
        handlers.append(SigintHandler(engine))  # type: ignore[no-untyped-call]
        return handlers[-1]

    monkeypatch.setattr(engine, "context_managers", [keep_handler])
    with when(lambda: robot.state().pose.x > 0.005, press_twice), pytest.raises(RunEngineInterrupted):
        run(engine, bp.scan([stage], stage.x, 0.03, 0.04, 2))
    assert robot.state().mode == "holding"
    assert robot.state().commanded.pose.x < 0.03
    engine.abort()
    assert [event.outcome for event in goal_events(robot, begin)] == ["stopped"]


@pytest.mark.parametrize(
    ("disturb", "outcome", "words"),
    [
        (lambda robot: robot.stop(), "stopped", "stop"),
        (lambda robot: robot.quick_stop(), "faulted", "quick"),
        (lambda robot: robot.move_to(0.0, 0.0, 0.0), "preempted", "preempted"),
    ],
    ids=["stop", "fault", "other goal"],
)
def test_what_ends_a_goal_ends_the_plan_with_its_message(
    disturb: Callable[[Robot], object], outcome: str, words: str, stage: Stage, robot: Robot, engine: Any
) -> None:
    robot.override(10.0)
    with (
        when(lambda: robot.state().pose.x > 0.005, lambda: disturb(robot)),
        pytest.raises(FailedStatus) as caught,
    ):
        run(engine, bp.scan([stage], stage.x, 0.03, 0.04, 2))
    assert isinstance(caught.value.__cause__, UnfinishedError)
    assert caught.value.__cause__.result.outcome == outcome
    assert words in str(caught.value.__cause__)


def step_of_the_guide() -> Any:
    """Return the step of the guide's scan that a fault pauses."""
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    (block,) = (block for block in blocks if "repeated_step" in block)
    names: dict[str, Any] = {"bps": bps}
    exec(block.partition("RE(")[0], names)
    return names["repeated_step"]


def test_a_scan_goes_on_after_a_fault_that_is_cleared(stage: Stage, robot: Robot, engine: Any) -> None:
    robot.override(20.0)
    documents: Documents = []
    xs, begin = np.linspace(0.01, 0.05, 5), newest_event(robot)
    plan = bp.scan([stage], stage.x, 0.01, 0.05, stage.y, 0.0, 0.02, num=5, per_step=step_of_the_guide())
    with when(lambda: robot.state().pose.x > 0.025, robot.quick_stop), pytest.raises(RunEngineInterrupted):
        engine(plan, lambda name, document: documents.append((name, document)))
    assert engine.state == "paused"
    state = robot.state()
    assert (state.mode, len(data(documents))) == ("fault", 2)
    clear_fault(robot)
    robot.override(100.0)
    engine.resume()
    rows = data(documents)
    assert [at(row, x, (x - 0.01) / 2.0) for row, x in zip(rows, xs, strict=True)] == [True] * 5
    assert [document["seq_num"] for name, document in documents if name == "event"] == [1, 2, 3, 4, 5]
    assert documents[-1][1]["exit_status"] == "success"
    outcomes = [event.outcome for event in goal_events(robot, begin)]
    assert (outcomes.count("faulted"), set(outcomes)) == (1, {"done", "faulted"})


def test_a_plan_clears_a_fault_itself_and_repeats_the_point(stage: Stage, robot: Robot, engine: Any) -> None:
    def clearing_step(detectors: Any, step: Any, pos_cache: Any) -> Any:
        try:
            yield from bps.one_nd_step(detectors, step, pos_cache)
        except FailedStatus:
            pos_cache.update(dict.fromkeys(step))
            yield from bps.wait_for([lambda: asyncio.to_thread(clear_fault, robot)])
            robot.override(100.0)
            yield from bps.one_nd_step(detectors, step, pos_cache)

    robot.override(20.0)
    with when(lambda: robot.state().pose.x > 0.005, robot.quick_stop):
        rows = data(run(engine, bp.scan([stage], stage.x, 0.0, 0.02, 3, per_step=cast(Any, clearing_step))))
    assert [at(row, x) for row, x in zip(rows, (0.0, 0.01, 0.02), strict=True)] == [True] * 3


def clear_fault(robot: Robot) -> None:
    """Reset once the drives are at rest, and enable."""

    def is_reset() -> bool:
        try:
            robot.reset()
        except RefusedError:
            return False
        return True

    wait_until(is_reset, "the drives are at rest")
    robot.enable()


def test_the_end_of_a_plan_leaves_goals_of_others_alone(stage: Stage, robot: Robot, engine: Any) -> None:
    run(engine, bps.mv(stage.x, 0.001))
    robot.override(10.0)
    goal = robot.move_to(0.02, 0.0, 0.0)
    run(engine, bp.count([stage]))
    asyncio.run_coroutine_threadsafe(stage.stop(), engine.loop).result(WITHIN)
    robot.override(100.0)
    assert goal.wait(WITHIN).outcome == "done"


def pages(documents: Documents, part: str = "data") -> dict[str, list[Any]]:
    """Return the columns of a flight's data, or of their timestamps."""
    found: dict[str, list[Any]] = {}
    for name, document in documents:
        if name == "event_page":
            for key, values in document[part].items():
                found.setdefault(key, []).extend(values)
    return found


def test_a_fly_scan_without_points_is_refused(connected: Stage) -> None:
    with pytest.raises(RefusedError, match="points: the list is empty; expected"):
        connected.follow([])


def test_a_fly_scan_collects_every_state_on_the_way(stage: Stage, engine: Any) -> None:
    points = [(0.0, 0.01, 0.0, 0.0), (1.0, 0.02, 0.01, 0.05), (2.0, 0.03, 0.0, 0.0)]
    found = pages(run(engine, bp.fly([stage.follow(points)])))
    assert len(found["stage-t"]) > 50
    assert np.all(np.diff(found["stage-t"]) > 0.0)
    assert found["stage-x"][0] == pytest.approx(0.01, abs=1e-3)
    assert max(found["stage-y"]) == pytest.approx(0.01, abs=1e-3)


def outcome_of(robot: Robot, begin: int) -> str | None:
    """Wait until the robot is at rest; return the outcome of its last goal after an event."""
    wait_until(
        lambda: robot.state().mode != "moving" and bool(goal_events(robot, begin)), "the end of the flight", 0.01
    )
    return goal_events(robot, begin)[-1].outcome


def test_an_error_in_a_plan_stops_its_flight(stage: Stage, robot: Robot, engine: Any) -> None:
    flight = stage.fly_to(0.05, 0.0, 0.0)

    def plan() -> Any:
        yield from bps.open_run()
        yield from bps.kickoff(flight, wait=True)
        raise ValueError("another device has failed")

    robot.override(10.0)
    begin = newest_event(robot)
    with pytest.raises(ValueError, match="another device"):
        run(engine, plan())
    assert outcome_of(robot, begin) == "stopped"


@pytest.mark.parametrize("early", [True, False])
def test_a_further_collect_yields_no_row_again(stage: Stage, engine: Any, early: bool) -> None:
    flight = stage.fly_to(0.02, 0.0, 0.0, speed=0.5)

    def plan() -> Any:
        yield from bps.open_run()
        yield from bps.kickoff(flight, wait=True)
        if early:
            yield from bps.sleep(0.1)
            yield from bps.collect(flight)
        yield from bps.complete(flight, wait=True)
        yield from bps.collect(flight)
        yield from bps.collect(flight)
        yield from bps.close_run()

    found = pages(run(engine, plan()))
    assert np.all(np.diff(found["stage-t"]) > 0.0)
    assert found["stage-x"][-1] == pytest.approx(0.02, abs=HALF_WINDOW)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_pause_on_the_way_to_a_flight_is_no_failure(stage: Stage, robot: Robot, engine: Any, share: float) -> None:
    points = [(0.0, 0.02, 0.0, 0.0), (0.5, 0.03, 0.0, 0.0)]
    robot.override(20.0)
    begin = newest_event(robot)
    with when(lambda: robot.state().pose.x > share * 0.02, engine.request_pause), pytest.raises(RunEngineInterrupted):
        run(engine, bp.fly([stage.follow(points)]))
    assert robot.state().commanded.pose.x < 0.02
    robot.override(100.0)
    engine.resume()
    assert [event.outcome for event in goal_events(robot, begin)] == ["stopped", "done", "done"]


@pytest.mark.parametrize("success", [True, False])
def test_a_flight_that_is_stopped_before_its_start_fails_only_if_that_is_a_failure(
    stage: Stage, robot: Robot, engine: Any, success: bool
) -> None:
    flight = stage.fly_to(0.05, 0.0, 0.0)

    async def fly() -> None:
        status = flight.kickoff()
        await flight.stop(success)
        await status
        await flight.complete()

    begin, ended = newest_event(robot), asyncio.run_coroutine_threadsafe(fly(), engine.loop)
    if success:
        ended.result(WITHIN)
    else:
        with pytest.raises(TrirailError, match="stopped before"):
            ended.result(WITHIN)
    assert goal_events(robot, begin) == []


def test_a_pause_stops_a_flight_and_resume_repeats_it(stage: Stage, robot: Robot, engine: Any) -> None:
    points = [(0.0, 0.01, 0.0, 0.0), (0.5, 0.02, 0.01, 0.05), (1.0, 0.03, 0.0, 0.0)]
    robot.override(20.0)
    begin = newest_event(robot)
    documents: Documents = []
    with when(lambda: robot.state().pose.x > 0.015, engine.request_pause), pytest.raises(RunEngineInterrupted):
        engine(bp.fly([stage.follow(points)]), lambda name, document: documents.append((name, document)))
    assert (engine.state, robot.state().mode) == ("paused", "holding")
    assert 0.01 < robot.state().commanded.pose.x < 0.03
    robot.override(100.0)
    engine.resume()
    assert [event.outcome for event in goal_events(robot, begin)] == ["done", "stopped", "done", "done"]
    found = pages(documents)
    assert (found["stage-x"][0], found["stage-x"][-1]) == pytest.approx((0.01, 0.03), abs=1e-3)
    assert np.all(np.diff(found["stage-t"]) > 0.0)
    assert max(np.diff(found["stage-t"])) < 1.0  # of one flight
    assert documents[-1][1]["exit_status"] == "success"


def test_an_abort_of_a_paused_flight_leaves_the_robot_at_rest(stage: Stage, robot: Robot, engine: Any) -> None:
    robot.override(10.0)
    begin = newest_event(robot)
    with when(lambda: robot.state().pose.x > 0.005, engine.request_pause), pytest.raises(RunEngineInterrupted):
        run(engine, bp.fly([stage.fly_to(0.05, 0.0, 0.0)]))
    engine.abort()
    assert outcome_of(robot, begin) == "stopped"
    assert robot.state().commanded.pose.x < 0.05


def test_a_reading_has_the_time_of_its_state(stage: Stage, robot: Robot, engine: Any) -> None:
    states: list[State] = []
    with robot_states(robot, states):
        scanned = run(engine, bp.count([stage], num=3))
        flown = run(engine, bp.fly([stage.fly_to(0.03, 0.0, 0.0, speed=0.3)]))
    times = {state.t: state.time for state in states}
    read = [(document["data"]["stage-t"], set(document["timestamps"].values()))
            for name, document in scanned if name == "event"]  # fmt: skip
    assert len(read) == 3
    assert all(stamps == {times[t]} for t, stamps in read if t in times)
    ts, stamps = pages(flown)["stage-t"], pages(flown, "timestamps")
    assert all(column == stamps["stage-t"] for column in stamps.values())
    shared = [(t, stamp) for t, stamp in zip(ts, stamps["stage-t"], strict=True) if t in times]
    assert len(shared) > 10
    assert shared == [(t, times[t]) for t, _ in shared]
    assert np.median(np.abs(np.diff(stamps["stage-t"]) - np.diff(ts))) < 1e-3
    assert abs(time.time() - stamps["stage-t"][-1]) < WITHIN


def test_a_monitor_gets_every_state_until_it_is_removed(stage: Stage, robot: Robot, engine: Any) -> None:
    def plan() -> Any:
        yield from bps.open_run()
        yield from bps.monitor(stage, name="states")
        yield from bps.monitor(stage.x, name="x")
        yield from bps.mv(stage.x, 0.03)
        yield from bps.unmonitor(stage.x)
        yield from bps.unmonitor(stage)
        yield from bps.create()
        yield from bps.read(stage)
        yield from bps.save()
        yield from bps.close_run()

    documents = run(engine, plan())
    streams = {document["uid"]: document["name"] for name, document in documents if name == "descriptor"}
    told = [(streams[document["descriptor"]], document) for name, document in documents if name == "event"]
    assert [stream for stream, _ in told[-1:]] == ["primary"]
    last = told[-1][1]["data"]["stage-t"]
    whole = [document for stream, document in told if stream == "states"]
    times = [document["data"]["stage-t"] for document in whole]
    assert times == sorted(set(times))
    assert times[-1] < last
    assert max(document["data"]["stage-x"] for document in whole) > 0.02
    assert all(set(document["timestamps"].values()) == {document["timestamps"]["stage-t"]} for document in whole)
    places = [document["data"] for stream, document in told if stream == "x"]
    assert len(places) > 5
    assert {name for place in places for name in place} == {"stage-x"}
    assert stage._monitors == stage.x._monitors == {}
    assert isinstance(stage, Subscribable)
    assert isinstance(stage.pose, Subscribable)


def test_a_monitor_rests_while_the_plan_is_paused(stage: Stage, robot: Robot, engine: Any) -> None:
    robot.override(10.0)
    documents: Documents = []
    monitored: Any = bpp.monitor_during_wrapper  # which has no types
    plan = monitored(bp.scan([stage], stage.x, 0.02, 0.03, 2), [stage.y])
    with when(lambda: robot.state().pose.x > 0.002, engine.request_pause), pytest.raises(RunEngineInterrupted):
        engine(plan, lambda name, document: documents.append((name, document)))
    assert stage.y._monitors == {}
    before = len(documents)
    state = robot.state()
    wait_until(lambda: robot.state().seq > state.seq)
    assert len(documents) == before
    robot.override(100.0)
    engine.resume()
    places = [row for row in data(documents[before:]) if "stage-y" in row and "stage-x" not in row]
    assert len(places) > 5


def test_an_error_of_a_monitor_does_not_end_it(stage: Stage, engine: Any, caplog: pytest.LogCaptureFixture) -> None:
    calls: list[float] = []

    def fail(readings: dict[str, Any]) -> None:
        calls.append(readings["stage-x"]["value"])
        raise ValueError("this monitor fails")

    def plan() -> Any:
        stage.x.subscribe_reading(fail)
        with pytest.raises(ValueError, match="already"):
            stage.x.subscribe_reading(fail)
        yield from bps.mv(stage.x, 0.01)
        stage.x.clear_sub(fail)

    run(engine, plan())
    assert len(calls) > 3
    assert "a monitor of stage-x failed" in caplog.text
    with pytest.raises(KeyError):
        stage.x.clear_sub(fail)


@pytest.mark.parametrize("what", ["stage", "axis", "flight"])
@pytest.mark.parametrize("elsewhere", [True, False])
def test_a_stop_ends_what_the_stage_does_in_whichever_event_loop(
    stage: Stage, robot: Robot, engine: Any, what: str, elsewhere: bool
) -> None:
    """A script may use the stage, or stop it, in a loop of its own while a plan moves it in that of the RunEngine."""
    flight = stage.fly_to(0.05, 0.0, 0.0)
    plan = bp.fly([flight]) if what == "flight" else bps.mv(stage.x, 0.05)

    def stop() -> None:
        if elsewhere:
            asyncio.run(stage.x.locate())
            asyncio.run((stage.x if what == "axis" else stage).stop())
        else:
            asyncio.run_coroutine_threadsafe(stage.stop(), engine.loop).result(WITHIN)

    robot.override(10.0)
    begin = newest_event(robot)
    with when(lambda: robot.state().pose.x > 0.002, stop):
        run(engine, plan)
    assert outcome_of(robot, begin) == "stopped"
    assert robot.state().commanded.pose.x < 0.04


@pytest.mark.parametrize("what", ["axis", "flight"])
@pytest.mark.parametrize("closed", [True, False])
def test_a_stop_reaches_what_an_event_loop_has_begun_that_is_closed_or_blocked(
    stage: Stage, robot: Robot, what: str, closed: bool
) -> None:
    """As that of a notebook while another cell computes, or of a script that an error has ended."""
    other, stopped = Stage(robot, "other"), threading.Event()
    flight = other.fly_to(0.05, 0.0, 0.0)

    async def begin() -> None:
        begun = flight.kickoff() if what == "flight" else other.x.set(0.05)
        while robot.state().pose.x < 0.002:
            await asyncio.sleep(0.01)
        if not closed:
            threading.Thread(target=stop).start()
            stopped.wait(WITHIN)  # which blocks this event loop
            await asyncio.wait([begun.task])

    def stop() -> None:
        try:
            asyncio.run(other.stop())
        finally:
            stopped.set()

    robot.override(10.0)
    before = newest_event(robot)
    asyncio.run(begin())
    if closed:
        stop()
    assert outcome_of(robot, before) == "stopped"
    assert robot.state().commanded.pose.x < 0.04


@pytest.mark.parametrize("with_axis", [True, False])
def test_a_path_that_a_pause_has_stopped_is_not_complete(
    stage: Stage, robot: Robot, engine: Any, with_axis: bool
) -> None:
    """Unless the plan repeats its kickoff; here it resumes behind that."""
    flight = stage.fly_to(0.05, 0.0, 0.0)

    def plan() -> Any:
        yield from bps.open_run()
        if with_axis:  # a pause stops what was set before it pauses the flight
            yield from bps.mv(stage.y, 0.001)
        yield from bps.kickoff(flight, wait=True)
        yield from bps.checkpoint()
        yield from bps.sleep(0.5)
        yield from bps.complete(flight, wait=True)
        yield from bps.close_run()

    robot.override(10.0)
    with when(lambda: robot.state().pose.x > 0.005, engine.request_pause), pytest.raises(RunEngineInterrupted):
        run(engine, plan())
    with when(lambda: engine.state == "running", engine.request_pause), pytest.raises(RunEngineInterrupted):
        engine.resume()
    with pytest.raises(FailedStatus) as caught:
        engine.resume()
    assert "a checkpoint must not be between kickoff and complete" in str(caught.value.__cause__)


def test_readings_and_setpoints_are_unknown_until_every_slider_is_homed(stage: Stage, robot: Robot) -> None:
    state = robot.state()
    unhomed = msgspec.structs.replace(state, sliders=msgspec.structs.replace(state.sliders, homed=(True, False, True)))
    values = {name: reading["value"] for name, reading in stage.readings(unhomed).items()}
    assert np.isnan([values["stage-x"], values["stage-phi"], *values["stage-pose"]]).all()
    assert np.isnan(values["stage-sliders"]).tolist() == [False, True, False]

    class Unhomed:
        async def state(self) -> State:
            return unhomed

    async def locate() -> Any:
        other = Stage(robot)
        linked: Any = asyncio.get_running_loop().create_future()
        linked.set_result(StageLink(asyncio.get_running_loop(), cast(Any, Unhomed()), cast(Any, None), cast(Any, None)))
        other._links[asyncio.get_running_loop()] = linked
        return await other.y.locate()

    assert np.isnan([*asyncio.run(locate()).values()]).all()


def test_a_flight_keeps_every_state_while_the_event_loop_is_blocked(stage: Stage, robot: Robot, engine: Any) -> None:
    flight = stage.fly_to(0.03, 0.0, 0.0, speed=0.5)

    def plan() -> Any:
        yield from bps.open_run()
        yield from bps.kickoff(flight, wait=True)
        for _ in range(3):
            engine.loop.call_soon_threadsafe(time.sleep, 0.2)  # a detector that reads synchronously
            yield from bps.sleep(0.05)
        yield from bps.complete(flight, wait=True)
        yield from bps.collect(flight)
        yield from bps.close_run()

    states: list[State] = []
    with robot_states(robot, states):
        kept = pages(run(engine, plan()))["stage-t"]
    under_way = {state.t for state in states if state.goal is not None}
    assert len(under_way) > 10
    assert len(under_way - set(kept)) <= 1  # one may come after the result


def test_pauses_after_the_end_of_a_path_leave_it_complete(stage: Stage, robot: Robot, engine: Any) -> None:
    flight = stage.fly_to(0.01, 0.0, 0.0)

    def plan() -> Any:
        yield from bps.open_run()
        yield from bps.kickoff(flight, wait=True)
        yield from bps.checkpoint()
        while flight.under_way:
            yield from bps.sleep(0.05)
        yield from bps.pause()
        yield from bps.pause()
        yield from bps.complete(flight, wait=True)
        yield from bps.close_run()

    with pytest.raises(RunEngineInterrupted):
        run(engine, plan())
    for _ in range(2):
        with contextlib.suppress(RunEngineInterrupted):
            engine.resume()
    assert engine.state == "idle"
    assert robot.state().pose.x == pytest.approx(0.01, abs=HALF_WINDOW)


def test_a_mock_is_refused_since_it_would_move_the_robot(stage: Stage, robot: Robot, engine: Any) -> None:
    with pytest.raises(Exception, match="has no mock"), init_devices(mock=True):
        _mocked = Stage(robot)
    for device in (stage.x, stage.fly_to(0.0, 0.0, 0.0)):
        with pytest.raises(TrirailError, match="has no mock"):
            asyncio.run(device.connect(mock=True))


def test_a_fly_scan_that_is_stopped_fails_with_the_reason(stage: Stage, robot: Robot, engine: Any) -> None:
    robot.override(10.0)
    with when(lambda: robot.state().pose.x > 0.005, robot.stop), pytest.raises(FailedStatus) as caught:
        run(engine, bp.fly([stage.fly_to(0.03, 0.0, 0.0)]))
    assert isinstance(caught.value.__cause__, UnfinishedError)
    with pytest.raises(FailedStatus):
        run(engine, bp.fly([stage.fly_to(0.3, 0.0, 0.0)]))


def test_a_stage_is_named_after_its_variable_or_stage(stage: Stage, robot: Robot, engine: Any) -> None:
    rows = data(run(engine, bp.scan([], Stage(robot).x, 0.0, 0.001, 2)))
    assert [round(row["stage-x"], 3) for row in rows] == [0.0, 0.001]
    with init_devices():
        table = Stage(robot)
    assert {"table-x", "table-pose", "table-t"} < set(data(run(engine, bp.count([table])))[0])


def test_a_stage_is_used_in_one_event_loop_after_another(stage: Stage, robot: Robot, engine: Any) -> None:
    other = Stage(robot, "other")
    links = []

    async def use(x: float) -> None:
        link, again = await asyncio.gather(other.link(), other.link())
        assert link is again
        links.append(link)
        await other.x.set(x)
        assert (await other.read())["other-x"]["value"] == pytest.approx(x, abs=HALF_WINDOW)

    for x in (0.01, 0.02):
        asyncio.run(use(x))
    rows = data(run(engine, scans([other], other.x, [0.0])))
    assert [round(row["other-x"], 3) for row in rows] == [0.0]
    first, second = links
    for link in (first, second):  # nothing is received for an event loop that is closed
        with pytest.raises(ServiceError):
            asyncio.run(link.robot.state())


def with_outputs(config: Path) -> None:
    text = config.read_text(encoding="utf-8")
    config.write_text(text + '\n[outputs.strobe]\ndrive = "A"\nbit = 16\n', encoding="utf-8")


def test_fly_scans_with_marks_and_without_collect_in_one_run(engine: Any, tmp_path: Path) -> None:
    config, locator = own_service.private(tmp_path)
    with_outputs(config)
    with own_service.service(config, tmp_path / "session.rrd"), Robot("demo", locator) as robot:
        with init_devices():
            stage = Stage(robot)
        robot.enable()
        marks = [{"output": "strobe", "start": 0.002, "end": 0.018, "increment": 0.002, "pulse_width": 0.003}]
        flights = [stage.fly_to(0.02, 0.0, 0.0, marks=marks, speed=0.3), stage.fly_to(0.0, 0.0, 0.0)]

        def plan() -> Any:
            yield from bps.open_run()
            for flight in flights:
                yield from bps.kickoff(flight, wait=True)
                yield from bps.complete(flight, wait=True)
                yield from bps.collect(flight)
            yield from bps.close_run()

        flown = run(engine, plan())
    found, stamps = pages(flown), pages(flown, "timestamps")
    assert found["stage-x"][-1] == pytest.approx(0.0, abs=HALF_WINDOW)
    on = [x for x, value in zip(found["marked_flight-commanded_x"], found["marked_flight-value"], strict=True) if value]
    assert on == pytest.approx(np.arange(1, 10) * 0.002, abs=5e-4)
    assert set(found["marked_flight-output"]) == {"strobe"}
    switched = [column for key, column in stamps.items() if key.startswith("marked_flight-")]
    assert switched == [found["marked_flight-time"]] * len(COLUMNS)
    late = np.diff(found["marked_flight-time"]) - np.diff(found["marked_flight-t"])
    assert np.median(np.abs(late)) < 1e-4


def test_a_service_that_is_killed_ends_the_plan_and_the_next_one_works(
    engine: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mover_module, "SILENCE_S", 2.0)
    config, locator = own_service.private(tmp_path)
    with (tmp_path / "log").open("wb") as log:
        first = own_service.start(config, log)
        try:
            with Robot("demo", locator) as robot:
                with init_devices():
                    stage = Stage(robot)
                robot.enable()
                robot.override(1.0)

                def kill() -> None:
                    os.killpg(first.pid, signal.SIGKILL)

                with when(lambda: robot.state().mode == "moving", kill), pytest.raises(FailedStatus) as caught:
                    run(engine, bps.mv(stage.x, 0.03))
                assert isinstance(caught.value.__cause__, ServiceError | UnfinishedError)
                with pytest.raises((FailedStatus, TrirailError)):
                    run(engine, bps.mv(stage.x, 0.03))
                first.wait(WITHIN)
                text = config.read_text(encoding="utf-8")
                changed = re.sub(r"^x = \[.*?\]", "x = [-0.12, 0.12]", text, count=1, flags=re.MULTILINE)
                config.write_text(changed, encoding="utf-8")
                second = own_service.start(config, log)
                try:
                    robot.enable()
                    documents = run(engine, scans([stage], stage.x, [0.02, 0.03]))
                    keys = next(document["data_keys"] for name, document in documents if name == "descriptor")
                    assert keys["stage-x"]["limits"] == {"control": {"low": -0.12, "high": 0.12}}
                    assert robot.state().pose.x == pytest.approx(0.03, abs=HALF_WINDOW)
                finally:
                    own_service.end(second)
        finally:
            if first.poll() is None:
                os.killpg(first.pid, signal.SIGKILL)
                first.wait(WITHIN)
