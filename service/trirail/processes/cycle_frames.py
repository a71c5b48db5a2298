"""Compiled functions that exchange the CAN frames of a cycle.

They send and receive frames, recognise expected frames and encode setpoints. The functions do not depend on any drive
protocol. They use only the tables of trirail_drivers.driver.cyclic, which each driver fills: `axes` (3,) of AXIS,
`expected` (n,) of EXPECTED, `times` (1,) of TIMES, and frames (n, 72) as `struct can_frame` or `struct canfd_frame`.
Frames are sent and received by libc on the socket of the bus. If the bus has no socket, Python functions send and
receive the frames.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import f8, from_dtype, i4, i8, types, u1, u8
from numba.extending import intrinsic
from numpy.typing import NDArray
from trirail_drivers.bus.can_frame import DATA_AT, FRAME_SIZES, LENGTH_AT
from trirail_drivers.driver import row_updates
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET
from trirail_drivers.driver.cyclic import EXPECTED, MOST_FRAMES, TIMES

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.processes.clock import now_ns, sleep

AXES, EXPECTATIONS, TIMINGS = from_dtype(AXIS)[::1], from_dtype(EXPECTED)[::1], from_dtype(TIMES)[::1]
FRAMES = u1[:, ::1]


# Functions of libc, resolved by name: sys/socket.h, errno.h, string.h.
_sendmmsg: Any = types.ExternalFunction("sendmmsg", i4(i4, types.intp, types.uint32, i4))
_recvmmsg: Any = types.ExternalFunction("recvmmsg", i4(i4, types.intp, types.uint32, i4, types.intp))
_errno: Any = types.ExternalFunction("__errno_location", types.intp())
memcpy: Any = types.ExternalFunction("memcpy", types.intp(types.intp, types.intp, u8))

_NOTHING_THERE: Final = 11
"""EAGAIN of errno.h."""
_PERSISTENT_ERROR: Final = -1
"""Error that the next call would return again. The other end has disconnected, or Python has stored an exception."""
_FLAGS: Final = 0x40 | 0x4000
"""MSG_DONTWAIT and MSG_NOSIGNAL of sys/socket.h."""
_FRAME, _FD_FRAME = FRAME_SIZES


def _call(_typing: Any, _address: Any, _frames: Any, _number: Any) -> Any:
    """Generate code that calls the function at an address with two 64-bit integers and returns its integer result."""

    def build(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        function = builder.inttoptr(arguments[0], ir.FunctionType(word, (word, word)).as_pointer())
        return builder.call(function, arguments[1:])

    return i8(i8, i8, i8), build


_called: Any = intrinsic(_call)


@compiled()
def receive_frames(
    bus: NDArray[np.int64], headers: NDArray[np.uint64], frames: NDArray[np.uint8], scratch: NDArray[np.int64]
) -> tuple[int, int]:
    """Receive the frames that have arrived.

    Parameters
    ----------
    bus : (3,)
        BusAccess of the bus.
    headers, frames
        Arrays of a PackedFrames with space for MOST_FRAMES frames.
    scratch : (1,)
        Scratch space.

    Returns
    -------
    number : int
        Number of frames received.
    error : int
        Error after the received frames, as a number of errno.h; 0 if there is none, and negative if the next call would
        return the error again.

    """
    if bus[0] < 0:
        number = _called(bus[1], frames.ctypes.data, MOST_FRAMES)
        return (number, 0) if number >= 0 else (~number, _PERSISTENT_ERROR)
    number = _recvmmsg(bus[0], headers.ctypes.data, np.uint32(MOST_FRAMES), _FLAGS, 0)
    if number < 0:
        scratch[0] = 0
        memcpy(scratch.ctypes.data, _errno(), np.uint64(4))
        return 0, (scratch[0] if scratch[0] != _NOTHING_THERE else 0)
    for i in range(number):
        size = headers[i, 7] & np.uint64(0xFFFFFFFF)
        if size != np.uint64(_FRAME) and size != np.uint64(_FD_FRAME):
            return i, _PERSISTENT_ERROR
    return number, 0


@compiled()
def send_frames(
    bus: NDArray[np.int64], headers: NDArray[np.uint64], frames: NDArray[np.uint8], times: NDArray[np.void]
) -> int:
    """Send the frames of a PackedFrames, and count the duration of the accepted frames as traffic.

    Return the number of frames that were accepted before the first refused frame.
    """
    if len(headers) == 0:
        return 0
    if bus[0] < 0:
        number = int(_called(bus[2], frames.ctypes.data, len(headers)))
    else:
        number = int(max(_sendmmsg(bus[0], headers.ctypes.data, np.uint32(len(headers)), _FLAGS), 0))
    for i in range(number):
        times[0].traffic += times[0].frame_ns[frames[i, LENGTH_AT]]
    return number


@compiled()
def _number(frame: NDArray[np.uint8], at: int, size: int) -> int:
    """Return the unsigned little-endian number of `size` bytes at offset `at`."""
    number = np.int64(0)
    for i in range(size):
        number |= np.int64(frame[at + i]) << (8 * i)
    return int(number)


@compiled()
def _signed(number: int) -> int:
    """Convert an unsigned 32-bit number to the signed number with the same bits."""
    return number - (1 << 32) if number >> 31 else number


# The drivers run these functions as Python.
_count_sync: Any = compiled()(row_updates.count_sync)
_end_reading: Any = compiled()(row_updates.end_reading)
_answered_sync: Any = compiled()(row_updates.answered_sync)
_unanswered: Any = compiled()(row_updates.unanswered)
_accept_answer: Any = compiled()(row_updates.accept_answer)
_turns_back: Any = compiled()(row_updates.turns_back)
_is_far: Any = compiled()(row_updates.is_far)
_accept_counts: Any = compiled()(row_updates.accept_counts)
_accept_turns: Any = compiled()(row_updates.accept_turns)
_accept_statusword: Any = compiled()(row_updates.accept_statusword)
_due_setpoint: Any = compiled()(row_updates.due_setpoint)
_scale_setpoint: Any = compiled()(row_updates.scale_setpoint)
_put_setpoint: Any = compiled()(row_updates.put_setpoint)
_outputs_pending: Any = compiled()(row_updates.outputs_pending)
_put_outputs: Any = compiled()(row_updates.put_outputs)
_note_outputs: Any = compiled()(row_updates.note_outputs)


@compiled()
def _accept_position(axis: Any, frame: NDArray[np.uint8], at: int, now: float) -> bool:
    """Store the position at an offset of a frame.

    Return False, and store nothing, if Python must handle the frame: the position is not finite, or it is the second in
    this cycle and may come from another node.
    """
    if axis.floats:
        turns = float(frame[at : at + 4].view(np.float32)[0])
        if not math.isfinite(turns) or (axis.came and _is_far(axis, turns)):
            return False
        _accept_turns(axis, turns)
    else:
        counts = _signed(_number(frame, at, 4))
        if axis.came and (_turns_back(axis, counts) or _is_far(axis, counts)):
            return False
        _accept_counts(axis, counts, now)
    _accept_answer(axis, _answered_sync(axis))
    return True


@compiled(i8(FRAMES, i8, EXPECTATIONS, AXES, TIMINGS, f8))
def process_frames(
    frames: NDArray[np.uint8],
    number: int,
    expected: NDArray[np.void],
    axes: NDArray[np.void],
    times: NDArray[np.void],
    now: float,
) -> int:
    """Process received frames up to the first unexpected frame; return the number of processed frames.

    A frame is unexpected if its identifier, its length or its masked data match no row of `expected`, or if its
    position may come from another node. The caller passes the unexpected frame and all later frames to Python.

    Parameters
    ----------
    frames : (n, 72)
        Frames, of which the first `number` have been received.
    now : float
        Time of reception [s].

    """
    for i in range(number):
        frame = frames[i]
        identifier, length, known = _number(frame, 0, 4), frame[LENGTH_AT], NO_OFFSET
        for k in range(len(expected)):
            if expected[k].identifier == identifier and expected[k].length == length:
                known = k
        if known == NO_OFFSET:
            return i
        row = expected[known]
        for k in range(length):
            if frame[DATA_AT + k] & row.mask[k] != row.data[k]:
                return i
        axis = axes[row.axis]
        if row.position_at != NO_OFFSET and not _accept_position(axis, frame, DATA_AT + row.position_at, now):
            return i
        if row.status_at != NO_OFFSET:
            _accept_statusword(axis, _number(frame, DATA_AT + row.status_at, 2), now)
        if row.lives:
            axis.heard = now
        times[0].traffic += times[0].frame_ns[length]
    return number


@compiled()
def begin_cycle(axes: NDArray[np.void], history: Array) -> None:
    """Record that the SYNC has been sent, and that setpoints which take effect at a SYNC are now in force."""
    for i in range(3):
        axis = axes[i]
        _count_sync(axis)
        if len(history):
            history[axis.syncs % len(history), i] = axis.sent
        if axis.waits:
            axis.sent, axis.sent_rate = axis.wanted, axis.wanted_rate
            axis.in_force = axis.wanted


@compiled(i8(AXES, TIMINGS, f8[:, ::1], f8))
def end_read(axes: NDArray[np.void], times: NDArray[np.void], history: Array, now: float) -> int:
    """Conclude the reading of a cycle's frames if no drive is silent for too long and all follow their setpoints.

    Return True in that case; otherwise change nothing and return False.
    """
    for i in range(3):
        axis = axes[i]
        if _unanswered(axis) >= axis.missed_limit or now - axis.heard > axis.heard_within:
            return False
        if now - axis.status_heard > axis.status_within:
            return False
        monitored = len(history) and math.isfinite(axis.follows_within)
        if monitored and not abs(_due_setpoint(axis, history[:, i]) - axis.position) <= axis.follows_within:
            return False
    if not now < times[0].off_deadline:
        return False
    for i in range(3):
        _end_reading(axes[i])
    return True


@compiled(i8(FRAMES, AXES, f8[:, ::1]))
def set_frames(frames: NDArray[np.uint8], axes: NDArray[np.void], sent: Array) -> int:
    """Write setpoints into frames. `sent` has a row of positions [m] and a row of velocities [m/s].

    Return False if a setpoint is outside the range of its field in the frame.
    """
    for i in range(3):
        axis = axes[i]
        if not _scale_setpoint(axis, sent[0, i], sent[1, i]):
            return False
        _put_setpoint(axis, frames[i, DATA_AT:])
        axis.wanted, axis.wanted_rate = sent[0, i], sent[1, i]
    return True


@compiled()
def needs_python(axes: NDArray[np.void]) -> bool:
    """Return True if an output has changed on a drive that accepts outputs only by SDO, which Python sends."""
    needed = False
    for i in range(3):
        needed = needed or (not axes[i].maps_outputs and _outputs_pending(axes[i]))
    return needed


@compiled()
def send_outputs(
    bus: NDArray[np.int64],
    headers: NDArray[np.uint64],
    frames: NDArray[np.uint8],
    axes: NDArray[np.void],
    times: NDArray[np.void],
) -> bool:
    """Send the outputs that have changed or must be repeated, in one frame per drive.

    Return True if the bus has accepted all frames.

    `headers` and `frames` are the arrays of a PackedFrames with one frame per drive, or are empty.
    """
    for i in range(len(headers)):
        axis = axes[i]
        if axis.maps_outputs and _outputs_pending(axis):
            _put_outputs(axis, frames[i, DATA_AT:])
            if not send_frames(bus, headers[i : i + 1], frames[i : i + 1], times):
                return False
            _note_outputs(axis)
    return True


@compiled()
def exchange_frames(
    bus: NDArray[np.int64],
    period_ns: int,
    begin: NDArray[np.uint64],
    starts: NDArray[np.uint8],
    departures: NDArray[np.uint64],
    setpoints: NDArray[np.uint8],
    arrivals: NDArray[np.uint64],
    arrived: NDArray[np.uint8],
    times: NDArray[np.void],
    moment: NDArray[np.int64],
    lateness: NDArray[np.int64],
    work: NDArray[np.int64],
) -> int:
    """Run cycles that only exchange frames, to measure the speed of the machine; return the number of received frames.

    Parameters
    ----------
    lateness : (n,)
        Receives the delay of each cycle's start, including the ticks that were missed before it [ns].
    work : (n,)
        Receives the time from each cycle's start until its setpoints were sent [ns].

    """
    number, deadline_ns = 0, now_ns(moment)
    for k in range(len(lateness)):
        deadline_ns += period_ns
        sleep(deadline_ns, moment)
        began_ns = now_ns(moment)
        send_frames(bus, begin, starts, times)
        number += receive_frames(bus, arrivals, arrived, moment)[0]
        send_frames(bus, departures, setpoints, times)
        lateness[k], work[k] = began_ns - deadline_ns, now_ns(moment) - began_ns
        deadline_ns += lateness[k] // period_ns * period_ns
    return number
