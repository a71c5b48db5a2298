"""Lease that a client acquires, renews and releases."""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections.abc import Awaitable, Callable
from typing import Self

import msgspec

from trirail.client.outgoing import number, seconds
from trirail.errors import RefusalCode, RefusedError, ServiceError, TrirailError
from trirail.wire.messages import CommandReply
from trirail.wire.vocabulary import AcquireLease, Command, Mode, ReleaseLease

SIGNS = 4
"""Number of renewals per time-out; the lease continues if at least one of them arrives."""
RELEASED_WITHIN_S = 1.0
"""Time for which a task that was cancelled waits for the release of its lease [s], if its time-out is not earlier."""
_PASSING = RefusalCode.BUSY, RefusalCode.TIMEOUT
"""Refusals of a renewal that do not end the lease."""


class AsyncLease:
    """Context manager that holds the lease and renews it in a task; see trirail.client.blocking.Lease.

    If a task is cancelled while it enters the context, the lease is released. `command` is a function that sends a
    command with its content, such as AsyncRobot.command.
    """

    def __init__(
        self, command: Callable[[Command, bytes], Awaitable[CommandReply]], *, force: bool, timeout: float
    ) -> None:
        self._command = command
        self._sign = AcquireLease(uuid.uuid4().hex[:12], number(timeout, "timeout"))
        self._force = force
        self._over = asyncio.Event()
        self._keeping: asyncio.Task[None] | None = None
        self.lost: TrirailError | None = None
        """Error that ended the lease; None while the client holds the lease."""

    async def wait(self, timeout: float | None = None) -> bool:
        """Wait at most `timeout` seconds for the lease to end. Return True if it has ended."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds(timeout)):
                await self._over.wait()
        return self._over.is_set()

    async def __aenter__(self) -> Self:
        asked = msgspec.structs.replace(self._sign, force=self._force)
        try:
            reply = await self._command(Command.ACQUIRE, msgspec.json.encode(asked))
        except asyncio.CancelledError:  # the service may have granted the lease
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(self._sign.timeout, RELEASED_WITHIN_S)):
                    await self._release()
            raise
        self._keeping = asyncio.create_task(self._keep(), name="lease")
        if reply.mode == Mode.STOPPING:
            try:
                await self._command(Command.STOP, b"")  # the service replies when the robot is at rest
            except BaseException:
                await self.__aexit__()
                raise
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._over.is_set():
            return
        self._over.set()
        # A task of its own sends the release before the first wait, at which this call may be cancelled.
        releasing = asyncio.create_task(self._release())
        try:
            if self._keeping is not None:
                self._keeping.cancel()
                await asyncio.wait([self._keeping])
            await releasing
        finally:
            releasing.cancel()

    async def _release(self) -> None:
        with contextlib.suppress(TrirailError):  # without a reply, the time-out ends the lease
            await self._command(Command.RELEASE, msgspec.json.encode(ReleaseLease(self._sign.id)))

    async def _keep(self) -> None:
        sign, now = msgspec.json.encode(self._sign), asyncio.get_running_loop().time
        until = now() + self._sign.timeout
        while self.lost is None:
            await asyncio.sleep(self._sign.timeout / SIGNS)
            sent = now()
            try:
                async with asyncio.timeout(self._sign.timeout):
                    await self._command(Command.ACQUIRE, sign)
                until = sent + self._sign.timeout
            except TimeoutError:
                self.lost = ServiceError(f"the service has not renewed the lease within {self._sign.timeout:g} s")
            except TrirailError as error:
                passing = isinstance(error, ServiceError) or (
                    isinstance(error, RefusedError) and error.code in _PASSING
                )
                if not passing or now() >= until:  # until then, the gateway may be busy, or restarting
                    self.lost = error
        self._over.set()
