"""Conversations with several nodes side by side, in one thread: each is a coroutine that awaits frames, or time."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Coroutine, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import can

from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.interface import Clock

LOG: Final = logging.getLogger("trirail.drives")
"""Where it is told how far drives are that take their time."""
TOLD_EVERY: Final = 1.0
"""[s]."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.001, 0.02
"""Between two readings of what is to become true [s]: as long as it has taken so far, within these."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Wait:
    """For a frame that `takes` says is the awaited one, until `deadline` [s]; `await` gives it, or None."""

    takes: Callable[[can.Message], bool]
    """It is shown every frame that comes meanwhile."""
    deadline: float

    def __await__(self) -> Generator[Wait, can.Message | None, can.Message | None]:
        return (yield self)


def side_by_side(
    bus: can.BusABC, clock: Clock, conversations: Sequence[Coroutine[Any, Any, T]], progress: Callable[[], str]
) -> list[T | DriveError]:
    """Lead conversations to their ends, each at its own pace; return what each came to, or why it could not go on.

    Every second `progress` is logged. Raises BusError, of which all of them would suffer.
    """
    ends: dict[int, T | DriveError] = {}
    waits: dict[int, Wait] = {}

    def go_on(at: int, frame: can.Message | None) -> None:
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
        told = clock()
        for at in range(len(conversations)):
            go_on(at, None)
        while waits:
            due = min(told + TOLD_EVERY, *(wait.deadline for wait in waits.values()))
            frame = _receive(bus, due - clock())
            now = due if frame is None else clock()  # some buses wait a little less than they are told to
            for at, wait in list(waits.items()):
                if frame is not None and wait.takes(frame):
                    go_on(at, frame)
                elif now >= wait.deadline:
                    go_on(at, None)
            if now >= told + TOLD_EVERY:
                told = now
                LOG.warning("%s", progress())
    finally:
        for conversation in conversations:
            conversation.close()
    return [ends[at] for at in range(len(conversations))]


def _receive(bus: can.BusABC, seconds: float) -> can.Message | None:
    try:
        return bus.recv(max(0.0, seconds))
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot receive on {bus.channel_info}: {error}; is the interface up?") from error


async def until(
    read: Callable[[], Awaitable[T]],
    so: Callable[[T], bool],
    pause: Callable[[float], Awaitable[None]],
    clock: Clock,
    seconds: float,
) -> tuple[T, float]:
    """Read until it is `so`, for so long [s] at most; return what was read last, and how long it was waited [s]."""
    begun = clock()
    while True:
        found = await read()
        waited = clock() - begun
        if so(found) or waited >= seconds:
            return found, waited
        await pause(max(_FIRST_PAUSE, min(waited, _LONGEST_PAUSE, seconds - waited)))
