"""Requests from a tab to the service. Each request has a separate task, so a stop never waits for other requests."""

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
from trirail.panel.feed import Feed
from trirail.panel.messages import Follow, Forget, SendCommand, SendGoal, ServiceRequest, TakeOver, Teach
from trirail.panel.uploads import UploadedFile, Uploads
from trirail.wire.goals import kind_name
from trirail.wire.messages import CommandReply
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import Command

MAX_PENDING = 8
"""Maximum number of unanswered requests of a tab.

Commands that only reduce motion do not count; each of them has a separate limit of the same size.
"""


class MessageSender(Protocol):
    """Function that sends messages to the page."""

    def __call__(self, tell: str, /, **content: Any) -> None:
        """Send a message of the kind `tell` with the fields `content`.

        The field `to` contains a word that the page translates, such as the name of a command. The field `name`
        contains the name of a pose or a file, if there is one.
        """


class TabRequests:
    """Sender of the requests of one tab, and holder of the tab's lease.

    `stopping` and `stop_loop` are the robot and the event loop for stops. `send` is a function that sends the results
    of the requests to the page. `uploads` contains the tab's file.
    """

    def __init__(
        self,
        robot: AsyncRobot,
        loop: LoopThread,
        stopping: AsyncRobot,
        stop_loop: LoopThread,
        feed: Feed,
        send: MessageSender,
        uploads: Uploads,
    ) -> None:
        self._robot = robot
        self._loop = loop
        self._stopping = stopping
        self._stop_loop = stop_loop
        self._feed = feed
        self._reply = send
        self._uploads = uploads
        self._pending: Counter[str] = Counter()
        """Numbers of unanswered requests. Each event loop changes only the numbers of its own requests."""
        self._lease: AsyncLease | None = None
        self._acquiring = asyncio.Lock()
        """Lock that is held while the lease is being acquired, so that the tab never holds two leases."""
        self._overrides: list[Callable[[], Awaitable[object]]] = []
        """Function that sends the newest command override; empty if it has been called."""
        self._open = True

    def close(self) -> None:
        """Release the lease, even if the lease is still being acquired."""
        self._open = False
        with contextlib.suppress(ServiceError):  # the connection is closed, so the lease ends when it times out
            self._loop.call(self._release())

    def begin(self, request: ServiceRequest) -> None:
        """Send a request in parallel with pending requests.

        Ignore a command that is already pending. If the page's state is outdated, refuse every request except commands
        that only reduce motion. Of the overrides that are requested while another override is pending, only the newest
        is sent, except that the override 0 is sent immediately.
        """
        kind, name, send = self._prepared(request)
        reduces = isinstance(request, SendCommand) and request.only_reduces_motion
        if not reduces and not self._feed.is_fresh(request.seen):
            self._reply("refused", to=kind, name=name, **OUTDATED)
        elif kind == Command.OVERRIDE:
            self._loop.start(self._set_override(send, reduces=reduces))
        else:
            (self._stop_loop if kind in STOPS else self._loop).start(self._answer(send, kind, name, reduces=reduces))

    def _prepared(self, request: ServiceRequest) -> tuple[str, str, Callable[[], Awaitable[object]]]:
        """Return the fields `to` and `name` of the result of a request, and the function that sends the request."""
        match request:
            case SendCommand(command, content):
                return command, "", lambda: self._command(command, bytes(content) or None)
            case TakeOver():
                return "takeover", "", lambda: self._acquire(force=True)
            case SendGoal(goal):
                return kind_name(goal), getattr(goal, "name", ""), lambda: self._robot.send(goal)
            case Follow(number, stretch=stretch):
                file = self._uploads.find(number)
                return "follow", file.name if file else "", lambda: self._follow(file, stretch)
            case Teach(name):
                return "teach", name, lambda: self._robot.teach(name)
            case Forget(name):
                return "forget", name, lambda: self._robot.forget(name)

    async def _answer(
        self, send_request: Callable[[], Awaitable[object]], kind: str, name: str = "", *, reduces: bool = False
    ) -> None:
        """Send a request, and send its result to the page.

        `kind` and `name` become the fields `to` and `name` of the result. `reduces` is whether the request only reduces
        motion.
        """
        # Two commands set_output may concern different outputs, and `_set_override` sends two overrides deliberately.
        may_repeat = (Command.SET_OUTPUT, Command.OVERRIDE)
        repeats = isinstance(kind, Command) and not kind.stops and kind not in may_repeat
        if repeats and self._pending[kind]:
            return
        place = f"{kind} to reduce" if reduces else "others"  # one kind of stop must not keep out another
        if self._pending[place] >= MAX_PENDING:
            message = f"{MAX_PENDING} commands of this page are already waiting for replies"
            self._reply("refused", to=kind, name=name, message=message, code=RefusalCode.BUSY)
            return
        self._pending.update({place, kind})
        try:
            done = await send_request()
        except TrirailError as error:
            self._reply("refused", to=kind, name=name, **refusal(error))
        except Exception as error:
            self._reply("refused", to=kind, name=name, message=repr(error))
            raise  # to the log
        else:
            if isinstance(done, AsyncGoalHandle):
                self._reply("accepted", to=kind, name=name, id=done.id)
            else:
                seq = done.seq if isinstance(done, CommandReply) else 0
                self._reply("done", to=kind, name=name, seq=seq)
        finally:
            self._pending.subtract({place, kind})

    async def _set_override(self, send: Callable[[], Awaitable[object]], *, reduces: bool) -> None:
        """Set the override. The operator's slider sends one for each key press."""
        self._overrides = [] if reduces else [send]
        if reduces:
            await self._answer(send, Command.OVERRIDE, reduces=True)
        while self._overrides and not self._pending[Command.OVERRIDE]:
            await self._answer(self._overrides.pop(), Command.OVERRIDE)

    async def _command(self, name: Command, content: bytes | None) -> CommandReply | None:
        if name is Command.ACQUIRE:
            await self._acquire()
            return None
        if name is Command.RELEASE:
            async with self._acquiring:
                if self._lease is not None and self._lease.lost is None:
                    await self._release()
                    return None
        return await (self._stopping if name in STOPS else self._robot).command(name, content)

    async def _follow(self, file: UploadedFile | None, stretch: bool) -> AsyncGoalHandle:
        if file is None:
            raise TrirailError("the file has not been uploaded")
        points = await asyncio.to_thread(lambda: trajectory.parse(file.name, file.text))
        return await self._robot.follow(points, stretch=stretch)

    async def _acquire(self, *, force: bool = False) -> None:
        """Acquire the lease, and renew it until this tab closes."""
        async with self._acquiring:
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


OUTDATED = {
    "code": "outdated",
    "message": "the page showed no state that is new enough, so nothing was sent; press again",
}
"""Fields of a message that refuses a request because the page or its connection has stalled."""


def refusal(error: TrirailError) -> dict[str, Any]:
    """Return the fields of a message about an error: the text, and the code and values that the page translates."""
    fields: dict[str, Any] = {"message": str(error)}
    if isinstance(error, RefusedError):
        fields |= {"code": error.code, "slider": error.slider, "value": error.value, "limit": error.limit}
    elif isinstance(error, ServiceError):
        fields["code"] = "service"
    return fields
