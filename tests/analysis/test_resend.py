"""Requests of a recorded session, sent again: in their order, and none before what had ended by then."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
from conftest import Rig
from made import records
from trirail.analysis.resend import _beginnings, _Heard, _send
from trirail.analysis.summary import _goals
from trirail.client.client import GoalHandle, Result, Robot
from trirail.telemetry.reading import Line, Recording
from trirail.wire.goals import Goal, PoseGoal
from trirail.wire.messages import Event
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest, Request
from trirail.wire.vocabulary import Command, CommandContent, Stop
from waiting import WITHIN, wait_until


class Heard:
    """A robot's client that notes what it is told, and when it is waited for a goal."""

    def __init__(self) -> None:
        self.log: list[str] = []

    def send(self, goal: Goal) -> GoalHandle:
        assert goal.id is not None
        self.log.append(f"send {goal.id[:-7]}")
        return Ending(goal.id, self)

    def command(self, name: str, content: CommandContent | bytes) -> None:
        assert content == Stop()
        self.log.append(name)


class Ending(GoalHandle):
    """A goal that ends as soon as it is waited for."""

    def __init__(self, name: str, heard: Heard) -> None:
        super().__init__(name, heard.command)
        self._heard = heard

    def wait(self, timeout: float | None = None) -> Result:
        self._heard.log.append(f"end {self.id[:-7]}")
        return Result(self.id, "done", "")


def goal(seq: int, cycle: int, name: str) -> ControlInput:
    return ControlInput(seq, cycle, 0, GoalRequest(seq, "ann", name, PoseGoal(0.01, 0.0, 0.0), 0))


def ended(cycle: int, name: str, outcome: Any) -> Line:
    event = Event("goal", "info", "", id=name, outcome=outcome, seq=cycle, t=cycle * 1e-3, cycle=cycle, time=0.0)
    return Line(event.t, np.datetime64(0, "ns"), "INFO", "", event)


class Talking:
    """A robot's client to whom something happens for ever."""

    def __init__(self) -> None:
        self.told = threading.Event()

    def events(self, history: bool, timeout: float) -> Iterator[Event]:
        for seq in itertools.count(1):
            yield Event("service", "info", "", goal=f"{timeout}", seq=seq, t=0.0, cycle=seq, time=0.0)
            self.told.set()
            time.sleep(0)  # the other thread's turn

    @contextlib.contextmanager
    def records(self, _: Any) -> Iterator[None]:
        yield


def test_listening_ends_with_its_context_though_something_happens_all_the_time() -> None:
    talking = Talking()
    ended = threading.Event()

    def listen() -> None:
        with _Heard(cast("Robot", talking)).listening():
            assert talking.told.wait(WITHIN)
        ended.set()

    threading.Thread(target=listen, daemon=True).start()
    assert ended.wait(WITHIN)


class Late(Talking):
    """One who tells that a motion has begun while nobody listens, whenever he is asked to tell the past as well."""

    def events(self, history: bool, timeout: float) -> Iterator[Event]:
        if history and self.told.is_set():
            yield Event("mode", "info", "", goal="g", seq=1, t=0.0, cycle=7, time=0.0)
        self.told.set()


def test_what_is_told_before_it_listens_or_between_two_silences_is_heard() -> None:
    heard = _Heard(cast("Robot", Late()))
    with heard.listening():
        wait_until(lambda: heard.began == {"g": 7})


ODD = ["g", "my goal", "goal of ann", "moving: goal x of", "done: ", "ü: ∅"]
"""Ids that a sentence cannot be taken apart for."""


@pytest.mark.parametrize("name", ODD)
def test_the_goal_that_set_the_robot_in_motion_and_why_it_ended_are_told_in_fields(rig: Rig, name: str) -> None:
    rig.enable()
    begins = rig.control.cycles
    rig.goal(name, 0.01, 0.0, 0.0, speed=0.5)
    rig.command(Command.STOP)
    events = [notice.event(n, 0.0, begins, 0.0) for n, notice in enumerate(rig.notices, 1)]
    lines = [Line(0.0, np.datetime64(0, "ns"), "INFO", event.message, event) for event in events]
    recording = Recording("demo", records(0.2), np.zeros(0), np.zeros(0, "datetime64[ns]"), lines, {})
    assert _beginnings(recording) == [(name, begins)]
    (ended,) = (summed for summed in _goals(recording, 1e-3) if summed.id == name)
    assert (ended.outcome, ended.message) == ("stopped", "stop by ann")
    heard = _Heard(cast("Robot", None))
    for event in events:
        heard._on_event(event)
    assert heard.began == {name: begins}


def test_none_goes_before_the_goals_that_had_ended() -> None:
    rows = records(0.2)
    stop: Request = CommandRequest(3, "ann", Command.STOP)
    recording = Recording(
        name="demo",
        records=rows,
        t=rows["cycle"] * 1e-3,
        wall=np.zeros(len(rows), "datetime64[ns]"),
        events=[ended(50, "first", "done"), ended(90, "second", "stopped")],
        texts={},
        requests=(goal(1, 10, "first"), goal(2, 60, "second"), ControlInput(3, 70, 0, stop), goal(4, 100, "third")),
    )
    robot = Heard()
    renamed, goals = _send(recording, cast("Robot", robot), lambda _: None)
    told = [line for n, line in enumerate(robot.log) if line not in robot.log[:n]]
    assert told == ["send first", "end first", "send second", "stop", "end second", "send third"]
    assert renamed.keys() == goals.keys() == {"first", "second", "third"}
