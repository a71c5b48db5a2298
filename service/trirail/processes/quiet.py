"""Cycles in which nothing happens, as one compiled call: it goes on from cycle to cycle until Python is needed.

Wait, SYNC, what has arrived, `observe`, `command`, `hold` or `follow`, the last gate, setpoints, record. A cycle where
the drives say anything but positions, where somebody hurries or has gone, or where the last gate refuses, leaves no
trace: what it has changed is put back, and Python runs it from its SYNC on. What can wait until its setpoints have
left is left to Python behind it. So nothing is decided here.

A wait that a signal interrupts goes on to its deadline; Python's handlers run when the call has returned, which is at
the end of a batch of records at the latest.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numba import f8, from_dtype, i8, types, u1, u8
from numpy.typing import NDArray
from trirail_drivers.driver.cyclic import MOST_FRAMES

from trirail.control import cycle
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.processes.clock import DOORS, SPARE_NS, called, now_ns, sleep, wait
from trirail.processes.cycle_frames import (
    AXES,
    EXPECTATIONS,
    FRAMES,
    TIMINGS,
    begin_cycle,
    end_read,
    memcpy,
    receive_frames,
    send_frames,
    set_frames,
    take_frames,
)
from trirail.processes.heartbeats import HASTE
from trirail.wire.records import LONGEST, Part

_GONE: Final = (0x008 | 0x010) << 16
"""POLLERR and POLLHUP of poll.h, where poll leaves them."""


class Reached(IntEnum):
    """How far the newest cycle has come."""

    WAITED = 0
    """Its tick is there; frames may have been taken from the bus."""
    SYNCED = 1
    """Its SYNC has been sent, as far as the bus takes it, and frames may have been taken from the bus."""
    WRITTEN = 2
    """All is done, but for setpoints that the bus has not taken."""
    DONE = 3
    """All is done."""
    CALLED = 4
    """All is done, and somebody has called while the next tick was waited for."""


FOLLOW, HOLD, COMMAND = 0, 1, 2
"""What the setpoints come from."""

STATE = np.dtype(
    [
        ("period_ns", "<i8"),
        ("period", "<f8"),  # the same [s]
        ("injected_ns", "<i8"),  # the time, for tests; negative: the monotonic clock
        ("deadline_ns", "<i8"),  # of the newest tick
        ("lateness_ns", "<i8"),
        ("synced", "<f8"),  # when its SYNC was sent [s]
        ("marked_ns", "<i8"),  # when its newest part ended
        ("cycle", "<i8"),
        ("until", "<i8"),  # the last cycle that may be run
        ("due", "<i8"),  # the cycle behind which something is to be decided
        ("overruns", "<i8"),  # ticks that have been missed
        ("in_a_row", "<i8"),  # those before the newest, and how many may be
        ("allowed", "<i8"),
        ("missed", "<i8"),  # those before the newest tick
        ("parts_ns", "<i4", len(Part)),
        ("mode", "u1"),  # as in a record
        ("source", "u1"),  # FOLLOW, HOLD or COMMAND
        ("held", "u1"),  # as of trirail.control.cycle.follow
        ("stands", "u1"),  # as of trirail.control.cycle.observe
        ("in_sliders", "u1"),  # of the path
        ("found", "<i8"),  # what trirail.control.cycle.command has found
        ("time", "<f8"),  # of the law [s], and the rate that it leads to
        ("target", "<f8"),
        ("course", "<f8", 3),  # trirail.motion.runs.Course
        ("fastest", "<f8"),  # as of trirail.control.cycle.observe
        ("limit", "<f8"),
        ("step", "<f8"),  # as of trirail.control.cycle.follow
        ("settles", "u1"),  # whether a goal waits for the robot to be in position, and until which cycle
        ("timeout", "<i8"),
        ("haste", "<u8"),  # the count of hastes when it was last looked at
        ("listens", "u1"),  # whether who calls while the next tick is waited for is heard at once
        ("called", "u1"),  # whether there is something to decide behind the newest cycle
        ("gateway_seen", "<u8"),  # trirail.processes.heartbeats.Watch
        ("gateway_turns", "<i8"),
        ("gateway_patience", "<i8"),
        ("gateway_place", "<i8"),
        ("batched", "<i8"),  # records in the batch
        ("arrived", "<i8"),  # frames that Python has to look at
        ("error", "<i8"),  # with which taking frames has failed: a number of errno.h
        ("sent", "<i8"),  # setpoints that the bus has taken
    ],
    align=True,
)
"""What the call goes on from, and what it leaves."""

_STATE = from_dtype(STATE)[::1]


@compiled()
def _now_ns(state: NDArray[np.void], moment: NDArray[np.int64]) -> int:
    if state[0].injected_ns >= 0:
        return int(state[0].injected_ns)
    return int(now_ns(moment))


@compiled()
def _wait(state: NDArray[np.void], moment: NDArray[np.int64], doors: NDArray[np.int32]) -> bool:
    """Wait for the deadline; return whether somebody is at a door who is to be heard before."""
    if state[0].injected_ns >= 0:
        return bool(state[0].listens and called(doors))
    if state[0].listens:
        return bool(wait(state[0].deadline_ns, doors, moment))
    sleep(state[0].deadline_ns, moment)
    return False


@compiled()
def _mark(state: NDArray[np.void], moment: NDArray[np.int64], part: int) -> None:
    """Note how long a part of the cycle has taken, at its end."""
    now = _now_ns(state, moment)
    state[0].parts_ns[part] = min(now - state[0].marked_ns, LONGEST)
    state[0].marked_ns = now


@compiled()
def _copy(kept: NDArray[np.int64], to: int, source: int) -> None:
    """Copy all that is kept: rows of two addresses and a number of bytes; `to` and `source` say which is which."""
    for i in range(len(kept)):
        memcpy(kept[i, to], kept[i, source], np.uint64(kept[i, 2]))


@compiled(
    i8(
        *(_STATE, i8[:, ::1], i8[::1], i8[::1], FRAMES, u8[:, ::1], FRAMES, u8[:, ::1]),
        *(FRAMES, u8[:, ::1], FRAMES, u8[:, ::1]),
        *(EXPECTATIONS, AXES, TIMINGS, f8[:, ::1], DOORS, u8[::1], FRAMES),
        *(cycle.LEGS, cycle.BOUND),
        *(cycle.MOTION, cycle.SLIDERS, cycle.KEPT, f8[::1], cycle.FEEDBACKS, f8[:, ::1], types.b1[::1], f8[:, ::1]),
        *(cycle.MONITORED, cycle.RECORD, u1[::1]),
        *(cycle.KNOTS, cycle.PIECES, f8[:, ::1], cycle.KNOTS, cycle.PIECES, f8[::1]),
    ),
    releases=True,
)
def run(  # noqa: PLR0912, PLR0915 - a cycle in its order
    state: NDArray[np.void],
    kept: NDArray[np.int64],
    moment: NDArray[np.int64],
    bus: NDArray[np.int64],
    arrived: NDArray[np.uint8],
    arrivals: NDArray[np.uint64],
    starts: NDArray[np.uint8],
    begin: NDArray[np.uint64],
    signs: NDArray[np.uint8],
    beats: NDArray[np.uint64],
    setpoints: NDArray[np.uint8],
    departures: NDArray[np.uint64],
    expected: NDArray[np.void],
    axes: NDArray[np.void],
    times: NDArray[np.void],
    history: Array,
    doors: NDArray[np.int32],
    hearts: NDArray[np.uint64],
    batch: NDArray[np.uint8],
    legs: Array,
    bounds: NDArray[np.void],
    motion: Array,
    sliders: Array,
    backlash: NDArray[np.void],
    found: Array,
    feedback: NDArray[np.void],
    written: Array,
    jumps: NDArray[np.bool],
    room: Array,
    monitored: NDArray[np.void],
    record: NDArray[np.void],
    made: NDArray[np.uint8],
    knots: Array,
    pieces: Array,
    tools: Array,
    law_knots: Array,
    law_pieces: Array,
    furthest: Array,
) -> int:
    """Run cycles; return how far the newest has come: Reached.

    `kept` (n, 3) are addresses and sizes of all that a cycle changes, and of copies of it; `moment` (2,) room for a
    struct timespec, `bus` (3,) a BusAccess, `doors` (n, 2) as poll takes them, the
    gateway's first, `hearts` the counters of trirail.processes.heartbeats, `batch` (n, SIZE) room for records, `made`
    (SIZE,) the bytes of `record`. All else as in control.cycle and exchange.
    """
    s, row = state[0], record[0]
    while s.cycle < s.until and s.batched < len(batch):
        s.deadline_ns += s.period_ns
        if _wait(state, moment, doors):
            s.deadline_ns -= s.period_ns
            s.marked_ns, s.arrived, s.error = _now_ns(state, moment), 0, 0
            return Reached.CALLED
        now, s.listens = _now_ns(state, moment), s.period_ns > SPARE_NS
        s.marked_ns, s.arrived, s.sent, s.error, s.called = now, 0, 0, 0, 0
        s.lateness_ns = now - s.deadline_ns
        s.missed = max(0, s.lateness_ns // s.period_ns)
        if s.missed and s.in_a_row + s.missed > s.allowed:
            return Reached.WAITED
        _copy(kept, 1, 0)
        t = now / 1e9
        number, s.error = receive_frames(bus, arrivals, arrived, moment)
        s.arrived = number
        if (
            s.error != 0
            or number >= MOST_FRAMES
            or t >= times[0].due
            or take_frames(arrived, number, expected, axes, times, t) < number
        ):
            _copy(kept, 0, 1)
            return Reached.WAITED
        s.deadline_ns, s.lateness_ns = s.deadline_ns + s.missed * s.period_ns, s.lateness_ns - s.missed * s.period_ns
        s.synced, s.arrived = t, 0
        begun, due = send_frames(bus, begin, starts, times), t >= times[0].beat_due
        first, number = times[0].next_beat, times[0].beats
        if begun == len(begin) and due:
            begun += send_frames(bus, beats[first : first + number], signs[first : first + number], times)
        if begun < len(begin) + number * due:
            times[0].begun = begun
            return Reached.SYNCED
        if due:
            times[0].beat_due, times[0].next_beat = t + times[0].beat_period, (first + number) % len(beats)
        begin_cycle(axes, history)
        _mark(state, moment, Part.SYNC)

        _copy(kept, 1, 0)
        t = _now_ns(state, moment) / 1e9
        number, s.error = receive_frames(bus, arrivals, arrived, moment)
        s.arrived = number
        if s.error != 0 or number >= MOST_FRAMES or take_frames(arrived, number, expected, axes, times, t) < number:
            _copy(kept, 0, 1)
            return Reached.SYNCED
        if not end_read(axes, times, history, t):
            _copy(kept, 0, 1)
            return Reached.SYNCED
        _mark(state, moment, Part.READ)

        for i in range(3):
            feedback[0].position[i] = axes[i].position
            feedback[0].age[i] = axes[i].syncs - axes[i].sampled
        behind = cycle.observe(
            *(legs, feedback, written, backlash, s.period, s.fastest, s.limit, s.stands != 0),
            *(jumps, room, monitored, record),
        )
        in_position = s.settles and (monitored[0].inside >= monitored[0].dwell or s.cycle + 1 >= s.timeout)
        somebody = called(doors)
        count = hearts[s.gateway_place]  # as trirail.processes.heartbeats.Watch looks at it
        turns = s.gateway_turns + 1 if count == s.gateway_seen and count else 0
        hurried = hearts[HASTE] != s.haste or doors[0, 1] & _GONE != 0
        if behind or hurried or turns > s.gateway_patience:
            _copy(kept, 0, 1)
            return Reached.SYNCED
        _mark(state, moment, Part.MODE)
        _mark(state, moment, Part.MOTION)

        time = s.time
        if s.source == COMMAND:
            time = s.time + s.period
            begun, end, arrival = s.course[0], s.course[1], s.course[2]
            code = cycle.command(
                *(legs, bounds, knots, pieces, s.in_sliders != 0, tools, law_knots, law_pieces, time, s.target),
                *(furthest, begun, end, arrival, motion, sliders, backlash, found, record),
            )
        elif s.source == HOLD:
            code = cycle.hold(legs, bounds, motion, sliders, backlash, found, record)
        else:
            code = 0
            cycle.follow(legs, feedback, jumps, s.held != 0, False, s.step, motion, sliders, backlash, record)
        late = _now_ns(state, moment) / 1e9 - s.synced > s.period
        if code >> 2 != 0 or late or not set_frames(setpoints, axes, sliders[0]):
            _copy(kept, 0, 1)
            return Reached.SYNCED
        _mark(state, moment, Part.KINEMATICS)

        s.called, s.found = in_position or somebody or code != s.found or s.cycle + 1 >= s.due, code
        s.arrived, s.time, s.gateway_seen, s.gateway_turns = 0, time, count, turns
        s.sent = send_frames(bus, departures, setpoints, times)
        _mark(state, moment, Part.WRITE)

        s.cycle += 1
        s.overruns += s.missed
        s.in_a_row = s.in_a_row + s.missed if s.missed else 0
        row.cycle, row.deadline_ns, row.lateness_ns, row.overruns = s.cycle, s.deadline_ns, s.lateness_ns, s.overruns
        row.parts_ns[:] = s.parts_ns
        s.parts_ns[Part.DECIDE] = 0
        row.mode = s.mode
        batch[s.batched] = made
        s.batched += 1
        _mark(state, moment, Part.RECORD)
        if s.sent < len(departures):
            return Reached.WRITTEN
        if s.called:
            return Reached.DONE
    return Reached.DONE
