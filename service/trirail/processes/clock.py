"""Fixed-rate ticks on absolute deadlines of the monotonic clock; messages that arrive during a wait end it early.

A neighbour is a process connected to the loop; it calls by sending a packet or by disconnecting. A call that arrives
early enough before the deadline is served immediately, not a cycle later. The wait is compiled, and used by the Python
cycle and the compiled one alike.
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

# Functions of libc, resolved by name: time.h, poll.h.
_clock_nanosleep: Any = types.ExternalFunction("clock_nanosleep", i4(i4, i4, types.intp, types.intp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", i4(i4, types.intp))
_poll: Any = types.ExternalFunction("poll", i4(types.intp, u8, i4))
_ppoll: Any = types.ExternalFunction("ppoll", i4(types.intp, u8, types.intp, types.intp))

POLLFDS = i4[:, ::1]
SPARE_NS: Final = 500_000
"""Time that Python needs to serve a call [ns]; with less time before the deadline, a call waits for the next cycle."""
_MONOTONIC: Final = 1
_ABSOLUTE: Final = 1
"""TIMER_ABSTIME of clock_nanosleep(2)."""
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
    """Sleep until the deadline and resume after interruptions; `moment` is as in `now_ns`."""
    moment[0], moment[1] = deadline_ns // _SECOND, deadline_ns % _SECOND
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, moment.ctypes.data, 0) == _INTERRUPTED:
        pass


@compiled(b1(POLLFDS))
def called(pollfds: NDArray[np.int32]) -> bool:
    """Return whether a neighbour has called; `pollfds` (n, 2) is an array of struct pollfd."""
    return bool(_poll(pollfds.ctypes.data, np.uint64(len(pollfds)), 0) != 0)


@compiled(b1(i8, POLLFDS, i8[::1]), releases=True)
def wait(deadline_ns: int, pollfds: NDArray[np.int32], moment: NDArray[np.int64]) -> bool:
    """Wait for the deadline or for a call more than SPARE_NS before it; return whether there is a call.

    Parameters
    ----------
    deadline_ns : int
        Time of the monotonic clock [ns].
    pollfds : (n, 2)
        Sockets of the neighbours, as in `called`.
    moment : (2,)
        Room for a struct timespec.

    """
    # Two separate waits: one ppoll that watches the sockets until the deadline wakes up later than clock_nanosleep.
    left = deadline_ns - SPARE_NS - now_ns(moment)
    while left > 0:
        moment[0], moment[1] = left // _SECOND, left % _SECOND
        if _ppoll(pollfds.ctypes.data, np.uint64(len(pollfds)), moment.ctypes.data, 0) > 0:
            return True
        left = deadline_ns - SPARE_NS - now_ns(moment)
    sleep(deadline_ns, moment)
    return False


class PollSet:
    """Sockets of the neighbours, to poll in compiled code."""

    def __init__(self, ports: Sequence[Port]) -> None:
        self._ports = ports
        self.pollfds = np.zeros((len(ports), 2), np.int32)
        """Array of struct pollfd."""
        self._moment = np.zeros(2, np.int64)

    def refresh(self) -> None:
        """Update the array with the present connections."""
        for pollfd, port in zip(self.pollfds, self._ports, strict=True):
            pollfd[:] = port.fileno(), _POLLIN

    def called(self) -> bool:
        """Return whether a neighbour calls."""
        self.refresh()
        return bool(called(self.pollfds))

    def wait(self, deadline_ns: int) -> bool:
        """Wait for the deadline or an early call, like the function `wait`."""
        self.refresh()
        return bool(wait(deadline_ns, self.pollfds, self._moment))


class Tick(NamedTuple):
    """One tick of the loop."""

    deadline_ns: int
    """Time at which the tick was due [ns]."""
    lateness_ns: int
    """Delay of the tick after its deadline [ns]."""
    missed: int
    """Number of ticks skipped before this one."""


class Overruns:
    """Counter of missed ticks, with a limit `allowed` on consecutive ones."""

    def __init__(self, allowed: int) -> None:
        self.allowed = allowed
        self.all = 0
        """Number of missed ticks since the start."""
        self.in_a_row = 0
        """Number of consecutive missed ticks, up to the newest tick."""

    def too_many(self, missed: int) -> int:
        """Count the ticks missed before a tick; return the consecutive ones if they exceed the limit, else 0."""
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
    """Source of ticks every `period_ns`; a missed tick is skipped and counted, never caught up in a burst."""

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

    def sleep_if_injected(self) -> int:
        """Sleep until the next deadline of an injected clock, and return its time [ns].

        Return -1 immediately for the machine's clock, since compiled code waits for that clock itself.
        """
        if self._now is time.monotonic_ns:
            return -1
        self._sleep_to_next()
        return self._now()

    def listen(self, poll_set: PollSet) -> bool:
        """Wait for the next deadline or an early call; return whether there is a call."""
        if self._now is time.monotonic_ns:
            return poll_set.wait(self.deadline_ns + self._period_ns)
        self._sleep_to_next()
        return poll_set.called()

    def wait(self) -> Tick:
        """Sleep until the next deadline, skipping those missed by a whole period or more."""
        self._sleep_to_next()
        self.deadline_ns += self._period_ns
        return self.tick()

    def _sleep_to_next(self) -> None:
        """Sleep until the next deadline, if it is in the future."""
        if self._now() < self.deadline_ns + self._period_ns:
            self._sleep(self.deadline_ns + self._period_ns)

    def tick(self) -> Tick:
        """Return the tick that is due, after the caller has waited for it."""
        lateness_ns = self._now() - self.deadline_ns
        missed = max(0, lateness_ns // self._period_ns)
        self.deadline_ns += missed * self._period_ns
        return Tick(self.deadline_ns, lateness_ns - missed * self._period_ns, missed)
