"""Frames to and from a bus, for compiled code: by libc on the bus' socket, else by functions of Python's."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import i4, i8, types, u8
from numba.extending import intrinsic
from numpy.typing import NDArray
from trirail_drivers.bus.can_frame import CAN_FRAME
from trirail_drivers.driver.cyclic import MOST_FRAMES

from trirail.kinematics.compiled import compiled

__all__ = ["memcpy", "receive_frames", "send_frames"]

# Of libc, by name: sys/socket.h, errno.h, string.h.
_sendmmsg: Any = types.ExternalFunction("sendmmsg", i4(i4, types.intp, types.uint32, i4))
_recvmmsg: Any = types.ExternalFunction("recvmmsg", i4(i4, types.intp, types.uint32, i4, types.intp))
_errno: Any = types.ExternalFunction("__errno_location", types.intp())
memcpy: Any = types.ExternalFunction("memcpy", types.intp(types.intp, types.intp, u8))

_NOTHING_THERE: Final = 11
"""EAGAIN of errno.h."""
_KEPT: Final = -1
"""An error that whoever receives next finds again: the other end has gone, or Python has met one and keeps it."""
_FLAGS: Final = 0x40 | 0x4000
"""MSG_DONTWAIT, MSG_NOSIGNAL."""
_FRAME: Final = CAN_FRAME.size


def _call(_typing: Any, _address: Any, _frames: Any, _number: Any) -> Any:
    """Compile a call of the function at an address with two numbers, which returns one."""

    def build(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        word = ir.IntType(64)
        function = builder.inttoptr(given[0], ir.FunctionType(word, (word, word)).as_pointer())
        return builder.call(function, given[1:])

    return i8(i8, i8, i8), build


_called: Any = intrinsic(_call)


@compiled()
def receive_frames(
    bus: NDArray[np.int64], headers: NDArray[np.uint64], frames: NDArray[np.uint8], room: NDArray[np.int64]
) -> tuple[int, int]:
    """Take what has arrived; return how many frames that are, and the error with which it has failed after them.

    `bus` (3,) is a BusAccess; `headers` and `frames` are of PackedFrames, with room for
    MOST_FRAMES. An error is a number of errno.h; 0 for none, below 0 where whoever receives next finds it again.
    """
    if bus[0] < 0:
        number = _called(bus[1], frames.ctypes.data, MOST_FRAMES)
        return (number, 0) if number >= 0 else (~number, _KEPT)
    number = _recvmmsg(bus[0], headers.ctypes.data, np.uint32(MOST_FRAMES), _FLAGS, 0)
    if number < 0:
        room[0] = 0
        memcpy(room.ctypes.data, _errno(), np.uint64(4))
        return 0, (room[0] if room[0] != _NOTHING_THERE else 0)
    for i in range(number):
        if headers[i, 7] & np.uint64(0xFFFFFFFF) != np.uint64(_FRAME):
            return i, _KEPT
    return number, 0


@compiled()
def send_frames(bus: NDArray[np.int64], headers: NDArray[np.uint64], frames: NDArray[np.uint8]) -> int:
    """Send frames, of PackedFrames; return how many the bus has taken, before the first that it has refused."""
    if len(headers) == 0:
        return 0
    if bus[0] < 0:
        return int(_called(bus[2], frames.ctypes.data, len(headers)))
    return int(max(_sendmmsg(bus[0], headers.ctypes.data, np.uint32(len(headers)), _FLAGS), 0))
