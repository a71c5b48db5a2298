"""Times at which a cycle's frames are on a SocketCAN bus, from the kernel's timestamps of the frames sent here.

If a service runs on the interface, its frames are only listened to. Otherwise, test frames replace them: a bare loop
sends frames of the same lengths, with identifiers that no drive uses, so that no drive reacts. Nothing is sent on a bus
that another master may be using.
"""

from __future__ import annotations

import itertools
import socket
import time
from collections import Counter
from collections.abc import Callable, Container, Sequence
from typing import Final, Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.loopback import Loopback, StampedFrame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames, packed_frames
from trirail_drivers.driver.cyclic import MOST_FRAMES, TIMES
from trirail_drivers.interface import NAMES
from trirail_drivers.timing import BusTiming

from trirail.config import LoopTable
from trirail.diagnosis.cycle_timing import compute_percentiles
from trirail.wire.state import Percentiles

LISTENING_S: Final = 5.0
"""Time for which the frames of a service are listened to [s]."""
WAITING_S: Final = 1.5
"""Time after which a bus without SYNC counts as one without a service [s]: longer than the period at 1 Hz."""
SENDING_S: Final = 5.0
"""Time for which test frames are sent [s]."""
SENT_WITHIN_S: Final = 0.5
"""Time within which the controller must have sent a test frame [s]."""
MAX_IDLE_LOAD: Final = 0.01
"""Fraction of the bus capacity up to which the bus counts as idle, so that test frames may be sent: heartbeats."""
BATCH_CYCLES: Final = 50
"""Cycles with test frames after which the timestamps are collected, before the socket's buffer is full."""

TEST_FRAMES: Final = tuple(0x788 + 0x20 * i for i in range(len(NAMES)))
"""Identifiers of the test frames.

CiA 301 reserves 780h to 7FFh, so that no CANopen device uses them. For ODrives, they are command 8 of nodes 60 to 62,
which CANSimple does not define. These identifiers are last in arbitration, and delay other frames least.
"""

Source = Literal["service", "test frames"]


class BareBus:
    """Buffers and socket with which trirail.processes.cycle_frames exchanges the frames of a cycle."""

    def __init__(self, descriptor: int, sync: Frame, setpoints: Sequence[Frame]) -> None:
        """`sync` is sent at the start of each cycle, `setpoints` at its end."""
        self._bus = np.array(BusAccess(descriptor), np.int64)
        self._sync, self._setpoints = packed_frames([sync]), packed_frames(setpoints)
        self._arrived = PackedFrames(MOST_FRAMES)
        self._times, self._moment = np.zeros(1, TIMES), np.zeros(2, np.int64)
        nothing = np.zeros(0, np.int64)
        self.exchange(1, nothing, nothing)  # compiles, so that the first cycle is not delayed

    def exchange(self, period_ns: int, lateness: NDArray[np.int64], work: NDArray[np.int64]) -> int:
        """Run n cycles, and write their times to `lateness` and `work`, (n,) each [ns].

        Return the number of frames received.
        """
        # Imported here, because compiled code takes seconds to load and only a measurement needs it.
        from trirail.processes.cycle_frames import exchange_frames

        sync, setpoints, arrived = self._sync, self._setpoints, self._arrived
        sent = sync.headers, sync.frames, setpoints.headers, setpoints.frames
        memory = arrived.headers, arrived.frames, self._times, self._moment
        return exchange_frames(self._bus, period_ns, *sent, *memory, lateness, work)


class MeasuredTiming(Struct, frozen=True):
    """Times of cycles on the bus, in a form for programs; times are in microseconds."""

    source: Source
    """Sender of the measured frames."""
    timestamps: Literal["hardware", "software"]
    """Origin of the timestamps: the CAN controller or the kernel."""
    rate_hz: int
    syncs: int
    """Number of SYNCs."""
    interval_error_us: Percentiles
    """Absolute difference between the interval from one SYNC to the next and the period."""
    setpoints_us: Percentiles | None
    """Time from a SYNC to the last setpoint of its cycle; None if no setpoints were sent."""
    without_setpoints: int
    """Number of cycles in which a setpoint was missing when the next SYNC was sent."""


def compute_timing(
    runs: Sequence[Sequence[StampedFrame]], source: Source, sync: int, setpoints: Container[int]
) -> MeasuredTiming | None:
    """Compute the timing from the frames that this machine has sent; return None without two SYNCs in a row.

    Parameters
    ----------
    runs
        Uninterrupted runs of frames.
    sync
        Identifier of SYNC, which is a frame without setpoints.
    setpoints
        Identifiers that setpoints may have. Those that are sent in most cycles are the setpoints.

    """
    sent = [sorted((frame for frame in run if frame.is_local), key=lambda frame: frame.t) for run in runs]
    syncs = [[frame.t for frame in run if _is_sync(frame, sync)] for run in sent]
    intervals = np.concatenate([np.diff(np.array(times, np.int64)) for times in syncs] or [np.zeros(0, np.int64)])
    if not len(intervals) or (usual := float(np.median(intervals))) <= 0.0:
        return None
    # The mean interval, in which a missed tick counts as another period; the median alone has the jitter of one SYNC.
    rate_hz = max(1, round(1e9 * float(np.sum(np.rint(intervals / usual)) / np.sum(intervals))))
    counts = Counter(
        frame.identifier for run in sent for frame in run if frame.identifier in setpoints and not _is_sync(frame, sync)
    )
    expected = {identifier for identifier, count in counts.items() if count > len(intervals) / 2}
    last, lacking = [], 0
    for run in sent:
        for cycle in _cycles(run, sync):
            times = [frame.t for frame in cycle[1:] if frame.identifier in expected]
            if times:
                last.append(max(times) - cycle[0].t)
            lacking += not expected <= {frame.identifier for frame in cycle[1:]}
    return MeasuredTiming(
        source=source,
        timestamps="hardware" if all(frame.is_hardware for run in sent for frame in run) else "software",
        rate_hz=rate_hz,
        syncs=sum(map(len, syncs)),
        interval_error_us=compute_percentiles(np.abs(intervals - 1e9 / rate_hz)),
        setpoints_us=compute_percentiles(np.array(last)) if last else None,
        without_setpoints=lacking,
    )


def measure(
    channel: str,
    bus: BusTiming,
    loop: LoopTable,
    sync: int | None,
    setpoints: Container[int],
    unfit: str = "",
    progress: Callable[[float], None] | None = None,
) -> MeasuredTiming | str:
    """Measure the timing on an interface; return the reason if that is not possible.

    A running service is listened to. On an idle bus, test frames are sent at the loop's rate.

    Parameters
    ----------
    bus
        Bit rates of the interface.
    sync
        Identifier of SYNC, or None if the protocol has none.
    setpoints
        Identifiers that setpoints may have.
    unfit
        Reason why nothing must be sent on the interface, or "".
    progress
        Function that is called with the completed fraction of the test frames.

    """
    try:
        with Loopback(channel) as loopback:
            heard = list(loopback.listen(WAITING_S))
            if sync is not None and any(frame.is_local and _is_sync(frame, sync) for frame in heard):
                heard += loopback.listen(LISTENING_S - WAITING_S)
                timing = compute_timing([heard], "service", sync, setpoints)
                return timing if timing is not None else "only one SYNC was sent in the time of the measurement"
            if reason := unfit or _why_not_idle(heard, bus, sync):
                return reason
            return _send_test_frames(channel, bus, loop, loopback, progress)
    except OSError as error:
        return f"{error.strerror or error}"


def _why_not_idle(heard: Sequence[StampedFrame], bus: BusTiming, sync: int | None) -> str:
    """Return why test frames must not be sent after these frames arrived within WAITING_S, or ""."""
    if sync is not None and any(_is_sync(frame, sync) for frame in heard):
        return "another node sends SYNC, so no test frames were sent"
    load = sum(bus.frame_ns(len(frame.data)) for frame in heard) * 1e-9 / WAITING_S
    if load > MAX_IDLE_LOAD:
        return f"other nodes use {load:.1%} of the bus, so no test frames were sent"
    return ""


def _send_test_frames(
    channel: str, bus: BusTiming, loop: LoopTable, loopback: Loopback, progress: Callable[[float], None] | None
) -> MeasuredTiming | str:
    """Run bare cycles with test frames on an idle bus."""
    sync, setpoints = Frame(TEST_FRAMES[0]), [Frame(each, bytes(8)) for each in TEST_FRAMES]
    share = loop.rate_hz * sum(bus.frame_ns(frame.length) for frame in (sync, *setpoints)) * 1e-9
    if share > 1.0:
        return f"test frames at {loop.rate_hz} Hz would need {share:.0%} of the bus"
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as carrier:
        carrier.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")  # this socket only sends
        carrier.bind((channel,))
        # One frame first: without a node that acknowledges it, further ones would only fill the queue.
        carrier.send(sync.packed)
        if not _await_frame(loopback):
            return f"no node acknowledged a test frame within {SENT_WITHIN_S:g} s; switch on the drives' supply"
        bare = BareBus(carrier.fileno(), sync, setpoints)
        batches = max(1, round(SENDING_S * loop.rate_hz / BATCH_CYCLES))
        unused, runs = np.zeros(BATCH_CYCLES, np.int64), []
        for number in range(batches):
            bare.exchange(1_000_000_000 // loop.rate_hz, unused, unused.copy())
            runs.append(list(loopback.listen(1.0 / loop.rate_hz)))
            if progress is not None:
                progress((number + 1) / batches)
    timing = compute_timing(runs, "test frames", TEST_FRAMES[0], TEST_FRAMES)
    return timing if timing is not None else "the test frames were not sent"


def _await_frame(loopback: Loopback) -> bool:
    """Return whether a test frame is sent within SENT_WITHIN_S."""
    deadline = time.monotonic() + SENT_WITHIN_S
    while time.monotonic() < deadline:
        if any(frame.is_local and frame.identifier in TEST_FRAMES for frame in loopback.listen(0.01)):
            return True
    return False


def _is_sync(frame: StampedFrame, sync: int) -> bool:
    # SYNC has no data, or one byte with a counter (CiA 301, 7.2.5.3). A test frame with data is a setpoint.
    return frame.identifier == sync and len(frame.data) <= 1


def _cycles(run: Sequence[StampedFrame], sync: int) -> Sequence[Sequence[StampedFrame]]:
    """Return the frames of each complete cycle, from its SYNC to the frame before the next SYNC."""
    at = [number for number, frame in enumerate(run) if _is_sync(frame, sync)]
    return [run[first:end] for first, end in itertools.pairwise(at)]
