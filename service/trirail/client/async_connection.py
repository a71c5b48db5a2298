"""Connection for asyncio. Zenoh's threads pass each message to the event loop, so calls need no other threads."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncGenerator, Callable, Iterator, Sequence
from contextlib import AbstractContextManager, aclosing
from typing import Any, TypeVar

import msgspec
import zenoh

from trirail.client.call_time import called_at
from trirail.client.connection import CLOSED, HERE_WITHIN, REPLY_WITHIN, ROLE_WITHIN, Connection, SilenceError, once
from trirail.client.stop_call import StopOrder
from trirail.errors import RefusedError, ServiceError, TrirailError
from trirail.wire.messages import CommandReply, Event, RoleReply
from trirail.wire.state import State
from trirail.wire.text import is_name
from trirail.wire.vocabulary import Command

OTHER_LOOP = "the robot belongs to another event loop: enter a robot in this one, as async with AsyncRobot(…)"

BLOCKED_S = 0.1
"""Delay of a time-out that shows that this program has blocked the event loop [s]."""

T = TypeVar("T", bound=msgspec.Struct)


class AsyncConnection:
    """Queries and subscriptions over a connection, for the event loop in which the object is created.

    Cancelling a call cancels its query or its subscription.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._loop = asyncio.get_running_loop()
        self._queues: set[asyncio.Queue[Any]] = set()
        """Queues from which tasks read."""
        self._closed = False

    def another(self) -> AsyncConnection:
        """Return another object for the same connection, for the running event loop."""
        return AsyncConnection(self._connection)

    def close(self) -> None:
        """End the calls and iterations of all tasks with a ServiceError. The connection itself stays open."""
        self._closed = True
        for queue in self._queues:
            queue.put_nowait(None)  # wakes the task

    @property
    def skipped(self) -> int:
        """Number of invalid messages received on this robot's keys."""
        return self._connection.skipped

    async def fetch(
        self,
        parts: tuple[str, ...],
        kind: type[T],
        payload: bytes | None = None,
        within: float = REPLY_WITHIN,
        before: Sequence[bytes] = (),
        copy: str | None = None,
        began: float = math.inf,
    ) -> T:
        """Query the key made of `parts`; return the first valid reply, decoded as a message of `kind`.

        `before` are earlier parts of a message that does not fit into one query; the client sends them first and
        ignores the replies to them. `copy` is the id that the copies of a stop share. `began` is the time at which a
        program called for a request that may start motion [s].

        Raises RefusedError if the service refuses the query, if no reply arrives because the user's role does not allow
        the query, or if a stop was called after `began` and before the query is sent. Raises ServiceError if no valid
        reply arrives in time.
        """
        unreadable: ServiceError | None = None
        for part in before:
            self._connection.check_stops(began)
            self.query_unanswered(parts, part, began)
        self._connection.check_stops(began)
        query = self._connection.query(parts, payload, within, began) | ({"attachment": copy} if copy else {})
        async with aclosing(self._replies(lambda session: session.get, **query)) as replies:
            async for reply in replies:
                answer = self._connection.read(reply, kind)
                if not isinstance(answer, ServiceError):
                    return answer
                unreadable = answer
        raise unreadable or await self.nobody(*parts)

    async def users(self, user: str) -> list[str]:
        """Return the names of the users who have a session to this robot.

        A session always sees its own user. So that a robot that does not exist, or `user` without a role, is an error,
        the role is queried first. Raises the same errors as `fetch`.
        """
        role = await self.fetch(("role", user), RoleReply)
        if role.role is None:
            raise self._connection.why_nobody(("here", user), role)
        key = self._connection.key("here", "*")
        get = self._replies(lambda session: session.liveliness().get, key_expr=key, timeout=HERE_WITHIN)
        async with aclosing(get) as here:
            named = {str(reply.ok.key_expr).rpartition("/")[2] async for reply in here if reply.ok is not None}
        return sorted(filter(is_name, named))  # any session may declare a token with any name

    async def stop(self, user: str, name: str, content: bytes | None, within: float) -> CommandReply:
        """Send a stop, quick_stop or disable both over Zenoh and to the stop port; return the first reply.

        Raises the same errors as `fetch`.
        """
        mark = self._connection.mark(called_at())
        stop = StopOrder.create(self._connection.robot, user, name, content, within, mark)
        with self._queue() as came, self._connection.copies(stop, self._in_loop(came.put_nowait)) as outcomes:
            try:
                while (reply := outcomes.decide(await self._next(came))) is None:
                    pass
            except SilenceError as error:
                raise await self.nobody("cmd", user, name) from error
        return reply

    def note_stop(self, name: Command, at: float) -> None:
        """Store the time `at` of a call that stops the robot [s]."""
        self._connection.note_stop(name, at)

    def forget_pause(self, until: float) -> None:
        """Forget a pause that was called at the time `until` [s] or earlier, because it was refused or taken back."""
        self._connection.forget_pause(until)

    def post(
        self, parts: tuple[str, ...], kind: type[T], payload: bytes, deliver: Callable[[T | TrirailError], None]
    ) -> None:
        """Send a query for the key that consists of `parts`; call `deliver` with the reply or error in the event loop.

        See Connection.post.
        """
        self._connection.post(parts, kind, payload, self._in_loop(deliver))

    def query_unanswered(self, parts: tuple[str, ...], payload: bytes | None, began: float = math.inf) -> None:
        """Send a query for the key that consists of `parts`, without waiting for a reply; see Connection.query."""
        self._connection.query_unanswered(parts, payload, began)

    def stop_unanswered(self, user: str, name: Command, content: bytes | None = None) -> None:
        """Send a stop or disable to the stop port and over Zenoh, without waiting; see Connection.stop_unanswered."""
        self._connection.stop_unanswered(user, name, content)

    async def nobody(self, *parts: str) -> ServiceError | RefusedError:
        """Return the error to raise if no reply arrived to a query for the key that consists of `parts`.

        The method queries the user's role, because an insufficient role may be the reason.
        """
        reply = None
        if user := self._connection.to_be_asked_for_role(*parts):
            with contextlib.suppress(ServiceError, RefusedError):
                reply = await self.fetch(("role", user), RoleReply, within=ROLE_WITHIN)
        return self._connection.why_nobody(parts, reply)

    async def states(self, timeout: float | None, *, every: bool = False) -> AsyncGenerator[State]:
        """Yield states as they arrive; unless `every`, skip all but the newest if the caller is slow.

        End after `timeout` seconds without a state.
        """
        with self._queue() as waiting:

            def keep(state: State) -> None:
                while not (every or waiting.empty()):
                    waiting.get_nowait()
                waiting.put_nowait(state)

            with self._connection.subscribe_to_states(self._in_loop(keep)):
                async for state in self._items_until_timeout(waiting, timeout):
                    yield state

    async def events(self, history: bool, timeout: float | None) -> AsyncGenerator[Event]:
        """Yield each event once, in order; with `history`, begin with the past events.

        End after `timeout` seconds without an event.
        """
        with self._queue() as received, self.subscribe_to_events(once(received.put_nowait), history=history):
            async for event in self._items_until_timeout(received, timeout):
                yield event

    def overtaken(self, state: State) -> bool:
        """Return True if a state is older than the newest reply or event that this client received."""
        return self._connection.overtaken(state)

    def subscribe_to_events(self, deliver: Callable[[Event], None], *, history: bool) -> AbstractContextManager[Any]:
        """Pass every event to `deliver` in the event loop; with `history`, begin with the past events."""
        return self._connection.subscribe_to_events(self._in_loop(deliver), history=history)

    def records(self, deliver: Callable[[bytes], None]) -> AbstractContextManager[Any]:
        """Return a context manager: within its context, the event loop calls `deliver` with every batch of records."""
        return self._connection.records(self._in_loop(deliver))

    async def _replies(
        self, get_of: Callable[[zenoh.Session], Callable[..., object]], **query: Any
    ) -> AsyncGenerator[zenoh.Reply]:
        """Send a query and yield the replies; closing the generator cancels the query.

        `get_of` returns the method of the session that sends the query.
        """
        left = zenoh.CancellationToken()
        with self._queue() as replies:
            over = self._in_loop(lambda: replies.put_nowait(None))
            handler = zenoh.handlers.Callback(self._in_loop(replies.put_nowait), over, indirect=False)
            with self._connection.open_session() as session:
                get_of(session)(handler=handler, cancellation_token=left, **query)
            try:
                while (reply := await self._next(replies)) is not None:
                    yield reply
            finally:
                left.cancel()  # type: ignore[no-untyped-call]  # zenoh's stub leaves it so

    def _in_loop(self, deliver: Callable[..., None]) -> Callable[..., None]:
        """Return a callback for Zenoh's threads that calls `deliver` in the event loop.

        Raises ServiceError in another event loop, and in a forked process.
        """
        self._connection.check_process()
        if asyncio.get_running_loop() is not self._loop:
            raise ServiceError(OTHER_LOOP)

        def deliver_in_loop(*what: object) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed, so there is no receiver
                self._loop.call_soon_threadsafe(deliver, *what)

        return deliver_in_loop

    @contextlib.contextmanager
    def _queue(self) -> Iterator[asyncio.Queue[Any]]:
        """Yield a queue from which a task reads with `_next`."""
        queue: asyncio.Queue[Any] = asyncio.Queue()
        self._queues.add(queue)
        try:
            yield queue
        finally:
            self._queues.discard(queue)

    async def _next(self, queue: asyncio.Queue[Any]) -> Any:
        """Return the next item of a queue. Raises ServiceError if `close` is called before the item is read."""
        item = None if self._closed else await queue.get()
        if self._closed:
            raise ServiceError(CLOSED)
        return item

    async def _items_until_timeout(self, received: asyncio.Queue[Any], timeout: float | None) -> AsyncGenerator[Any]:
        """Yield received items until none arrives for `timeout` seconds.

        Time in which this program blocked the event loop, or was suspended, shows nothing about the service and does
        not count.
        """
        while True:
            ends = math.inf if timeout is None else self._loop.time() + timeout
            try:
                async with asyncio.timeout(timeout):
                    item = await self._next(received)
            except TimeoutError:
                if received.empty() and self._loop.time() - ends < BLOCKED_S:
                    return
            else:
                yield item
