"""Server side of an open tab of the operator's page, which handles the tab's messages and sends the data to show."""

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
from trirail.panel.feed import Feed
from trirail.panel.messages import (
    AnyPageMessage,
    BeginUpload,
    CheckPath,
    CheckPose,
    JogHeld,
    JogReleased,
    SendCommand,
    StateDrawn,
    stop_in,
)
from trirail.panel.tab_requests import OUTDATED, TabRequests, refusal
from trirail.panel.uploads import UploadedFile, Uploads
from trirail.wire.decoding import INVALID, decoded
from trirail.wire.goals import Goal


class NewestTask:
    """Worker thread that runs the most recently submitted task, and skips older tasks that have not begun.

    `name` is the name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._changed = threading.Condition()
        self._task: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def submit(self, task: Callable[[], None]) -> None:
        """Submit a task; it replaces a task that has not begun."""
        with self._changed:
            self._task = task
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
                self._changed.wait_for(lambda: self._closed or self._task is not None)
                do, self._task = self._task, None
                if self._closed or do is None:
                    return
            do()


MAX_STATES_IN_TRANSIT = 3
"""Maximum number of states that have been sent but not yet drawn.

If a tab is frozen or the network is slow, the tab receives no further states, so that states do not queue up.
"""
MAX_ANSWERS = 200
"""Maximum number of answers that are stored for a tab that does not read them; the oldest answers are dropped."""


class Tab:
    """Handler of the WebSocket of one tab. When the socket closes, the handler ends the tab's jog and lease.

    A late or lost message does not renew a jog, so the service then brakes the robot. `stopping` and `stop_loop` are
    the robot and the event loop for stops.
    """

    def __init__(
        self,
        socket: ServerConnection,
        robot: AsyncRobot,
        loop: LoopThread,
        stopping: AsyncRobot,
        stop_loop: LoopThread,
        feed: Feed,
    ) -> None:
        self._socket = socket
        self._feed = feed
        self._robot = robot
        self._loop = loop
        self._jog = HeldJog(self._send_goal, self._on_jog_ended)
        self._jog_refused = False
        """Whether a jog was refused because of an outdated state. It stays refused until the button is released."""
        self._outbox: deque[bytes] = deque(maxlen=MAX_ANSWERS)
        self._undrawn: deque[int] = deque()
        self._uploads = Uploads()
        self._requests = TabRequests(robot, loop, stopping, stop_loop, feed, self._enqueue, self._uploads)
        self._poses, self._paths = NewestTask("pose check"), NewestTask("path check")
        self._open = True

    def serve(self) -> None:
        """Handle the tab's messages until the connection ends."""
        sender = threading.Thread(target=self._send, name="tab", daemon=True)
        sender.start()
        try:
            with contextlib.suppress(ConnectionClosed):  # the tab was closed or killed, or has sent too much
                for content in self._socket:
                    if isinstance(content, bytes):
                        self._on_part(content)
                    else:
                        self._on_message(content)
        finally:
            self._jog.close()
            self._poses.close()
            self._paths.close()
            with self._feed.changed:
                self._open = False
                self._feed.changed.notify_all()
            self._requests.close()

    def _on_part(self, part: bytes) -> None:
        try:
            self._enqueue("received", **self._uploads.append(part))
        except ValueError as error:
            self._refuse_message(str(error))

    def _on_message(self, text: str) -> None:
        try:
            message: AnyPageMessage = decoded(text, AnyPageMessage)
        except INVALID as error:
            self._refuse_message(f"not a message of this page: {error}")
            if (stop := stop_in(text)) is not None:  # as in the service, a stop is carried out nevertheless
                self._handle(stop)
            return
        self._handle(message)

    def _handle(self, message: AnyPageMessage) -> None:
        if message.required_permission is not None and message.required_permission not in self._feed.permissions:
            words = f"your role does not allow {message.required_permission}"
            self._enqueue("refused", to=message.required_permission, message=words, code=RefusalCode.NOT_ALLOWED)
            return
        match message:
            case StateDrawn(stamp):
                with self._feed.changed:
                    while self._undrawn and self._undrawn[0] <= stamp:
                        self._undrawn.popleft()
                    self._feed.changed.notify_all()
            case JogHeld():
                self._hold_jog(message)
            case JogReleased():
                self._jog_refused = False
                self._jog.release()
            case CheckPose():
                self._poses.submit(lambda: self._check_pose(message))
            case BeginUpload():
                self._enqueue("received", **self._uploads.begin(message))
            case CheckPath():
                self._check_path(message)
            case _:
                if isinstance(message, SendCommand) and message.name.stops:
                    self._jog.release()
                self._requests.begin(message)

    def _hold_jog(self, message: JogHeld) -> None:
        if not self._feed.is_fresh(message.seen) and not self._jog_refused:
            self._jog_refused = True
            self._enqueue("ended", **OUTDATED)
        if not self._jog_refused:
            self._jog.hold(message.velocity, message.tool)

    def _send_goal(self, make: Callable[[str], Goal], goal_id: str) -> GoalHandle:
        goal = self._loop.call(self._robot.send(make, goal_id))
        return GoalHandle(goal, self._loop, lambda name, content: self._loop.call(self._robot.command(name, content)))

    def _on_jog_ended(self, why: str) -> None:
        error = self._jog.error
        self._enqueue("ended", **(refusal(error) if error is not None else {}) | {"message": why})

    def _check_pose(self, message: CheckPose) -> None:
        self._enqueue("checked", number=message.number, obstacle=self._feed.find_obstacle(message.goal))

    def _check_path(self, message: CheckPath) -> None:
        def check(file: UploadedFile) -> None:
            result = self._feed.check_path(file.name, file.text, message.stretch)
            self._enqueue("path", number=message.number, found=result)

        if file := self._uploads.find(message.file):
            self._paths.submit(lambda: check(file))
        else:
            self._refuse_message(f"file {message.file}: not uploaded")

    # ------------------------------------------------------------------ output

    def _refuse_message(self, why: str) -> None:
        self._enqueue("refused", to="page", message=why, code=RefusalCode.MALFORMED)

    def _enqueue(self, tell: str, /, **content: Any) -> None:
        with self._feed.changed:
            self._outbox.append(msgspec.json.encode({"tell": tell, **content}))
            self._feed.changed.notify_all()

    def _send(self) -> None:
        """Send pending messages and states until the tab closes; send states only as fast as the page draws them."""
        sent: dict[str, bytes] = {}
        event, stamp = 0, 0
        silent: str | None = None
        """Reason of the silence that was sent last; None if a state was sent since."""
        feed = self._feed
        while True:
            due: list[bytes] = []
            with feed.changed:
                for name, content in feed.messages.items():
                    if sent.get(name) != content:
                        due.append(content)
                        sent[name] = content
                for number, content in feed.events(event):
                    event = number
                    due.append(content)
                due += self._outbox
                self._outbox.clear()
                if feed.state is None:
                    if silent != feed.trouble:
                        due.append(msgspec.json.encode({"tell": "silent", "trouble": feed.trouble}))
                    silent = feed.trouble
                elif feed.stamp != stamp and len(self._undrawn) < MAX_STATES_IN_TRANSIT:
                    stamp, silent = feed.stamp, None
                    self._undrawn.append(stamp)
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
