"""The lease as a client holds it: taken, kept by signs of life, and given back."""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable
from typing import Self

import msgspec

from trirail.client.outgoing import number, seconds
from trirail.errors import TrirailError
from trirail.wire.messages import CommandReply
from trirail.wire.vocabulary import AcquireLease, Command, Mode, ReleaseLease

SIGNS = 4
"""Signs of life in each time-out: so many may be lost, but one."""


class Lease:
    """The lease while the context lasts; `lost` tells whether it was taken over, released or came to its end before.

    Entering raises RefusedError where another holds it, and returns when what others had under way has come to rest.
    A program that hangs or dies gives no signs of life any more: the robot stops and the lease is free. Leaving gives
    it back, and returns when the robot stands. `command` sends a command with its content, as Robot.command does.
    """

    def __init__(self, command: Callable[[Command, bytes], CommandReply], *, force: bool, timeout: float) -> None:
        self._command = command
        self._sign = AcquireLease(uuid.uuid4().hex[:12], number(timeout, "timeout"))
        self._force = force
        self._over = threading.Event()
        self._keeping = threading.Thread(target=self._keep, name="lease", daemon=True)
        self.lost: TrirailError | None = None
        """Why it is not held any more."""

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is lost, for so many seconds at most; whether it is."""
        return self._over.wait(seconds(timeout))

    def __enter__(self) -> Self:
        asked = msgspec.structs.replace(self._sign, force=self._force)
        reply = self._command(Command.ACQUIRE, msgspec.json.encode(asked))
        self._keeping.start()
        if reply.mode == Mode.STOPPING:
            try:
                self._command(Command.STOP, b"")  # answered when the robot stands
            except BaseException:
                self.__exit__()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._keeping.join()
        if self.lost is None:
            with contextlib.suppress(TrirailError):  # nobody answers any more: then it ends by its time-out
                self._command(Command.RELEASE, msgspec.json.encode(ReleaseLease(self._sign.id)))

    def _keep(self) -> None:
        sign = msgspec.json.encode(self._sign)
        while not self._over.wait(self._sign.timeout / SIGNS):
            try:
                self._command(Command.ACQUIRE, sign)
            except TrirailError as error:
                self.lost = error
                self._over.set()
