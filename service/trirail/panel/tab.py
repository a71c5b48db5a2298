"""One open tab of the operator's page: what it says is done, what there is to show it is sent."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from trirail.client.client import Robot
from trirail.client.held_jog import HeldJog
from trirail.client.lease import Lease
from trirail.errors import TrirailError
from trirail.panel.feed import Feed, now
from trirail.panel.messages import (
    CheckPose,
    Forget,
    FromPage,
    GoTo,
    GoToPose,
    Hold,
    JogStep,
    Release,
    Seen,
    SetOverride,
    Teach,
    Tell,
)
from trirail.panel.path_check import PathCheck
from trirail.wire.decoding import decoded, prepare
from trirail.wire.vocabulary import Command

AHEAD = 3
"""So many states may be on their way to the page: a frozen tab, or a slow network, is sent no more, and none waits."""
FRESH = 500
"""A jog from a page whose newest state is older than that is none: it, or what leads to it, stands still [ms]."""

UNDER_WAY = 8
"""So many commands of a tab may wait for their answers, and as many that stop the robot."""
UNSENT = 200
"""So many answers are kept for a tab that reads none; the eldest go."""

prepare(FromPage)


class Tab:
    """Serves one WebSocket until it is closed; then whatever it held has been let go.

    Each command has a thread of its own, so that STOP waits for nothing. Whether the robot moves is decided by the
    service alone: what stands still or is lost here, and on the way here, renews no jog.
    """

    def __init__(self, socket: ServerConnection, robot: Robot, feed: Feed) -> None:
        self._socket = socket
        self._robot = robot
        self._feed = feed
        self._jog = HeldJog(robot.send, lambda why: self._say("ended", message=why))
        self._outbox: deque[bytes] = deque(maxlen=UNSENT)
        self._unseen: deque[int] = deque()
        self._under_way: set[Command] = set()
        self._stops, self._others = (threading.BoundedSemaphore(UNDER_WAY) for _ in range(2))
        self._checks = PathCheck(feed.problem, lambda number, why: self._say("checked", number=number, why=why))
        self._lease: Lease | None = None
        self._open = True

    def serve(self) -> None:
        """Do what the page says until it is gone."""
        sender = threading.Thread(target=self._send, name="tab", daemon=True)
        sender.start()
        try:
            with contextlib.suppress(ConnectionClosed):  # a tab that is killed, or says too much, is gone like another
                for text in self._socket:
                    self._take(text)
        finally:
            self._jog.close()
            self._checks.close()
            with self._feed.changed:
                self._open = False
                self._feed.changed.notify_all()
            self._give_back()

    def _take(self, text: str | bytes) -> None:
        try:
            said: FromPage = decoded(text, FromPage)
        except msgspec.MsgspecError as error:
            self._say("refused", to="page", message=f"not a message of this page: {error}")
            return
        match said:
            case Seen(stamp):
                with self._feed.changed:
                    while self._unseen and self._unseen[0] <= stamp:
                        self._unseen.popleft()
                    self._feed.changed.notify_all()
            case Hold(velocity, seen):
                if now() - seen <= FRESH:
                    self._jog.hold(velocity)
            case Release():
                self._jog.release()
            case Tell(name):
                self._tell(name)
            case CheckPose(pose, number):
                self._checks.ask(pose, number)
            case _:
                self._ask(said)

    # ------------------------------------------------------------------ doing

    def _ask(self, said: SetOverride | GoTo | GoToPose | JogStep | Teach | Forget) -> None:
        """Ask the service for what is answered there, and is under way beside all else."""
        robot = self._robot
        match said:
            case SetOverride(percent):
                self._begin(lambda: robot.override(percent), Command.OVERRIDE)
            case GoTo(name):
                self._begin(lambda: robot.move_to_named(name), f"go to {name}", "accepted")
            case GoToPose(pose):
                self._begin(lambda: robot.move_to(*pose), "go there", "accepted")
            case JogStep(by, seen):
                if now() - seen <= FRESH:
                    self._begin(lambda: robot.move(*by), "step", "accepted")
            case Teach(name):
                self._begin(lambda: robot.teach(name), f"teach {name}")
            case Forget(name):
                self._begin(lambda: robot.forget(name), f"forget {name}")

    def _tell(self, name: Command) -> None:
        """Send a command, unless it is under way already; what stops the robot waits for no other."""
        if name.stops:
            self._jog.release()
        elif name in self._under_way:
            return
        self._under_way.add(name)

        def tell() -> None:
            try:
                if name is Command.ACQUIRE:
                    self._acquire()
                elif name is Command.RELEASE and self._lease is not None:
                    self._give_back()
                else:
                    self._robot.command(name)
            finally:
                self._under_way.discard(name)

        if not self._begin(tell, name):
            self._under_way.discard(name)

    def _acquire(self) -> None:
        """Hold the lease for as long as this tab is open: with it go its signs of life."""
        if self._lease is None or self._lease.lost is not None:
            lease = self._robot.lease()
            lease.__enter__()
            self._lease = lease
        if not self._open:
            self._give_back()

    def _give_back(self) -> None:
        lease, self._lease = self._lease, None
        if lease is not None:
            lease.__exit__()

    def _begin(self, do: Callable[[], object], what: str, then: str = "done") -> bool:
        """Have it done beside what is under way, and answered; return whether there is a place for it."""
        places = self._stops if isinstance(what, Command) and what.stops else self._others
        if not places.acquire(blocking=False):
            self._say("refused", to=what, message=f"{UNDER_WAY} commands of this page wait for their answers already")
            return False

        def run() -> None:
            try:
                do()
            except TrirailError as error:
                self._say("refused", to=what, message=str(error))
            else:
                self._say(then, to=what)
            finally:
                places.release()

        threading.Thread(target=run, name=what, daemon=True).start()
        return True

    # ------------------------------------------------------------------ showing

    def _say(self, tell: str, **content: str | int) -> None:
        with self._feed.changed:
            self._outbox.append(msgspec.json.encode({"tell": tell, **content}))
            self._feed.changed.notify_all()

    def _send(self) -> None:
        """Send what there is, each thing once, states only as fast as the page draws them."""
        robot, poses, event, stamp, silent = b"", b"", 0, 0, False
        feed = self._feed
        while True:
            due: list[bytes] = []
            with feed.changed:
                if feed.robot is not robot:
                    due.append(robot := feed.robot)
                if feed.poses != poses:
                    due.append(poses := feed.poses)
                for number, content in feed.events(event):
                    event = number
                    due.append(content)
                due += self._outbox
                self._outbox.clear()
                if feed.state is None:
                    if not silent:
                        due.append(b'{"tell":"silent"}')
                    silent = True
                elif feed.stamp != stamp and len(self._unseen) < AHEAD:
                    stamp, silent = feed.stamp, False
                    self._unseen.append(stamp)
                    due.append(feed.state)
                if not self._open:
                    return
                if not due:
                    feed.changed.wait()
            try:
                for content in due:
                    self._socket.send(content, text=True)
            except ConnectionClosed:
                return
