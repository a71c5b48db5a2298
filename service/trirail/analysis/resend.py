"""A recorded session's goals and commands, sent once more to a running service; its setpoints beside the recorded ones.

Requests go out with the spacing that they had. Every motion that began at rest is compared from its first cycle on, as
the events of both sessions name it; how goals that interrupt each other come out depends on the moment, to a cycle.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import Triple

from trirail.client.client import GoalHandle, Robot
from trirail.errors import RefusedError, ServiceError
from trirail.telemetry.reading import Recording
from trirail.wire.messages import Event
from trirail.wire.packets import CommandRequest, GoalRequest
from trirail.wire.records import unpack
from trirail.wire.vocabulary import MODES, Command, CommandContent, Mode, Stop

NEAR = 1e-3
"""How far the sliders may stand from where the session began [m]."""
END_WITHIN = 60.0
"""How long the last goals may take to end [s]."""
HEARD_WITHIN = 2.0
"""How much later than a goal's end its last records may come [s]."""
_LEASE = (Command.ACQUIRE, Command.RELEASE)
"""Not sent again: what was allowed then was so by whoever held the lease; all is one user's now."""
_MOVING = MODES.index(Mode.MOVING)


class ComparedMotion(NamedTuple):
    """One motion, as recorded and as it was now."""

    id: str
    """The goal that it began with."""
    outcome: str
    """How that ended now; "refused" where it was not taken, "unknown" where that was not heard."""
    cycles: int
    """So many were compared."""
    lacking: int
    """By so many cycles one of the two was longer."""
    position: Triple
    """Greatest difference of a setpoint, of each slider [m]."""


def resend(recording: Recording, robot: Robot, say: Callable[[str], None]) -> list[ComparedMotion]:
    """Send a session again and compare. Raises ServiceError where the robot does not stand where it began."""
    _check_start(recording, robot)
    heard = _Heard(robot)
    lease = robot.lease() if robot.info().lease == "required" else contextlib.nullcontext()
    with heard.listening(), lease:
        renamed, goals = _send(recording, robot, say)
        _await(goals.values())
        time.sleep(HEARD_WITHIN)
    now = heard.records()
    return [
        _compared(
            name, goals.get(name), _motion(recording.records, began), _motion(now, heard.began.get(renamed[name]))
        )
        for name, began in _beginnings(recording)
        if name in renamed
    ]


class _Heard:
    """What a service publishes meanwhile: its records, and the cycles in which motions began."""

    def __init__(self, robot: Robot) -> None:
        self.began: dict[str, int] = {}
        self._robot = robot
        self._batches: list[bytes] = []
        self._over = threading.Event()

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Listen as long as the context lasts."""
        thread = threading.Thread(target=self._listen, name="events", daemon=True)
        thread.start()
        with self._robot.records(self._batches.append):
            yield
        self._over.set()
        thread.join()

    def records(self) -> NDArray[np.void]:
        """Return the records so far."""
        return unpack(b"".join(self._batches))

    def _listen(self) -> None:
        while not self._over.is_set():
            for event in self._robot.events(history=True, timeout=0.5):  # nothing is missed between two of them
                self._on_event(event)
                if self._over.is_set():
                    return

    def _on_event(self, event: Event) -> None:
        if event.goal is not None:
            self.began[event.goal] = event.cycle


def _check_start(recording: Recording, robot: Robot) -> None:
    first, stands = recording.records[0], np.array(robot.state().sliders.position)
    stood = first["position"] - first["backlash"]
    if np.abs(stood - stands).max() > NEAR:
        began, now = (", ".join(f"{value * 1e3:.1f}" for value in place) for place in (stood, stands))
        raise ServiceError(f"the session began with the sliders at {began} mm, they are at {now} mm: go there first")


def _send(
    recording: Recording, robot: Robot, say: Callable[[str], None]
) -> tuple[dict[str, str], dict[str, GoalHandle]]:
    """Send the requests in their time; return the goals' new names, and those that were taken.

    None goes before the goals have ended that had ended before it: a service that misses ticks takes longer for them.
    """
    cycles, t = recording.records["cycle"], recording.t
    period = float(t[-1] - t[0]) / float(cycles[-1] - cycles[0])
    suffix, begins = uuid.uuid4().hex[:6], time.monotonic()
    renamed: dict[str, str] = {}
    goals: dict[str, GoalHandle] = {}
    said = [line.event for line in recording.events if line.event is not None and line.event.outcome]
    ends = {event.id: event.cycle for event in said}
    first = recording.requests[0].cycle if recording.requests else 0
    for what in recording.requests:
        since = (what.cycle - first) * period
        time.sleep(max(0.0, begins + since - time.monotonic()))
        _await([goal for name, goal in goals.items() if ends.get(name, math.inf) <= what.cycle])
        begins = max(begins, time.monotonic() - since)
        given = what.given
        try:
            if isinstance(given, GoalRequest):
                renamed[given.id] = f"{given.id[:50]}-{suffix}"
                goal = msgspec.structs.replace(given.goal, id=renamed[given.id])
                if goal.time is not None:  # as old as it was then
                    goal = goal.at(time.time() - given.age)
                goals[given.id] = robot.send(goal)
                say(f"goal {given.id}: {goals[given.id].expected}")
            elif isinstance(given, CommandRequest) and given.name not in _LEASE:
                robot.command(given.name, _content(given, renamed))
                say(given.name)
        except RefusedError as error:
            say(f"refused: {error}")
    return renamed, goals


def _content(request: CommandRequest, renamed: dict[str, str]) -> CommandContent:
    content: CommandContent = request.content
    if isinstance(content, Stop) and content.goal is not None:
        return Stop(renamed.get(content.goal, content.goal))
    return content


def _await(goals: Iterable[GoalHandle]) -> None:
    """Wait for goals to end, but not for ever."""
    deadline = time.monotonic() + END_WITHIN
    for goal in goals:
        with contextlib.suppress(TimeoutError):
            goal.wait(max(0.0, deadline - time.monotonic()))


def _beginnings(recording: Recording) -> list[tuple[str, int]]:
    """Return the goals with which motions began, each with its cycle."""
    said = (line.event for line in recording.events if line.event is not None)
    return [(event.goal, event.cycle) for event in said if event.goal is not None]


def _motion(records: NDArray[np.void], began: int | None) -> NDArray[np.float64]:
    """Return the setpoints of a motion that began in a cycle, (N, 3): to the end of its path, without a gap."""
    if began is None or not len(records):
        return np.zeros((0, 3))
    rows = records[int(np.searchsorted(records["cycle"], began)) :]
    whole = (rows["mode"] == _MOVING) & (rows["progress"] < 1.0) & (rows["cycle"] == began + np.arange(len(rows)))
    length = int(np.argmin(np.append(whole, False)))
    setpoints: NDArray[np.float64] = rows["commanded_position"][:length]
    return setpoints


def _compared(
    name: str, goal: GoalHandle | None, then: NDArray[np.float64], now: NDArray[np.float64]
) -> ComparedMotion:
    length = min(len(then), len(now))
    a, b, c = np.abs(then[:length] - now[:length]).max(axis=0, initial=0.0).tolist()
    outcome = "refused" if goal is None else goal.result.outcome if goal.result else "unknown"
    return ComparedMotion(name, outcome, length, abs(len(then) - len(now)), (a, b, c))
