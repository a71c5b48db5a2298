"""A connection for asyncio: Zenoh's own threads hand what comes to the event loop, and no call has a thread."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import msgspec
import zenoh

from trirail.client.connection import REPLY_WITHIN, ROLE_WITHIN, Connection, SilenceError, once
from trirail.client.stop_call import Outcome, StopOrder
from trirail.errors import RefusedError, ServiceError, TrirailError
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply, Event, RoleReply
from trirail.wire.state import State

T = TypeVar("T", bound=msgspec.Struct)
Item = TypeVar("Item")


class AsyncConnection:
    """Asks and hears as trirail.client.connection.Connection does; all of it belongs to the loop it was opened in.

    A call that is cancelled takes its query, or its subscription, with it.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._loop = asyncio.get_running_loop()

    @classmethod
    async def open(cls, robot: str, connect: str, credentials: Credentials | None, user: str) -> AsyncConnection:
        """Open one. Raises ServiceError where the service cannot be reached."""
        opening = asyncio.get_running_loop().run_in_executor(None, Connection, robot, connect, credentials, user)
        try:
            return cls(await asyncio.shield(opening))
        except asyncio.CancelledError:  # what is being opened is closed again
            opening.add_done_callback(lambda done: None if done.exception() else done.result().close())
            raise

    async def close(self) -> None:
        """End it."""
        await asyncio.get_running_loop().run_in_executor(None, self._connection.close)

    @property
    def skipped(self) -> int:
        """How often something was published on this robot's keys that was none of its messages."""
        return self._connection.skipped

    async def users(self) -> list[str]:
        """Return the users who have a session to this robot, by name."""
        return await asyncio.get_running_loop().run_in_executor(None, self._connection.users)

    async def fetch(
        self, parts: tuple[str, ...], kind: type[T], payload: bytes | None = None, within: float = REPLY_WITHIN
    ) -> T:
        """Query the key of these parts, as Connection.ask does."""
        replies: asyncio.Queue[zenoh.Reply | None] = asyncio.Queue()
        query = zenoh.CancellationToken()
        over: Callable[[], None] = self._hand_over(lambda: replies.put_nowait(None))
        handler = zenoh.handlers.Callback(self._hand_over(replies.put_nowait), over, indirect=False)
        self._connection.session.get(
            **self._connection.query(parts, payload, within), handler=handler, cancellation_token=query
        )
        unreadable: ServiceError | None = None
        try:
            while (reply := await replies.get()) is not None:
                answer = self._connection.read(reply, kind)
                if not isinstance(answer, ServiceError):
                    return answer
                unreadable = answer
        finally:
            query.cancel()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it so
        raise unreadable or await self.nobody(*parts)

    async def stop(self, user: str, name: str, content: bytes | None, within: float) -> CommandReply:
        """Ask for a stop, quick_stop or disable, as Connection.stop does."""
        came: asyncio.Queue[Outcome] = asyncio.Queue()
        stop = StopOrder.of(self._connection.robot, user, name, content, within)
        with self._connection.copies(stop, self._hand_over(came.put_nowait)) as outcomes:
            try:
                while (reply := outcomes.decide(await came.get())) is None:
                    pass
            except SilenceError as error:
                raise await self.nobody("cmd", user, name) from error
        return reply

    def post(
        self, parts: tuple[str, ...], kind: type[T], payload: bytes, deliver: Callable[[T | TrirailError], None]
    ) -> None:
        """Query the key of these parts, and have what comes of it taken in the event loop, as Connection.post does."""
        self._connection.post(parts, kind, payload, self._hand_over(deliver))

    def query_unanswered(self, parts: tuple[str, ...], payload: bytes | None) -> None:
        """Query the key of these parts, and wait for no answer."""
        self._connection.session.get(
            **self._connection.query(parts, payload, REPLY_WITHIN),
            handler=zenoh.handlers.Callback(_ignore, indirect=False),
        )

    async def nobody(self, *parts: str) -> ServiceError | RefusedError:
        """Return what to raise where nobody answers on the key of these parts."""
        reply = None
        if user := self._connection.to_be_asked_for_role(*parts):
            with contextlib.suppress(ServiceError, RefusedError):
                reply = await self.fetch(("role", user), RoleReply, within=ROLE_WITHIN)
        return self._connection.why_nobody(parts, reply)

    async def states(self, timeout: float | None) -> AsyncGenerator[State]:
        """Yield states as they come, the newest where this is too slow; end after `timeout` seconds without one."""
        newest: asyncio.Queue[State] = asyncio.Queue()

        def keep_newest(state: State) -> None:
            while not newest.empty():
                newest.get_nowait()
            newest.put_nowait(state)

        with self._connection.subscribe_to_states(self._hand_over(keep_newest)):
            async for state in _until_silent(newest, timeout):
                yield state

    async def events(self, history: bool, timeout: float | None) -> AsyncGenerator[Event]:
        """Yield events in order, each once, with `history` the past first; end after `timeout` seconds without one."""
        received: asyncio.Queue[Event] = asyncio.Queue()
        with self.subscribe_to_events(once(received.put_nowait), history=history):
            async for event in _until_silent(received, timeout):
                yield event

    def overtaken(self, state: State) -> bool:
        """Whether a state is of before the newest answer or event that this client has."""
        return self._connection.overtaken(state)

    def subscribe_to_events(self, deliver: Callable[[Event], None], *, history: bool) -> AbstractContextManager[Any]:
        """Have every event taken in the event loop, with `history` the past too."""
        return self._connection.subscribe_to_events(self._hand_over(deliver), history=history)

    def records(self, deliver: Callable[[bytes], None]) -> AbstractContextManager[Any]:
        """Have every batch of records taken in the event loop, until the subscriber's context ends."""
        return self._connection.records(self._hand_over(deliver))

    def _hand_over(self, deliver: Callable[..., None]) -> Callable[..., None]:
        """Return what has something taken in the event loop; for Zenoh's threads."""

        def hand_over(*what: object) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to take it
                self._loop.call_soon_threadsafe(deliver, *what)

        return hand_over


def _ignore(_reply: zenoh.Reply) -> None:
    """Take an answer for which nobody waits."""


async def _until_silent(received: asyncio.Queue[Item], timeout: float | None) -> AsyncGenerator[Item]:
    """Yield what is received, until nothing is for `timeout` seconds."""
    while True:
        try:
            async with asyncio.timeout(timeout):
                item = await received.get()
        except TimeoutError:
            return
        yield item
