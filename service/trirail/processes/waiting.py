"""Waits for the next tick, and listens at the neighbours' doors meanwhile: compiled, for both ways of the loop.

Who calls with time left before the deadline is heard at once, not a cycle later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numba import b1, i4, i8, types, u8
from numpy.typing import NDArray

from trirail.kinematics.compiled import compiled
from trirail.wire.links import Port

__all__ = ["DOORS", "SPARE_NS", "Doors", "called", "now_ns", "sleep", "wait"]

# Of libc, by name: time.h, poll.h.
_clock_nanosleep: Any = types.ExternalFunction("clock_nanosleep", i4(i4, i4, types.intp, types.intp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", i4(i4, types.intp))
_poll: Any = types.ExternalFunction("poll", i4(types.intp, u8, i4))
_ppoll: Any = types.ExternalFunction("ppoll", i4(types.intp, u8, types.intp, types.intp))

DOORS = i4[:, ::1]
SPARE_NS: Final = 500_000
"""What comes later before a deadline is heard behind that cycle's setpoints: so long Python may take for it [ns]."""
_MONOTONIC: Final = 1
_ABSOLUTE: Final = 1
"""Of clock_nanosleep: to a deadline."""
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
    """Sleep until the deadline, whatever interrupts that; `moment` as of `now_ns`."""
    moment[0], moment[1] = deadline_ns // _SECOND, deadline_ns % _SECOND
    while _clock_nanosleep(_MONOTONIC, _ABSOLUTE, moment.ctypes.data, 0) == _INTERRUPTED:
        pass


@compiled(b1(DOORS))
def called(doors: NDArray[np.int32]) -> bool:
    """Return whether somebody is at a door, or has gone from one; `doors` (n, 2) are as poll takes them."""
    return bool(_poll(doors.ctypes.data, np.uint64(len(doors)), 0) != 0)


@compiled(b1(i8, DOORS, i8[::1]), releases=True)
def wait(deadline_ns: int, doors: NDArray[np.int32], moment: NDArray[np.int64]) -> bool:
    """Wait until the deadline or, more than SPARE_NS before it, until somebody is at a door; return whether he is.

    `doors` and `moment` as of `called` and `now_ns`. Each of the two waits for itself: where one call watches the doors
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
    """The neighbours' doors, as compiled code looks at them."""

    def __init__(self, ports: Sequence[Port]) -> None:
        self._ports = ports
        self._room = np.zeros((len(ports), 2), np.int32)
        self._moment = np.zeros(2, np.int64)

    @property
    def now(self) -> NDArray[np.int32]:
        """As poll takes them, with those who are connected now; the same room each time."""
        for door, port in zip(self._room, self._ports, strict=True):
            door[:] = port.fileno(), _POLLIN
        return self._room

    def called(self) -> bool:
        """Whether somebody is at a door."""
        return bool(called(self.now))

    def wait(self, deadline_ns: int) -> bool:
        """Wait as the function `wait` does."""
        return bool(wait(deadline_ns, self.now, self._moment))
