"""Requests from a tab to the service. Each runs in its own task, so that STOP never waits."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

from trirail.client import trajectory
from trirail.client.async_client import AsyncRobot
from trirail.client.blocking import LoopThread
from trirail.client.goal import AsyncGoalHandle
from trirail.client.lease import AsyncLease
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.panel.feed import now
from trirail.panel.messages import Follow, Forget, SendCommand, SendGoal, ServiceRequest, TakeOver, Teach
from trirail.wire.goals import kind_name
from trirail.wire.messages import CommandReply
from trirail.wire.vocabulary import Command

MAX_STATE_AGE_MS = 500
"""Maximum age of the newest state on the page for a jog [ms]; if older, the page or its connection has stalled."""
MAX_PENDING = 8
"""Maximum number of unanswered commands of a tab.

Commands that stop the robot have a separate limit of the same size.
"""


class MessageSender(Protocol):
    """Function that sends messages to the page.

    `to` is a word that the page translates, `name` the name of its object, if any.
    """

    def __call__(self, tell: str, /, **content: Any) -> None:
        """Send a message of kind `tell`."""


class TabRequests:
    """Sender of one tab's requests and holder of its lease; `send` sends the replies to the page."""

    def __init__(self, robot: AsyncRobot, loop: LoopThread, send: MessageSender) -> None:
        self._robot = robot
        self._loop = loop
        self._reply = send
        self._pending: Counter[str] = Counter()
        self._lease: AsyncLease | None = None
        self._open = True

    def close(self) -> None:
        """Release the lease, even if an acquisition is still in progress."""
        self._open = False
        with contextlib.suppress(ServiceError):  # the connection is closed, so the lease ends when it times out
            self._loop.call(self._release())

    def begin(self, request: ServiceRequest) -> None:
        """Send a request in parallel with pending requests; drop a command that is already pending."""
        match request:
            case SendCommand(name, content):
                send = lambda: self._command(name, bytes(content) or None)  # noqa: E731
                self._loop.start(self._answer(send, name))
            case TakeOver():
                self._loop.start(self._answer(lambda: self._acquire(force=True), "takeover"))
            case SendGoal(goal, seen):
                if seen is None or now() - seen <= MAX_STATE_AGE_MS:
                    name = str(getattr(goal, "name", ""))
                    self._loop.start(self._answer(lambda: self._robot.send(goal), kind_name(goal), name))
            case Follow(name):
                self._loop.start(self._answer(lambda: self._follow(request), "follow", name))
            case Teach(name):
                self._loop.start(self._answer(lambda: self._robot.teach(name), "teach", name))
            case Forget(name):
                self._loop.start(self._answer(lambda: self._robot.forget(name), "forget", name))

    async def _answer(self, send_request: Callable[[], Awaitable[object]], kind: str, name: str = "") -> None:
        """Send a request and report its result. Commands that stop the robot never wait and have a separate limit."""
        stops = isinstance(kind, Command) and kind.stops
        repeats = isinstance(kind, Command) and not stops and kind is not Command.SET_OUTPUT  # it is of one output
        if repeats and self._pending[kind]:
            return
        place = "stops" if stops else "others"
        if self._pending[place] >= MAX_PENDING:
            message = f"{MAX_PENDING} commands of this page are already waiting for replies"
            self._reply("refused", to=kind, name=name, message=message, code=RefusalCode.BUSY)
            return
        self._pending.update((place, kind))
        try:
            done = await send_request()
        except TrirailError as error:
            self._reply("refused", to=kind, name=name, **refusal(error))
        else:
            if isinstance(done, AsyncGoalHandle):
                self._reply("accepted", to=kind, name=name, id=done.id)
            else:
                seq = done.seq if isinstance(done, CommandReply) else 0
                self._reply("done", to=kind, name=name, seq=seq)
        finally:
            self._pending.subtract((place, kind))

    async def _command(self, name: Command, content: bytes | None) -> CommandReply | None:
        if name is Command.ACQUIRE:
            await self._acquire()
        elif name is Command.RELEASE and self._lease is not None:
            await self._release()
        else:
            return await self._robot.command(name, content)
        return None

    async def _follow(self, request: Follow) -> AsyncGoalHandle:
        points = await asyncio.to_thread(trajectory.parse, request.name, request.text)
        return await self._robot.follow(points, stretch=request.stretch)

    async def _acquire(self, *, force: bool = False) -> None:
        """Acquire the lease and hold it while this tab is open; keep-alives are sent only until the tab closes."""
        if self._lease is None or self._lease.lost is not None:
            lease = self._robot.lease(force=force)
            await lease.__aenter__()
            self._lease = lease
        if not self._open:
            await self._release()

    async def _release(self) -> None:
        lease, self._lease = self._lease, None
        if lease is not None:
            await lease.__aexit__()


def refusal(error: TrirailError) -> dict[str, Any]:
    """Return the message of an error, with the code and values that the page needs to translate it."""
    fields: dict[str, Any] = {"message": str(error)}
    if isinstance(error, RefusedError):
        fields |= {"code": error.code, "slider": error.slider, "value": error.value, "limit": error.limit}
    elif isinstance(error, ServiceError):
        fields["code"] = "service"
    return fields
