"""Concurrent conversations with several nodes in one thread, as coroutines that await frames or a deadline."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

import can

from trirail_drivers.bus import canerrors
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import Clock

LOG: Final = logging.getLogger("trirail.drives")
"""Log of the progress of a long set-up."""
PROGRESS_PERIOD: Final = 1.0
"""Period of the progress log [s]."""
_FIRST_PAUSE, _MAX_PAUSE = 0.001, 0.02
"""Shortest and longest pause between two readings of a value [s]. Otherwise the pause equals the time already waited.
"""

MAX_QUEUED_FRAMES: Final = 8
"""Maximum number of frames that a background conversation queues: the awaited frame and those that follow it."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Wait:
    """Awaitable for the first frame that `accepts` accepts; its result is None once `deadline` [s] has passed."""

    accepts: Callable[[can.Message], bool]
    """Predicate, called with every frame received while waiting."""
    deadline: float

    def __await__(self) -> Generator[Wait, can.Message | None, can.Message | None]:
        return (yield self)


def run_concurrently(
    bus: can.BusABC,
    clock: Clock,
    conversations: Sequence[Coroutine[Any, Any, T]],
    progress: Callable[[], str],
    observe: Callable[[can.Message], None] = lambda _: None,
) -> list[T | DriveError]:
    """Run conversations concurrently; return the result or the DriveError of each conversation.

    The text from `progress` is logged every second. `observe` is called with every received frame, whether or not a
    conversation awaits it. A BusError affects all conversations, so it is raised.
    """
    ends: dict[int, T | DriveError] = {}
    waits: dict[int, Wait] = {}

    def resume(at: int, frame: can.Message | None) -> None:
        waits.pop(at, None)
        try:
            waits[at] = conversations[at].send(frame)
        except StopIteration as end:
            ends[at] = end.value
        except BusError:
            raise
        except DriveError as error:
            ends[at] = error

    try:
        reported = clock()
        for at in range(len(conversations)):
            resume(at, None)
        while waits:
            due = min(reported + PROGRESS_PERIOD, *(wait.deadline for wait in waits.values()))
            frame = receive(bus, due - clock())
            now = due if frame is None else clock()  # some buses return a little early
            if frame is not None:
                observe(frame)
            for at, wait in list(waits.items()):  # a copy: resume changes the waits
                if frame is not None and wait.accepts(frame):
                    resume(at, frame)
                elif now >= wait.deadline:
                    resume(at, None)
            if now >= reported + PROGRESS_PERIOD:
                reported = now
                LOG.warning("%s", progress())
    finally:
        for conversation in conversations:
            conversation.close()
    return [ends[at] for at in range(len(conversations))]


class BackgroundConversation(Generic[T]):
    """Conversation that the cycle advances one step at a time, without waiting or receiving."""

    def __init__(self, conversation: Coroutine[Any, Any, T]) -> None:
        self._conversation = conversation
        self._heard: deque[can.Message] = deque()
        """Frames for the next steps. The first one is awaited; the conversation has not seen those that follow it."""
        self._wait: Wait | None = None

    def receive(self, frame: can.Message) -> None:
        """Queue a frame for the next step if the conversation awaits it.

        Other frames are not queued, since a drive may send any number of them between two steps.
        """
        awaited = self._wait is not None and (self._heard or self._wait.accepts(frame))
        if awaited and len(self._heard) < MAX_QUEUED_FRAMES:
            self._heard.append(frame)

    def step(self, now: float) -> T | DriveError | None:
        """Continue if the awaited frame has arrived or its deadline has passed.

        Return the result or the error if the conversation has ended, otherwise None. `now` is the present time [s].
        """
        if self._wait is not None and not self._heard and now < self._wait.deadline:
            return None
        frame = self._heard.popleft() if self._heard else None
        try:
            self._wait = self._conversation.send(frame)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]
        except DriveError as error:
            return error
        followed, self._heard = self._heard, deque()
        for each in followed:
            self.receive(each)
        return None

    def close(self) -> None:
        """Abandon the conversation."""
        self._conversation.close()


def receive(bus: can.BusABC, seconds: float) -> can.Message | None:
    """Return a received frame, or None after some time. Raises BusError if the bus is lost."""
    try:
        frame = bus.recv(max(0.0, seconds))
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot receive on {bus.channel_info}: {error}; check that the interface is up") from error
    if frame is not None and frame.is_error_frame:
        report = canerrors.decode_error_frame(frame.arbitration_id, frame.data, str(bus.channel_info))
        if report.severity is canerrors.Severity.FAULT:
            raise BusError(f"cannot use {bus.channel_info}: {report.text}")
    return frame


async def read_until(
    read: Callable[[], Awaitable[T]],
    accepts: Callable[[T], bool],
    pause: Callable[[float], Awaitable[None]],
    clock: Clock,
    seconds: float,
) -> tuple[T, float]:
    """Read repeatedly until a value is accepted, for up to `seconds`; return the last value and the time waited [s]."""
    begun = clock()
    while True:
        value = await read()
        waited = clock() - begun
        if accepts(value) or waited >= seconds:
            return value, waited
        await pause(max(_FIRST_PAUSE, min(waited, _MAX_PAUSE, seconds - waited)))
