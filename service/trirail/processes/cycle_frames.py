"""Frames of a cycle, for compiled code: sending, receiving, detecting anything new, and encoding setpoints.

It knows no protocol, only the tables of trirail_drivers.driver.cyclic: `axes` (3,) of AXIS, `expected` (n,) of
EXPECTED, `times` (1,) of TIMES, and frames (n, 16) as `struct can_frame`. A driver's use of them is in its axes.
Frames are exchanged by libc on the bus' socket, or by Python functions if the bus has none.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import f8, from_dtype, i4, i8, types, u1, u8
from numba.extending import intrinsic
from numpy.typing import NDArray
from trirail_drivers.bus.can_frame import CAN_FRAME, DATA_AT
from trirail_drivers.bus.frames import BITS
from trirail_drivers.driver.axis_row import AXIS, NO_OFFSET
from trirail_drivers.driver.cyclic import EXPECTED, MOST_FRAMES, TIMES
from trirail_drivers.driver.scaling import INT32_MAX

from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.processes.clock import now_ns, sleep

AXES, EXPECTATIONS, TIMINGS = from_dtype(AXIS)[::1], from_dtype(EXPECTED)[::1], from_dtype(TIMES)[::1]
FRAMES = u1[:, ::1]
LENGTH_AT = 4
"""Offset of the data length in a frame."""


# Of libc, by name: sys/socket.h, errno.h, string.h.
_sendmmsg: Any = types.ExternalFunction("sendmmsg", i4(i4, types.intp, types.uint32, i4))
_recvmmsg: Any = types.ExternalFunction("recvmmsg", i4(i4, types.intp, types.uint32, i4, types.intp))
_errno: Any = types.ExternalFunction("__errno_location", types.intp())
memcpy: Any = types.ExternalFunction("memcpy", types.intp(types.intp, types.intp, u8))

_NOTHING_THERE: Final = 11
"""EAGAIN of errno.h."""
_KEPT: Final = -1
"""Error that the next receiver meets again: the other end has gone, or Python has caught one and keeps it."""
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
    """Receive the frames that have arrived; return their number, and the error that followed them.

    `bus` (3,) is a BusAccess; `headers` and `frames` are of PackedFrames, with room for
    MOST_FRAMES. An error is a number of errno.h; 0 for none, below 0 if the next receiver meets it again.
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
def send_frames(
    bus: NDArray[np.int64], headers: NDArray[np.uint64], frames: NDArray[np.uint8], times: NDArray[np.void]
) -> int:
    """Send frames, of PackedFrames, and count the bits that they take of the bus.

    Return how many it has accepted, before the first that it has refused.
    """
    if len(headers) == 0:
        return 0
    if bus[0] < 0:
        number = int(_called(bus[2], frames.ctypes.data, len(headers)))
    else:
        number = int(max(_sendmmsg(bus[0], headers.ctypes.data, np.uint32(len(headers)), _FLAGS), 0))
    for i in range(number):
        times[0].traffic += BITS[frames[i, LENGTH_AT]]
    return number


@compiled()
def _number(frame: NDArray[np.uint8], at: int, size: int) -> int:
    """Return the unsigned little-endian number of `size` bytes."""
    number = np.int64(0)
    for i in range(size):
        number |= np.int64(frame[at + i]) << (8 * i)
    return int(number)


@compiled()
def _signed(number: int) -> int:
    """Return 32 bits as a signed number."""
    return number - (1 << 32) if number >> 31 else number


@compiled()
def _answers_in_time(axis: Any) -> bool:
    """Count a position as the answer to a SYNC, as trirail_drivers.driver.axis.Answers.answer does.

    Return False, and count nothing, for the second answer to a SYNC, and where one has been late or lost.
    """
    to_the_one_before = not axis.between and not axis.prompt and axis.sampled < axis.syncs - 1
    sampled = axis.syncs - to_the_one_before
    late = axis.prompt and axis.between and sampled > axis.sampled
    if axis.came or late or sampled - axis.sampled > 1:
        return False
    axis.came, axis.sampled, axis.prompt = True, sampled, not axis.between and not to_the_one_before
    return True


@compiled()
def _take_position(axis: Any, counts: int, now: float) -> bool:
    """Accept a position [counts]; return False, and change nothing, if `_answers_in_time` does."""
    if not _answers_in_time(axis):
        return False
    if abs(counts - axis.stands_at) > axis.still:
        axis.stands_at, axis.stands_since = counts, now
    axis.stands_since = min(axis.stands_since, now)
    step = counts - axis.newest
    if step:
        axis.step = step
    axis.newest, axis.actual = counts, counts
    axis.position = counts / axis.counts_per_metre + axis.zero
    return True


@compiled()
def _take_turns(axis: Any, turns: float) -> bool:
    """Accept a position [turns]; return False, and change nothing, if it is not finite or `_answers_in_time` does."""
    if not math.isfinite(turns) or not _answers_in_time(axis):
        return False
    axis.position = turns / axis.counts_per_metre + axis.zero
    return True


@compiled(i8(FRAMES, i8, EXPECTATIONS, AXES, TIMINGS, f8))
def take_frames(
    frames: NDArray[np.uint8],
    number: int,
    expected: NDArray[np.void],
    axes: NDArray[np.void],
    times: NDArray[np.void],
    now: float,
) -> int:
    """Process frames received by a time [s] up to the first that holds anything new; return how many.

    The frames from that one on are untouched: the caller continues there.
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
        if row.position_at != NO_OFFSET:
            at = DATA_AT + row.position_at
            if axis.floats:
                if not _take_turns(axis, float(frames[i, at : at + 4].view(np.float32)[0])):
                    return i
            elif not _take_position(axis, _signed(_number(frame, at, 4)), now):
                return i
        if row.status_at != NO_OFFSET:
            axis.statusword = _number(frame, DATA_AT + row.status_at, 2)
            axis.seen_clear |= ~axis.statusword
            axis.status_heard = now
        if row.lives:
            axis.heard = now
        times[0].traffic += BITS[length]
    return number


@compiled()
def begin_cycle(axes: NDArray[np.void], history: Array) -> None:
    """Record that the SYNC has been sent, with the setpoints that waited for it."""
    for i in range(3):
        axis = axes[i]
        axis.syncs += 1
        axis.between = False
        axis.command_age += 1
        if len(history):
            history[axis.syncs % len(history), i] = axis.sent
        if axis.waits:
            axis.sent, axis.sent_rate = axis.wanted, axis.wanted_rate
            axis.in_force = axis.wanted


@compiled(i8(AXES, TIMINGS, f8[:, ::1], f8))
def end_read(axes: NDArray[np.void], times: NDArray[np.void], history: Array, now: float) -> int:
    """Record that the frames of a cycle are in, if every drive has sent all that it should, and follows.

    Return whether that is so; else do nothing.
    """
    for i in range(3):
        axis = axes[i]
        age = axis.syncs - axis.sampled
        if age - (not axis.prompt) or now - axis.heard > axis.heard_within:
            return False
        if now - axis.status_heard > axis.status_within:
            return False
        if len(history) and math.isfinite(axis.follows_within):
            due = history[(axis.syncs - min(age, len(history) - 1)) % len(history), i]
            if not abs(due - axis.position) <= axis.follows_within:
                return False
    if not now < times[0].due:
        return False
    for i in range(3):
        axes[i].between, axes[i].came = True, False
    return True


@compiled()
def _put(frame: NDArray[np.uint8], at: int, number: int, size: int) -> None:
    """Write `size` bytes, little-endian."""
    for i in range(size):
        frame[DATA_AT + at + i] = (number >> (8 * i)) & 0xFF


@compiled(i8(FRAMES, AXES, f8[:, ::1]))
def set_frames(frames: NDArray[np.uint8], axes: NDArray[np.void], sent: Array) -> int:
    """Write setpoints, rows of positions [m] and velocities [m/s], into frames; return False if one does not fit."""
    for i in range(3):
        axis = axes[i]
        counts = axis.counts_per_metre * (sent[0, i] - axis.zero)
        if axis.floats:
            at = DATA_AT + axis.position_at
            frames[i, at : at + 4].view(np.float32)[0] = counts
            if not math.isfinite(frames[i, at : at + 4].view(np.float32)[0]):
                return False
        else:
            counts = np.rint(counts)
            if not abs(counts) <= INT32_MAX:
                return False
            axis.target, axis.offset = np.int64(counts), 0
            _put(frames[i], axis.position_at, axis.target, 4)
        if axis.velocity_at != NO_OFFSET:
            offset = np.rint(axis.velocity_per_metre * sent[1, i] / axis.velocity_step)
            if not abs(offset) <= (1 << (8 * axis.velocity_bytes - 1)) - 1:
                return False
            axis.offset = np.int64(offset)
            _put(frames[i], axis.velocity_at, axis.offset, axis.velocity_bytes)
        axis.wanted, axis.wanted_rate = sent[0, i], sent[1, i]
    return True


@compiled()
def needs_python(axes: NDArray[np.void], words: NDArray[np.int64]) -> bool:
    """Whether wanted outputs, words (3,) of bits of 60FEh, differ from those of a drive that takes them by SDO only."""
    for i in range(3):
        axis = axes[i]
        if axis.has_outputs and not axis.maps_outputs and words[i] != axis.outputs_sent:
            return True
    return False


@compiled()
def send_outputs(
    bus: NDArray[np.int64],
    headers: NDArray[np.uint64],
    frames: NDArray[np.uint8],
    axes: NDArray[np.void],
    times: NDArray[np.void],
) -> bool:
    """Send the outputs that differ from those sent last, each in the frame of its drive, up to the first refused one.

    Return whether the bus has accepted all. `headers` and `frames` are of PackedFrames, a frame for each drive or none.
    """
    for i in range(len(headers)):
        axis = axes[i]
        if axis.has_outputs and axis.maps_outputs and axis.outputs != axis.outputs_sent:
            _put(frames[i], 0, axis.outputs | axis.outputs_kept, 4)
            if not send_frames(bus, headers[i : i + 1], frames[i : i + 1], times):
                return False
            axis.outputs_sent = axis.outputs
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
    """Run cycles that exchange frames and compute nothing, to measure the machine; return the frames received.

    Parameters
    ----------
    lateness : (n,)
        Delay of each cycle's start, including the ticks missed before it [ns].
    work : (n,)
        Time from there until the setpoints of each cycle were sent [ns].

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
