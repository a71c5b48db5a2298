"""A client of the service: goals, commands and states over Zenoh.

with Robot("demo") as robot:
    robot.enable()
    result = robot.move_to(x=0.02, y=-0.01, phi=0.1).wait(timeout=10)
"""

from __future__ import annotations

import contextlib
import getpass
import queue
import re
import threading
import uuid
import weakref
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import NamedTuple, Self, TypeVar

import msgspec
import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from trirail.client.listener import Listener
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import (
    CommandReply,
    ErrorReply,
    Event,
    GoalReply,
    Info,
    Override,
    OwnLimits,
    PoseGoal,
    SlidersGoal,
    State,
    Stop,
    TrajectoryGoal,
    TrajectoryPoint,
    VelocityGoal,
)
from trirail.wire.messages import Goal as _Message
from trirail.wire.sizes import MAX_NAME
from trirail.wire.text import quoted
from trirail.wire.vocabulary import Command

REPLY_WITHIN = 20.0
"""How long a command may take to be carried out [s]."""
HOME_WITHIN = 600.0
"""How long homing may take [s]: three drives of the greatest time-out there is."""

T = TypeVar("T", bound=msgspec.Struct)


class Result(NamedTuple):
    """How a goal ended; every goal does, exactly once."""

    id: str
    outcome: str
    """done, rejected, preempted, stopped, expired or faulted."""
    message: str
    """One line for people: why."""


class Goal:
    """A goal that the service has accepted. It is the service's from then on: this object only follows it."""

    def __init__(self, goal_id: str, robot: Robot) -> None:
        self.id = goal_id
        self.reply = GoalReply(goal_id, 0.0)
        """What the service said of it."""
        self._robot = robot
        self._ended = threading.Event()
        self._result: Result | None = None

    @property
    def result(self) -> Result | None:
        """How it ended, None while it has not."""
        return self._result

    @property
    def duration(self) -> float | None:
        """Expected time from acceptance to arrival [s]; None while the override is zero."""
        return self.reply.duration

    @property
    def expected(self) -> str:
        """How long it is expected to take, for people."""
        return f"{self.duration:.2f} s" if self.duration is not None else "no expected end while the override is 0"

    def cancel(self) -> None:
        """Stop it, if it is under way or waits for another one; return when the robot stands, or it waits no more.

        Other goals go on, but those that wait for this one. Raises RefusedError (`no_goal`) if it has ended,
        ServiceError if nobody answers.
        """
        self._robot.command(Command.STOP, msgspec.json.encode(Stop(self.id)))

    def wait(self, timeout: float | None = None) -> Result:
        """Wait for its end, however it ends; look at `outcome` of the result.

        Raises TimeoutError if that takes longer than `timeout` seconds; the goal itself goes on.
        """
        if not self._ended.wait(timeout) or self._result is None:
            raise TimeoutError(f"goal {self.id} has not ended within {timeout:g} s")
        return self._result

    def _end(self, result: Result) -> None:
        self._result = result
        self._ended.set()


class Jog:
    """A velocity that is kept alive while the context lasts; `result` tells afterwards how it ended.

    It is renewed three times in each time-out, by a thread of its own. A program that hangs or dies renews it no more,
    and the robot brakes: the time-out is real time, at every override. What has run out or was paused is over; begin
    a new one. `error` tells whether it could not be renewed. Leaving the context waits for the standstill.
    """

    def __init__(self, robot: Robot, velocity: tuple[float, float, float], timeout: float) -> None:
        self._robot = robot
        self._velocity = velocity
        self._timeout = timeout
        self._id = uuid.uuid4().hex[:12]
        self._over = threading.Event()
        self._renewing = threading.Thread(target=self._renew, name="jog", daemon=True)
        self._goal: Goal | None = None
        self.error: Exception | None = None
        """Why it could not be renewed any more."""

    @property
    def result(self) -> Result | None:
        """How it ended, None while it has not."""
        return self._goal.result if self._goal else None

    def __enter__(self) -> Self:
        self._goal = self._send()
        self._renewing.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._renewing.join()
        if self._goal is not None and self.error is None:
            self._goal.wait(self._timeout + 10.0)

    def _send(self) -> Goal:
        x, y, phi = self._velocity
        return self._robot.send(lambda name: VelocityGoal(x, y, phi, timeout=self._timeout, id=name), self._id)

    def _renew(self) -> None:
        while not self._over.wait(self._timeout / 3.0):
            try:
                self._send()
            except TrirailError as error:
                if not (
                    isinstance(error, RefusedError) and error.code is RefusalCode.AT_LIMIT
                ):  # that is how it should end
                    self.error = error
                return


class Robot:
    """A connection to one robot's service; several threads may share it.

    `name` is that of the robot's configuration, `connect` the Zenoh locator of its service or of a router, `user` who
    is told to have sent goals and commands (the login name if absent). Poses are x, y [m] of the platform's centre in
    the base frame and its angle phi [rad], counterclockwise. Any call raises ServiceError where nobody answers and
    RefusedError, with code, slider, value and limit, where the service says no; nothing moves because of that call.
    """

    def __init__(
        self, name: str = "demo", connect: str = zenoh_session.DEFAULT_LOCATOR, user: str | None = None
    ) -> None:
        self.name = boundary.check_name(name, "robot")
        self.user = boundary.check_name(user or _user(), "user")
        self._connect = connect
        self._session = zenoh_session.open_client(connect)
        # Also at the end of a program that does not close it: Zenoh's threads must not outlive the interpreter.
        self._close = weakref.finalize(self, zenoh_session.close, self._session)
        self._listener = Listener()
        self._goals: dict[str, Goal] = {}
        self._goals_lock = threading.Lock()
        self._results = declare_advanced_subscriber(
            self._session,
            self._key("event"),
            self._listener.messages(Event, self._on_event),
            history=HistoryConfig(detect_late_publishers=True),  # of a gateway that was started again
            recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; goals under way go on."""
        self._close()

    @property
    def skipped(self) -> int:
        """How often something was published on this robot's keys that was none of its messages."""
        return self._listener.skipped

    # ------------------------------------------------------------------ goals and commands

    def move_to(
        self,
        *,
        x: float,
        y: float,
        phi: float,
        speed: float = 1.0,
        limits: OwnLimits | None = None,
        blend: float | None = None,
        valid_for: float | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> Goal:
        """Send a pose goal, x, y [m] and phi [rad] in the base frame; return once it is accepted.

        The platform goes straight in pose space where its start allows. `speed` is a fraction of full speed, (0, 1]:
        0.5 takes twice as long over the same path. With `blend` [m] the next pose goal waits for this one, and begins
        when no point of the platform is farther than that from where it is to be; without it, the next goal preempts
        this one. `limits` are lower ones than the platform's. A goal that has not begun within `valid_for` [s] expires.
        Its `id` must be new; one is made if absent. Raises RefusedError: out of reach, not enabled, stopping, ….
        """
        return self.send(
            lambda name: PoseGoal(
                x=x, y=y, phi=phi, id=name, speed=speed, valid_for=valid_for, limits=limits, blend=blend
            ),
            id,
        )

    def move_sliders(
        self,
        a: float,
        b: float,
        c: float,
        *,
        speed: float = 1.0,
        valid_for: float | None = None,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> Goal:
        """Send a goal for the sliders A, B, C, their lambda_10 [m]; return once it is accepted.

        Straight in slider space where the start allows; also the way out of a pose that move_to refuses. `speed`,
        `valid_for` and `id` as of move_to.
        """
        return self.send(lambda name: SlidersGoal((a, b, c), speed=speed, valid_for=valid_for, id=name), id)

    def follow(
        self,
        points: Sequence[TrajectoryPoint],
        *,
        stretch: bool = False,
        id: str | None = None,  # noqa: A002 - the field's name on the wire
    ) -> Goal:
        """Send a timed trajectory that begins where the robot stands; return once it is accepted.

        A point is t [s], x, y [m] and phi [rad], and where it is known, velocity and acceleration of the three.
        Quintic between the points; where they have no velocity it is that between their neighbours, zero at the ends.
        One that is too fast for a slider is refused, or slowed as a whole with `stretch`.
        """
        return self.send(lambda name: TrajectoryGoal(tuple(points), stretch=stretch, id=name), id)

    def jog(self, *, x: float = 0.0, y: float = 0.0, phi: float = 0.0, timeout: float = 0.2) -> Jog:
        """Move the platform at a velocity [m/s, rad/s] while the context lasts, renewed before each `timeout` [s].

        with robot.jog(x=0.01):
            wait_for_the_key_to_be_released()
        """
        return Jog(self, (x, y, phi), timeout)

    def send(self, make: Callable[[str], _Message], id: str | None = None) -> Goal:  # noqa: A002
        """Send the goal that `make` makes for an id, any of trirail.wire.messages.Goal; return once it is accepted."""
        goal_id = id or uuid.uuid4().hex[:12]
        try:
            message = make(goal_id)
        except ValueError as error:
            raise RefusedError(RefusalCode.MALFORMED, f"not a goal: {error}") from error
        goal = Goal(goal_id, self)
        with self._goals_lock:
            goal = self._goals.setdefault(goal_id, goal)
        try:
            reply = self._ask(self._key("goal", self.user), GoalReply, msgspec.json.encode(message))
        except (RefusedError, ServiceError):
            with self._goals_lock:
                self._goals.pop(goal_id, None)
            raise
        goal.reply = reply
        return goal

    def enable(self) -> None:
        """Power the drives up; return when the robot holds where it stands. Confirmed at once if it does already."""
        self.command(Command.ENABLE)

    def disable(self) -> None:
        """Stop, then take power off; return when the drives have none."""
        self.command(Command.DISABLE)

    def stop(self) -> None:
        """Stop on the path within the limits' jerk; return when the robot stands. No goal is taken until then."""
        self.command(Command.STOP)

    def quick_stop(self) -> None:
        """Stop every drive by its own ramp, as fast as it can; the robot is in fault until reset, without power."""
        self.command(Command.QUICK_STOP)

    def reset(self) -> None:
        """Clear a fault whose cause is gone; the robot is disabled afterwards. RefusedError while the cause lasts."""
        self.command(Command.RESET)

    def home(self) -> None:
        """Home the drives whose positions are not absolute; return when all are and the robot holds."""
        self.command(Command.HOME)

    def pause(self) -> None:
        """Stop on the path; return when the robot stands. The goal is kept for resume, a jog is not."""
        self.command(Command.PAUSE)

    def resume(self) -> None:
        """Go on with a paused goal."""
        self.command(Command.RESUME)

    def override(self, percent: float) -> None:
        """Let this motion and those to come run at a share of full speed, 0 or 1 to 200 %, within the limits."""
        try:
            content = Override(percent)
        except ValueError as error:
            raise RefusedError(RefusalCode.MALFORMED, f"no override: {error}") from error
        self.command(Command.OVERRIDE, msgspec.json.encode(content))

    def command(self, name: str, content: bytes | None = None) -> CommandReply:
        """Send a command by its name on the wire; return once the service confirms that it has been carried out.

        `content` is its JSON, where it has any: Override or Stop of trirail.wire.messages.
        """
        within = HOME_WITHIN if name == Command.HOME else REPLY_WITHIN
        return self._ask(self._key("cmd", self.user, name), CommandReply, content, within)

    def info(self) -> Info:
        """Ask for geometry, limits, rates and versions."""
        return self._ask(self._key("info"), Info)

    # ------------------------------------------------------------------ what the service tells

    def state(self, timeout: float = 2.0) -> State:
        """Return the next state that is published. Raises ServiceError if none comes within `timeout` seconds.

        `pose` is measured, from the measured sliders; `commanded` is what the drives were told. SI units and radians.
        """
        for state in self.states(timeout):
            return state
        raise ServiceError(self._nobody())

    def states(self, timeout: float | None = None) -> Iterator[State]:
        """Yield states as they come, the newest where this is too slow; end after `timeout` seconds without one."""
        received: queue.Queue[State] = queue.Queue(maxsize=1)

        def keep_newest(state: State) -> None:
            with contextlib.suppress(queue.Empty):
                received.get_nowait()
            with contextlib.suppress(queue.Full):
                received.put_nowait(state)

        with self._session.declare_subscriber(self._key("state"), self._listener.messages(State, keep_newest)):
            yield from _until_silent(received, timeout)

    def events(self, history: bool = False, timeout: float | None = None) -> Iterator[Event]:
        """Yield events in order, each once, with `history` the past first; end after `timeout` seconds without one."""
        received: queue.Queue[Event] = queue.Queue()
        last = 0, 0.0

        def keep_new(event: Event) -> None:
            # A gateway that was started again tells the past once more; a service that was, counts from one.
            nonlocal last
            if event.seq > last[0] or event.time > last[1]:
                last = event.seq, event.time
                received.put(event)

        with declare_advanced_subscriber(
            self._session,
            self._key("event"),
            self._listener.messages(Event, keep_new),
            history=HistoryConfig(detect_late_publishers=True) if history else None,
            recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
        ):
            yield from _until_silent(received, timeout)

    def records(self, take: Callable[[bytes], None]) -> zenoh.Subscriber[None]:
        """Have every batch of records taken as it comes, until the context ends; wire.records.unpack reads them.

        `take` is called by the connection's own thread: it must be quick.
        """
        return self._session.declare_subscriber(self._key("records"), self._listener.batches(take))

    # ------------------------------------------------------------------ inside

    def _key(self, *parts: str) -> str:
        return zenoh_session.key(self.name, *parts)

    def _on_event(self, event: Event) -> None:
        if event.id is None or event.outcome is None:
            return
        with self._goals_lock:
            goal = self._goals.pop(event.id, None)
        if goal is not None:
            goal._end(Result(event.id, event.outcome, event.message))

    def _ask(self, key: str, kind: type[T], payload: bytes | None = None, within: float = REPLY_WITHIN) -> T:
        """Query and decode the first reply that can be read. None at all means that nobody is there, or may be asked.

        A reply has the quality of service of its query: one that may be dropped would have an answer that may be.
        """
        boundary.check_size(len(payload or b""))
        unreadable: ServiceError | None = None
        for reply in self._session.get(
            key,
            payload=payload,
            encoding=boundary.JSON if payload else None,
            timeout=within,
            consolidation=zenoh.ConsolidationMode.NONE,  # at once, however many more were asked
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        ):
            try:
                if reply.ok is not None:
                    answer: T = boundary.decode(reply.ok.payload.to_bytes(), kind, "it cannot be read")
                    return answer
            except RefusedError as error:
                unreadable = ServiceError(f"somebody answered at {self._connect}, but {error}")
            if reply.err is not None:
                refusal = _refusal(reply.err.payload.to_bytes())
                if isinstance(refusal, RefusedError):
                    raise refusal
                unreadable = refusal
        raise unreadable or ServiceError(self._nobody())

    def _nobody(self) -> str:
        return (
            f"no robot {self.name!r} answers at {self._connect}: is its service running, is the name right "
            "(--robot), may this user ask it?"
        )


def _until_silent(received: queue.Queue[T], timeout: float | None) -> Iterator[T]:
    """Yield what is received, until nothing is for `timeout` seconds: only what is to be yielded may be put there."""
    while True:
        try:
            yield received.get(timeout=timeout)
        except queue.Empty:
            return


def _refusal(payload: bytes) -> RefusedError | ServiceError:
    try:
        error: ErrorReply = boundary.decode(payload, ErrorReply, "not an error reply")
    except RefusedError:
        return ServiceError(f"no answer from the service: {quoted(payload.decode(errors='replace'))}")
    return RefusedError(error.code, error.message, slider=error.slider, value=error.value, limit=error.limit)


def _user() -> str:
    try:
        name = getpass.getuser()
    except (KeyError, OSError):
        return "anonymous"
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)[:MAX_NAME] or "anonymous"
