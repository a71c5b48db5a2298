"""An open tab of the operator's page: execution of its requests, and transmission of the data to show."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import GoalHandle, LoopThread
from trirail.client.held_jog import HeldJog
from trirail.errors import RefusalCode
from trirail.panel.feed import Feed, now
from trirail.panel.messages import CheckPath, CheckPose, FromPage, Hold, Release, Seen, Tell
from trirail.panel.orders import FRESH, Orders, refusal
from trirail.wire.decoding import decoded, prepare
from trirail.wire.goals import Goal


class NewestAsked:
    """Worker that runs only the newest submitted task; `name` is the name of its thread."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._asked: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, do: Callable[[], None]) -> None:
        """Submit a task, which replaces one that is still waiting."""
        with self._changed:
            self._asked = do
            self._changed.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop the worker."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._asked is not None)
                do, self._asked = self._asked, None
                if self._closed or do is None:
                    return
            do()


AHEAD = 3
"""Maximum number of states in transit to the page: a frozen tab or slow network gets no more, and none queues up."""
UNSENT = 200
"""Maximum number of answers kept for a tab that does not read; the oldest are dropped."""

prepare(FromPage)


class Tab:
    """Handler of one WebSocket until it is closed; then everything it held has been released.

    The service alone decides whether the robot moves: a message that is stalled or lost here, or on the way here,
    does not renew a jog.
    """

    def __init__(self, socket: ServerConnection, robot: AsyncRobot, loop: LoopThread, feed: Feed) -> None:
        self._socket = socket
        self._feed = feed
        self._robot = robot
        self._loop = loop
        self._jog = HeldJog(self._send_goal, self._on_jog_ended)
        self._outbox: deque[bytes] = deque(maxlen=UNSENT)
        self._unseen: deque[int] = deque()
        self._orders = Orders(robot, loop, self._say)
        self._poses, self._paths = NewestAsked("pose check"), NewestAsked("path check")
        self._open = True

    def serve(self) -> None:
        """Execute the page's messages until it is gone."""
        sender = threading.Thread(target=self._send, name="tab", daemon=True)
        sender.start()
        try:
            with contextlib.suppress(ConnectionClosed):  # a tab that was killed, or sent too much, counts as closed
                for text in self._socket:
                    self._on_message(text)
        finally:
            self._jog.close()
            self._poses.close()
            self._paths.close()
            with self._feed.changed:
                self._open = False
                self._feed.changed.notify_all()
            self._orders.close()

    def _on_message(self, text: str | bytes) -> None:
        try:
            said: FromPage = decoded(text, FromPage)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            self._say("refused", to="page", message=f"not a message of this page: {error}", code=RefusalCode.MALFORMED)
            return
        if said.needs is not None and said.needs not in self._feed.permissions:
            message = f"your role does not allow {said.needs}"
            self._say("refused", to=said.needs, message=message, code=RefusalCode.NOT_ALLOWED)
            return
        match said:
            case Seen(stamp):
                with self._feed.changed:
                    while self._unseen and self._unseen[0] <= stamp:
                        self._unseen.popleft()
                    self._feed.changed.notify_all()
            case Hold(velocity, seen, tool):
                if now() - seen <= FRESH:
                    self._jog.hold(velocity, tool)
            case Release():
                self._jog.release()
            case CheckPose():
                self._poses.submit(lambda: self._check_pose(said))
            case CheckPath():
                self._paths.submit(lambda: self._check_path(said))
            case _:
                if isinstance(said, Tell) and said.name.stops:
                    self._jog.release()
                self._orders.begin(said)

    def _send_goal(self, make: Callable[[str], Goal], goal_id: str) -> GoalHandle:
        goal = self._loop.call(self._robot.send(make, goal_id))
        return GoalHandle(goal, self._loop, lambda name, content: self._loop.call(self._robot.command(name, content)))

    def _on_jog_ended(self, why: str) -> None:
        error = self._jog.error
        self._say("ended", **(refusal(error) if error is not None else {}) | {"message": why})

    def _check_pose(self, said: CheckPose) -> None:
        self._say("checked", number=said.number, obstacle=self._feed.problem(said.goal))

    def _check_path(self, said: CheckPath) -> None:
        found = self._feed.checked_path(said.name, said.text, said.stretch)
        self._say("path", number=said.number, found=found)

    # ------------------------------------------------------------------ showing

    def _say(self, tell: str, /, **content: Any) -> None:
        with self._feed.changed:
            self._outbox.append(msgspec.json.encode({"tell": tell, **content}))
            self._feed.changed.notify_all()

    def _send(self) -> None:
        """Send all pending messages once, and states only as fast as the page draws them."""
        shown: dict[str, bytes] = {}
        event, stamp, silent = 0, 0, False
        feed = self._feed
        while True:
            due: list[bytes] = []
            with feed.changed:
                for name, content in feed.told.items():
                    if shown.get(name) != content:
                        due.append(content)
                        shown[name] = content
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
