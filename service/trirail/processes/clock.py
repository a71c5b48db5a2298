"""Ticks of the loop at a fixed rate, on absolute deadlines of the monotonic clock.

A neighbour is a process that is connected to the loop. A neighbour calls when it sends a packet or disconnects.
Compiled code notices a call during its wait for the next tick, and lets Python decide beside the next cycle. Cycles in
Python read the neighbours' packets after each cycle.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numba import b1, i4, i8, types, u8
from numpy.typing import NDArray

from trirail.kinematics.compiled import compiled
from trirail.wire.links import Port

# Functions of libc, resolved by name: time.h, poll.h.
_clock_nanosleep: Any = types.ExternalFunction("clock_nanosleep", i4(i4, i4, types.intp, types.intp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", i4(i4, types.intp))
_poll: Any = types.ExternalFunction("poll", i4(types.intp, u8, i4))
_ppoll: Any = types.ExternalFunction("ppoll", i4(types.intp, u8, types.intp, types.intp))

POLLFDS = i4[:, ::1]
_MONOTONIC: Final = 1
_ABSOLUTE: Final = 1
"""TIMER_ABSTIME of clock_nanosleep(2)."""
_INTERRUPTED: Final = 4
"""EINTR of errno.h."""
_POLLIN: Final = 1
_SECOND: Final = 1_000_000_000
MIN_SUSPENSION_S: Final = 0.1
"""Shortest suspension of the computer that is detected [s]."""


@compiled()
def now_ns(moment: NDArray[np.int64]) -> int:
    """Return the time of the monotonic clock [ns]; `moment` (2,) is memory for a struct timespec."""
    _clock_gettime(_MONOTONIC, moment.ctypes.data)
    return int(moment[0] * _SECOND + moment[1])


@compiled()
def sleep(deadline_ns: int, moment: NDArray[np.int64]) -> None:
    """Sleep until the deadline, even if signals interrupt the sleep; `moment` is the same as for `now_ns`.

    A sleep to a time that has passed would still take as long as the kernel needs to wake up a thread, 25 µs or more.
    """
    if now_ns(moment) >= deadline_ns:
        return
    moment[0], moment[1] = deadline_ns // _SECOND, deadline_ns % _SECOND
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, moment.ctypes.data, 0) == _INTERRUPTED:
        pass


@compiled()
def busy_wait(deadline_ns: int, moment: NDArray[np.int64]) -> int:
    """Read the clock until the deadline, and return the time [ns]; `moment` is the same as for `now_ns`.

    A thread that sleeps until the deadline wakes up some 20 µs late, and not always by the same time.
    """
    now = now_ns(moment)
    while now < deadline_ns:
        now = now_ns(moment)
    return int(now)


@compiled(b1(POLLFDS))
def called(pollfds: NDArray[np.int32]) -> bool:
    """Return True if a neighbour has called; `pollfds` (n, 2) is an array of struct pollfd."""
    return bool(_poll(pollfds.ctypes.data, np.uint64(len(pollfds)), 0) != 0)


@compiled(b1(i8, POLLFDS, i8[::1]))
def wait_for_call(deadline_ns: int, pollfds: NDArray[np.int32], moment: NDArray[np.int64]) -> bool:
    """Wait until a neighbour calls, but not longer than until the deadline. Return True if a neighbour has called.

    Parameters
    ----------
    deadline_ns : int
        Time of the monotonic clock [ns].
    pollfds : (n, 2)
        Sockets of the neighbours, as for `called`.
    moment : (2,)
        Memory for a struct timespec.

    """
    left = deadline_ns - now_ns(moment)
    while left > 0:
        moment[0], moment[1] = left // _SECOND, left % _SECOND
        if _ppoll(pollfds.ctypes.data, np.uint64(len(pollfds)), moment.ctypes.data, 0) > 0:
            return True
        left = deadline_ns - now_ns(moment)
    return False


class PollSet:
    """Sockets of the neighbours, in an array that compiled code can poll."""

    def __init__(self, ports: Sequence[Port]) -> None:
        self._ports = ports
        self.pollfds = np.zeros((len(ports), 2), np.int32)
        """Array of struct pollfd."""

    def refresh(self) -> None:
        """Update the array with the descriptors of the present connections."""
        for pollfd, port in zip(self.pollfds, self._ports, strict=True):
            pollfd[:] = port.fileno(), _POLLIN


class Tick(NamedTuple):
    """One tick of the loop."""

    deadline_ns: int
    """Time at which the tick was due [ns]."""
    lateness_ns: int
    """Delay of the tick after its deadline [ns]."""
    missed: int
    """Number of ticks skipped before this one."""


class Overruns:
    """Counter of missed ticks. `allowed` is the maximum number of consecutive missed ticks that is tolerated."""

    def __init__(self, allowed: int) -> None:
        self.allowed = allowed
        self.all = 0
        """Number of missed ticks since the start."""
        self.in_a_row = 0
        """Number of consecutive missed ticks, up to the newest tick."""

    def count(self, missed: int) -> None:
        """Count the ticks that were missed before the present tick. Too many in a row are remembered for `too_many`."""
        self.all += missed
        self.in_a_row = self.in_a_row + missed if missed or self.in_a_row > self.allowed else 0

    def too_many(self, missed: int) -> int:
        """Count the ticks that were missed before the present tick.

        Return the number of consecutive missed ticks if it exceeds `allowed`, and start counting again; else return 0.
        """
        self.count(missed)
        if self.in_a_row <= self.allowed:
            return 0
        in_a_row, self.in_a_row = self.in_a_row, 0
        return in_a_row


def asleep_s() -> float:
    """Return how long the computer has been suspended since it was booted, or slightly less [s]."""
    booted_for = time.clock_gettime(time.CLOCK_BOOTTIME)
    return booted_for - time.monotonic()


class Suspensions:
    """Detector of suspensions of the computer.

    The monotonic clock does not count the time in which the computer is suspended, so no tick is late afterwards.
    `asleep_s` returns the sum of these times since the computer was booted [s].
    """

    def __init__(self, asleep_s: Callable[[], float] = asleep_s) -> None:
        self._asleep_s = asleep_s
        self._known_s = asleep_s()
        self._suspended_s = 0.0

    def occurred(self) -> bool:
        """Return True if the computer has been suspended since `pop_duration` was called last."""
        asleep_s = self._asleep_s()
        if asleep_s > self._known_s + MIN_SUSPENSION_S:
            self._suspended_s += asleep_s - self._known_s
        self._known_s = max(self._known_s, asleep_s)
        return self._suspended_s > 0.0

    def pop_duration(self) -> float:
        """Return the duration of the suspensions since the last call [s]; 0 if there were none."""
        self.occurred()
        suspended_s, self._suspended_s = self._suspended_s, 0.0
        return suspended_s


def sleep_until(deadline_ns: int, busy_wait_ns: int = 0) -> None:
    """Sleep until an absolute time of the monotonic clock [ns], but read the clock for the last `busy_wait_ns`."""
    remaining = deadline_ns - busy_wait_ns - time.monotonic_ns()
    if remaining > 0:
        time.sleep(remaining * 1e-9)  # CPython converts this to an absolute deadline: clock_nanosleep, TIMER_ABSTIME
    while time.monotonic_ns() < deadline_ns:
        pass


class Ticker:
    """Source of a tick every `period_ns`. Missed ticks are skipped and counted; no burst of ticks follows."""

    def __init__(
        self,
        period_ns: int,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[int], None] | None = None,
        busy_wait_ns: int = 0,
    ) -> None:
        self._period_ns = period_ns
        self._now = now
        self._sleep = sleep or partial(sleep_until, busy_wait_ns=busy_wait_ns)
        self.deadline_ns = now()
        """Time at which the newest tick was due [ns]."""

    def sleep_if_injected(self) -> int:
        """If the clock was injected, sleep until the next deadline and return the time of the clock [ns].

        With the machine's own clock, return -1 immediately, because compiled code waits for that clock itself.
        """
        if self._now is time.monotonic_ns:
            return -1
        self._sleep_to_next()
        return self._now()

    def wait(self) -> Tick:
        """Sleep until the next deadline and return its tick. Skip ticks that were missed by a whole period or more."""
        self._sleep_to_next()
        self.deadline_ns += self._period_ns
        return self.tick()

    def _sleep_to_next(self) -> None:
        """Sleep until the next deadline, if it is in the future."""
        if self._now() < self.deadline_ns + self._period_ns:
            self._sleep(self.deadline_ns + self._period_ns)

    def tick(self) -> Tick:
        """Return the tick that is due, once it is due."""
        if self._now() < self.deadline_ns:
            self._sleep(self.deadline_ns)
        lateness_ns = self._now() - self.deadline_ns
        missed = max(0, lateness_ns // self._period_ns)
        self.deadline_ns += missed * self._period_ns
        return Tick(self.deadline_ns, lateness_ns - missed * self._period_ns, missed)
