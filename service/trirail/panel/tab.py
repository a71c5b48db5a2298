"""One open tab of the operator's page: what it says is done, what there is to show it is sent."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from typing import Any

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from trirail.client.client import Robot
from trirail.client.held_jog import HeldJog
from trirail.panel.feed import Feed, now
from trirail.panel.messages import CheckPath, CheckPose, FromPage, Hold, Release, Seen, Tell
from trirail.panel.newest_asked import NewestAsked
from trirail.panel.orders import FRESH, Orders
from trirail.wire.decoding import decoded, prepare

AHEAD = 3
"""So many states may be on their way to the page: a frozen tab, or a slow network, is sent no more, and none waits."""
UNSENT = 200
"""So many answers are kept for a tab that reads none; the eldest go."""

prepare(FromPage)


class Tab:
    """Serves one WebSocket until it is closed; then whatever it held has been let go.

    Whether the robot moves is decided by the service alone: what stands still or is lost here, and on the way here,
    renews no jog.
    """

    def __init__(self, socket: ServerConnection, robot: Robot, feed: Feed) -> None:
        self._socket = socket
        self._feed = feed
        self._jog = HeldJog(robot.send, lambda why: self._say("ended", message=why))
        self._outbox: deque[bytes] = deque(maxlen=UNSENT)
        self._unseen: deque[int] = deque()
        self._orders = Orders(robot, self._say)
        self._poses, self._paths = NewestAsked("pose check"), NewestAsked("path check")
        self._open = True

    def serve(self) -> None:
        """Do what the page says until it is gone."""
        sender = threading.Thread(target=self._send, name="tab", daemon=True)
        sender.start()
        try:
            with contextlib.suppress(ConnectionClosed):  # a tab that is killed, or says too much, is gone like another
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
        except msgspec.MsgspecError as error:
            self._say("refused", to="page", message=f"not a message of this page: {error}")
            return
        if said.needs is not None and said.needs not in self._feed.permissions:
            self._say("refused", to=said.needs, message=f"your role does not allow {said.needs}")
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
            case Tell(name):
                if name.stops:
                    self._jog.release()
                self._orders.command(name)
            case CheckPose():
                self._poses.submit(lambda: self._check_pose(said))
            case CheckPath():
                self._paths.submit(lambda: self._check_path(said))
            case _:
                self._orders.request(said)

    def _check_pose(self, said: CheckPose) -> None:
        why, on_way = self._feed.problem(said.pose, said.tool, said.frame)
        self._say("checked", number=said.number, why=why, on_way=on_way)

    def _check_path(self, said: CheckPath) -> None:
        found = self._feed.checked_path(said.name, said.text, said.stretch)
        self._say("path", number=said.number, found=found)

    # ------------------------------------------------------------------ showing

    def _say(self, tell: str, /, **content: Any) -> None:
        with self._feed.changed:
            self._outbox.append(msgspec.json.encode({"tell": tell, **content}))
            self._feed.changed.notify_all()

    def _send(self) -> None:
        """Send what there is, each thing once, states only as fast as the page draws them."""
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
