"""What a tab asks of the service: each command in a thread of its own, so that STOP waits for nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

from trirail.client import trajectory
from trirail.client.client import GoalHandle, Robot
from trirail.client.lease import Lease
from trirail.errors import TrirailError
from trirail.panel.feed import now
from trirail.panel.messages import (
    Asked,
    Follow,
    Forget,
    GoTo,
    GoToPose,
    JogStep,
    SetOverride,
    TakeOver,
    Teach,
)
from trirail.wire.vocabulary import Command

FRESH = 500
"""A jog from a page whose newest state is older than that is none: it, or what leads to it, stands still [ms]."""
UNDER_WAY = 8
"""So many commands of a tab may wait for their answers, and as many that stop the robot."""


class Say(Protocol):
    """Tells the page something; what it is about is a word of the page's languages, `name` what has one."""

    def __call__(self, tell: str, /, **content: Any) -> None:
        """Send it."""


class Orders:
    """Those of one tab, answered by `say`; and the lease, while the tab holds it."""

    def __init__(self, robot: Robot, say: Say) -> None:
        self._robot = robot
        self._say = say
        self._under_way: set[Command] = set()
        self._stops, self._others = (threading.BoundedSemaphore(UNDER_WAY) for _ in range(2))
        self._lease: Lease | None = None
        self._open = True

    def close(self) -> None:
        """Give the lease back, whoever still acquires it."""
        self._open = False
        self._give_back()

    def request(self, said: Asked) -> None:
        """Ask the service for what is answered there, and is under way beside all else."""
        robot = self._robot
        match said:
            case TakeOver():
                self._begin(lambda: self._acquire(force=True), "takeover")
            case SetOverride(percent):
                self._begin(lambda: robot.override(percent), Command.OVERRIDE)
            case GoTo(name):
                self._begin(lambda: robot.move_to_named(name), "goto", name)
            case GoToPose((x, y, phi), tool, frame):
                self._begin(lambda: robot.move_to(x, y, phi, tool=tool, frame=frame), "pose")
            case JogStep((x, y, phi), seen, tool, frame):
                if now() - seen <= FRESH:
                    self._begin(lambda: robot.move(x, y, phi, tool=tool, frame=frame), "step")
            case Follow(name, text, stretch):
                self._begin(lambda: robot.follow(trajectory.parse(name, text), stretch=stretch), "follow", name)
            case Teach(name):
                self._begin(lambda: robot.teach(name), "teach", name)
            case Forget(name):
                self._begin(lambda: robot.forget(name), "forget", name)

    def command(self, name: Command) -> None:
        """Send a command, unless it is under way already; what stops the robot waits for no other."""
        if name in self._under_way and not name.stops:
            return
        self._under_way.add(name)

        def send_command() -> None:
            try:
                if name is Command.ACQUIRE:
                    self._acquire()
                elif name is Command.RELEASE and self._lease is not None:
                    self._give_back()
                else:
                    self._robot.command(name)
            finally:
                self._under_way.discard(name)

        if not self._begin(send_command, name):
            self._under_way.discard(name)

    def _acquire(self, *, force: bool = False) -> None:
        """Hold the lease for as long as this tab is open: with it go its signs of life."""
        if self._lease is None or self._lease.lost is not None:
            lease = self._robot.lease(force=force)
            lease.__enter__()
            self._lease = lease
        if not self._open:
            self._give_back()

    def _give_back(self) -> None:
        lease, self._lease = self._lease, None
        if lease is not None:
            lease.__exit__()

    def _begin(self, do: Callable[[], object], what: str, name: str = "") -> bool:
        """Have it done beside what is under way, and answered; return whether there is a place for it."""
        places = self._stops if isinstance(what, Command) and what.stops else self._others
        if not places.acquire(blocking=False):
            message = f"{UNDER_WAY} commands of this page wait for their answers already"
            self._say("refused", to=what, name=name, message=message)
            return False

        def run() -> None:
            try:
                done = do()
            except TrirailError as error:
                self._say("refused", to=what, name=name, message=str(error))
            else:
                if isinstance(done, GoalHandle):
                    self._say("accepted", to=what, name=name, id=done.id)
                else:
                    self._say("done", to=what, name=name)
            finally:
                places.release()

        threading.Thread(target=run, name=what, daemon=True).start()
        return True
