"""Fixed-rate ticks on absolute deadlines of the monotonic clock, with calls served meanwhile.

The wait is compiled, for both ways of the loop. A call with time left before the deadline is served immediately, not a
cycle later.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numba import b1, i4, i8, types, u8
from numpy.typing import NDArray

from trirail.kinematics.compiled import compiled
from trirail.wire.links import Port

# Of libc, by name: time.h, poll.h.
_clock_nanosleep: Any = types.ExternalFunction("clock_nanosleep", i4(i4, i4, types.intp, types.intp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", i4(i4, types.intp))
_poll: Any = types.ExternalFunction("poll", i4(types.intp, u8, i4))
_ppoll: Any = types.ExternalFunction("ppoll", i4(types.intp, u8, types.intp, types.intp))

DOORS = i4[:, ::1]
SPARE_NS: Final = 500_000
"""Time allowed to Python for a call [ns]; one that comes later before a deadline waits behind its setpoints."""
_MONOTONIC: Final = 1
_ABSOLUTE: Final = 1
"""TIMER_ABSTIME of clock_nanosleep: to a deadline."""
_INTERRUPTED: Final = 4
"""EINTR of errno.h."""
_POLLIN: Final = 1
_SECOND: Final = 1_000_000_000


@compiled()
def now_ns(moment: NDArray[np.int64]) -> int:
    """Return the time of the monotonic clock [ns]; `moment` (2,) is room for a struct timespec."""
    _clock_gettime(_MONOTONIC, moment.ctypes.data)
    return int(moment[0] * _SECOND + moment[1])


@compiled()
def sleep(deadline_ns: int, moment: NDArray[np.int64]) -> None:
    """Sleep until the deadline, through interruptions; `moment` as in `now_ns`."""
    moment[0], moment[1] = deadline_ns // _SECOND, deadline_ns % _SECOND
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, moment.ctypes.data, 0) == _INTERRUPTED:
        pass


@compiled(b1(DOORS))
def called(doors: NDArray[np.int32]) -> bool:
    """Return whether a peer is at a door, or has gone from one; `doors` (n, 2) is an array for poll."""
    return bool(_poll(doors.ctypes.data, np.uint64(len(doors)), 0) != 0)


@compiled(b1(i8, DOORS, i8[::1]), releases=True)
def wait(deadline_ns: int, doors: NDArray[np.int32], moment: NDArray[np.int64]) -> bool:
    """Wait until the deadline or, more than SPARE_NS before it, until a peer is at a door; return whether one is.

    `doors` and `moment` as in `called` and `now_ns`. The two waits are separate: with one call that watches the doors
    until the deadline, ticks come later.
    """
    left = deadline_ns - SPARE_NS - now_ns(moment)
    while left > 0:
        moment[0], moment[1] = left // _SECOND, left % _SECOND
        if _ppoll(doors.ctypes.data, np.uint64(len(doors)), moment.ctypes.data, 0) > 0:
            return True
        left = deadline_ns - SPARE_NS - now_ns(moment)
    sleep(deadline_ns, moment)
    return False


class Doors:
    """Neighbours' doors, for compiled code."""

    def __init__(self, ports: Sequence[Port]) -> None:
        self._ports = ports
        self.room = np.zeros((len(ports), 2), np.int32)
        """Array for poll."""
        self._moment = np.zeros(2, np.int64)

    def refresh(self) -> None:
        """Write the peers that are connected now into the room."""
        for door, port in zip(self.room, self._ports, strict=True):
            door[:] = port.fileno(), _POLLIN

    def called(self) -> bool:
        """Return whether a peer is at a door."""
        self.refresh()
        return bool(called(self.room))

    def wait(self, deadline_ns: int) -> bool:
        """Wait as the function `wait` does."""
        self.refresh()
        return bool(wait(deadline_ns, self.room, self._moment))


class Tick(NamedTuple):
    """One tick."""

    deadline_ns: int
    """Time at which it was due."""
    lateness_ns: int
    """Delay of the tick after that."""
    missed: int
    """Ticks skipped since the one before."""


class Overruns:
    """Counts of missed ticks, of which `allowed` may be in a row."""

    def __init__(self, allowed: int) -> None:
        self.allowed = allowed
        self.all = 0
        """Number since the start."""
        self.in_a_row = 0
        """Number before the newest tick and, if ticks were missed before that as well, before those."""

    def too_many(self, missed: int) -> int:
        """Count the ticks missed before one; return how many are in a row, if that is more than allowed."""
        self.all += missed
        in_a_row = self.in_a_row + missed if missed else 0
        self.in_a_row = in_a_row if in_a_row <= self.allowed else 0
        return in_a_row if in_a_row > self.allowed else 0


def sleep_until(deadline_ns: int) -> None:
    """Sleep to an absolute time of the monotonic clock."""
    remaining = deadline_ns - time.monotonic_ns()
    if remaining > 0:
        time.sleep(remaining * 1e-9)  # CPython sleeps to an absolute deadline: clock_nanosleep, TIMER_ABSTIME


class Ticker:
    """Ticks every `period_ns`; a tick that is missed is skipped and counted, never caught up in a burst."""

    def __init__(
        self,
        period_ns: int,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] = sleep_until,
    ) -> None:
        self._period_ns = period_ns
        self._now = now
        self._sleep = sleep
        self.deadline_ns = now()
        """Time at which the newest tick was due."""

    def come(self) -> int:
        """Sleep to the next deadline by an injected clock, and return its time [ns].

        With the machine's clock, return -1 immediately: the caller can wait for that one by itself.
        """
        if self._now is time.monotonic_ns:
            return -1
        self._sleep_on()
        return self._now()

    def listen(self, doors: Doors) -> bool:
        """Wait for the next deadline or, with time left before it, for a peer at a door; return whether one is."""
        if self._now is time.monotonic_ns:
            return doors.wait(self.deadline_ns + self._period_ns)
        self._sleep_on()
        return doors.called()

    def wait(self) -> Tick:
        """Sleep until the next deadline that is not over yet by a whole period."""
        self._sleep_on()
        self.deadline_ns += self._period_ns
        return self.tick()

    def _sleep_on(self) -> None:
        """Sleep to the next deadline, if it is not over."""
        if self._now() < self.deadline_ns + self._period_ns:
            self._sleep(self.deadline_ns + self._period_ns)

    def tick(self) -> Tick:
        """Return the tick whose deadline has come, after a wait by the caller."""
        lateness_ns = self._now() - self.deadline_ns
        missed = max(0, lateness_ns // self._period_ns)
        self.deadline_ns += missed * self._period_ns
        return Tick(self.deadline_ns, lateness_ns - missed * self._period_ns, missed)
