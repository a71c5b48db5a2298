"""Compiled call that runs cycles without events, one after the other, until Python is needed.

In each cycle, the call wakes up shortly before the tick, receives the frames that answer the previous SYNC, and waits
for the tick. It sends the SYNC, receives frames and calls `observe`. It then calls `command`, `hold` or `follow`,
applies the last gate to the setpoints, and writes setpoints and record. The call makes no decisions. Some decisions
must be made before the setpoints are sent: if a drive sends anything other than its position, a request is urgent, the
gateway is lost, too many ticks were missed, or the last gate refuses a setpoint. In these cases the call returns at the
stage that it has reached, and Python continues from there.

If other work is due, or a neighbour calls, the thread beside the call (trirail.processes.companion) decides while the
call runs one or two further cycles, and then returns. Other decisions wait, also that the gateway is lost or that too
many ticks were missed. If the robot is not enabled, or an output may switch in these cycles, or Python exchanges the
frames, the call returns instead, and Python decides before the next tick.

A signal does not end a wait. Python's signal handlers run when the call has returned, which is at the end of a batch of
records at the latest.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np
from numba import b1, f8, from_dtype, i4, i8, types, u1, u8, void
from numpy.typing import NDArray
from trirail_drivers.driver.cyclic import MOST_FRAMES

from trirail.control import cycle, outputs
from trirail.kinematics.algebra import copy_vector
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.motion.paths import law_at
from trirail.processes.clock import POLLFDS, busy_wait, called, now_ns, sleep, wait_for_call
from trirail.processes.cycle_frames import (
    AXES,
    EXPECTATIONS,
    FRAMES,
    TIMINGS,
    begin_cycle,
    end_read,
    memcpy,
    needs_python,
    process_frames,
    receive_frames,
    send_frames,
    send_outputs,
    set_frames,
)
from trirail.processes.cycle_state import STATE
from trirail.processes.heartbeats import URGENT_INDEX
from trirail.wire.records import MAX_PART_NS, Part

MOST_AHEAD: Final = 2
"""Maximum number of cycles by which a decision is made ahead. A stop that is not a quick stop waits for their end."""
_PEER_GONE: Final = (0x008 | 0x010) << 16
"""POLLERR and POLLHUP of poll.h, shifted to the position of `revents` in a struct pollfd."""


class Reached(IntEnum):
    """Stage that the newest cycle has reached when the compiled call returns."""

    WAITED = 0
    """The tick is due, or will be shortly. Frames may have been received before the SYNC."""
    SYNCED = 1
    """The SYNC has been sent, as far as the bus has accepted it. Frames may have been received."""
    OBSERVED = 2
    """The feedback has been evaluated, and a following error exceeds its limit, or the position of a slider without
    power has jumped.
    """
    SOLVED = 3
    """The setpoints have been calculated, but not sent.

    The reason is that the last gate has refused a setpoint, the cycle is late, a setpoint does not fit into its frame,
    or an output must be set by SDO.
    """
    WRITTEN = 4
    """The cycle is complete, except for setpoints or outputs that the bus has not accepted."""
    DONE = 5
    """The cycle is complete."""


NO_CYCLE: Final = 1 << 62
"""Number of a cycle that is never reached."""
CONTINUE: Final = -1
"""Result of a stage of a cycle if the cycle continues with the next stage."""
FOLLOW, HOLD, COMMAND = 0, 1, 2
"""Sources of the setpoints: FOLLOW for the measured positions, HOLD for a platform at rest, COMMAND for a motion."""

_STATE = from_dtype(STATE)[::1]
_write: Any = types.ExternalFunction("write", types.intp(i4, types.intp, u8))
"""Function of libc, resolved by name: unistd.h."""


class FrameTables(NamedTuple):
    """Tables of the frames that a cycle exchanges with the drives, as in trirail_drivers.driver.cyclic.Cyclic."""

    bus: NDArray[np.int64]
    """BusAccess of the bus, (3,)."""
    arrived: NDArray[np.uint8]
    arrivals: NDArray[np.uint64]
    """Memory for received frames, and the headers of these frames."""
    starts: NDArray[np.uint8]
    begin: NDArray[np.uint64]
    """Frames at the start of a cycle, and their headers."""
    signs: NDArray[np.uint8]
    beats: NDArray[np.uint64]
    """Periodic frames, and their headers."""
    setpoints: NDArray[np.uint8]
    departures: NDArray[np.uint64]
    """Setpoint frames, and the headers of the frames at the end of a cycle."""
    pins: NDArray[np.uint8]
    switchings: NDArray[np.uint64]
    """Frames for the outputs of the drives, and their headers."""
    expected: NDArray[np.void]
    axes: NDArray[np.void]
    times: NDArray[np.void]
    history: Array


class Neighbours(NamedTuple):
    """Memory shared with other parts of the service."""

    pollfds: NDArray[np.int32]
    """Array of struct pollfd, of which the first is that of the gateway, (n, 2)."""
    hearts: NDArray[np.uint64]
    """Counters of trirail.processes.heartbeats."""
    batch: NDArray[np.uint8]
    """Memory for packed records, (n, SIZE)."""


class RobotArrays(NamedTuple):
    """Arrays of trirail.control.cycle that stay the same for all motions."""

    legs: Array
    bounds: NDArray[np.void]
    motion: Array
    sliders: Array
    backlash: NDArray[np.void]
    refused_values: Array
    feedback: NDArray[np.void]
    written: Array
    jumps: NDArray[np.bool]
    scratch: Array
    monitored: NDArray[np.void]
    record: NDArray[np.void]
    packed: NDArray[np.uint8]
    """Bytes of `record`, (SIZE,)."""


class MotionArrays(NamedTuple):
    """Arrays of trirail.control.cycle that describe the current motion: a path and the time law along it."""

    knots: Array
    pieces: Array
    tools: Array
    law_knots: Array
    law_pieces: Array
    furthest: Array


class Rehearsal(NamedTuple):
    """Copies of the arrays that `solve` changes. A cycle first computes its setpoints with them, without any effect."""

    copies: NDArray[np.int64]
    """Table of the copies, as in `copy_state`."""
    state: NDArray[np.void]
    frames: FrameTables
    robot: RobotArrays
    furthest: Array


class OutputArrays(NamedTuple):
    """Tables of outputs, the same as in trirail.control.outputs.switch."""

    switches: NDArray[np.void]
    planned: NDArray[np.void]
    words: NDArray[np.int64]
    log: NDArray[np.void]


def _typed(kind: type, *members: Any) -> Any:
    """Return the numba type of a named tuple of arrays."""
    return types.BaseTuple.from_types(members, kind)  # type: ignore[no-untyped-call]


_HEADERS = u8[:, ::1]
_FRAME_TABLES = _typed(
    FrameTables,
    *(i8[::1], FRAMES, _HEADERS, FRAMES, _HEADERS, FRAMES, _HEADERS, FRAMES, _HEADERS, FRAMES, _HEADERS),
    *(EXPECTATIONS, AXES, TIMINGS, f8[:, ::1]),
)
_NEIGHBOURS = _typed(Neighbours, POLLFDS, u8[::1], FRAMES)
_ROBOT = _typed(
    RobotArrays,
    *(cycle.LEGS, cycle.BOUND, cycle.MOTION, cycle.SLIDERS, cycle.BACKLASH_STATES, f8[::1], cycle.FEEDBACKS),
    *(f8[:, ::1], types.b1[::1], f8[:, ::1], cycle.MONITORED, cycle.RECORD, u1[::1]),
)
_MOTION = _typed(MotionArrays, cycle.KNOTS, cycle.PIECES, f8[:, ::1], cycle.KNOTS, cycle.PIECES, f8[::1])
_REHEARSAL = _typed(Rehearsal, i8[:, ::1], _STATE, _FRAME_TABLES, _ROBOT, f8[::1])
_OUTPUTS = _typed(OutputArrays, outputs.OUTPUTS, outputs.PLAN, i8[::1], outputs.LOG)


@compiled()
def _now_ns(state: NDArray[np.void], moment: NDArray[np.int64]) -> int:
    if state[0].injected_ns >= 0:
        return int(state[0].injected_ns)
    return int(now_ns(moment))


@compiled()
def _await_call(state: NDArray[np.void], moment: NDArray[np.int64], neighbours: Neighbours) -> bool:
    """Wait for a call until shortly before the next tick, unless a decision is due; return True if there is one."""
    s = state[0]
    if s.decides or s.injected_ns >= 0:
        return bool(called(neighbours.pollfds))
    return bool(wait_for_call(s.deadline_ns + s.period_ns - s.busy_wait_ns, neighbours.pollfds, moment))


@compiled()
def _needs_python(s: Any, neighbours: Neighbours) -> bool:
    """Return True if the next cycle needs Python: for an urgent request, a lost gateway or too many missed ticks."""
    if neighbours.hearts[URGENT_INDEX] != s.urgent_seen or s.in_a_row > s.allowed:
        return True
    return bool(neighbours.pollfds[0, 1] & _PEER_GONE != 0 or s.gateway_turns >= s.gateway_patience)


@compiled()
def _busy_wait(state: NDArray[np.void], moment: NDArray[np.int64]) -> int:
    if state[0].injected_ns >= 0:
        return int(state[0].injected_ns)
    return int(busy_wait(state[0].deadline_ns, moment))


@compiled()
def _mark(state: NDArray[np.void], moment: NDArray[np.int64], part: int) -> None:
    """Record the duration of a part of the cycle at the end of the part."""
    now = _now_ns(state, moment)
    state[0].parts_ns[part] = min(now - state[0].marked_ns, MAX_PART_NS)
    state[0].marked_ns = now


@compiled()
def _receive(s: Any, moment: NDArray[np.int64], frames: FrameTables, t: float) -> bool:
    """Receive and process frames. Return True if there was no error, all frames were expected and no frame is left."""
    s.arrived, s.error = receive_frames(frames.bus, frames.arrivals, frames.arrived, moment)
    s.handled = process_frames(frames.arrived, s.arrived, frames.expected, frames.axes, frames.times, t)
    return bool(s.error == 0 and s.handled == s.arrived and s.arrived < MOST_FRAMES)


@compiled()
def _begin(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    motion: MotionArrays,
    rehearsal: Rehearsal,
) -> int:
    """Wait for the tick, and send the frames at the start of a cycle. Return CONTINUE, or the reached stage."""
    s, times = state[0], frames.times
    s.deadline_ns += s.period_ns
    if s.injected_ns < 0:
        sleep(s.deadline_ns - s.busy_wait_ns, moment)
    s.sent, s.called, s.decides = 0, called(neighbours.pollfds), False
    # The frames that have arrived answer the previous SYNC. Nothing is left to do between the deadline and SYNC.
    if not _receive(s, moment, frames, _now_ns(state, moment) / 1e9):
        return Reached.WAITED
    _rehearse(state, moment, motion, rehearsal)
    s.marked_ns = now = _busy_wait(state, moment)
    s.lateness_ns = now - s.deadline_ns
    s.missed = max(0, s.lateness_ns // s.period_ns)
    t = now / 1e9
    if (s.in_a_row + s.missed > s.allowed and not s.deciding) or t >= times[0].off_deadline:
        return Reached.WAITED
    s.deadline_ns, s.lateness_ns = s.deadline_ns + s.missed * s.period_ns, s.lateness_ns - s.missed * s.period_ns
    s.synced, s.handled, s.arrived = t, 0, 0
    begun, due = send_frames(frames.bus, frames.begin, frames.starts, times), t >= times[0].beat_due
    first, number = times[0].next_beat, times[0].beats
    if begun == len(frames.begin) and due:
        beats, signs = frames.beats[first : first + number], frames.signs[first : first + number]
        begun += send_frames(frames.bus, beats, signs, times)
    if begun < len(frames.begin) + number * due:
        times[0].begun = begun
        return Reached.SYNCED
    if due:
        times[0].beat_due, times[0].next_beat = t + times[0].beat_period, (first + number) % len(frames.beats)
    begin_cycle(frames.axes, frames.history)
    _mark(state, moment, Part.SYNC)
    return CONTINUE


@compiled()
def _read(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    feedback: NDArray[np.void],
) -> int:
    """Read the drives' answers into `feedback`. Return CONTINUE, or the reached stage if Python must do it."""
    s, pollfds, hearts, axes = state[0], neighbours.pollfds, neighbours.hearts, frames.axes
    count = hearts[s.gateway_place]  # the same check as in trirail.processes.heartbeats.Watch
    turns = s.gateway_turns + 1 if count == s.gateway_seen and count else 0
    lost = pollfds[0, 1] & _PEER_GONE != 0 or turns > s.gateway_patience
    if hearts[URGENT_INDEX] != s.urgent_seen or (lost and not s.deciding):
        return Reached.SYNCED
    t = _now_ns(state, moment) / 1e9
    if not (_receive(s, moment, frames, t) and end_read(axes, frames.times, frames.history, t)):
        return Reached.SYNCED
    s.handled, s.arrived = 0, 0
    _mark(state, moment, Part.READ)

    s.overruns += s.missed
    s.in_a_row = s.in_a_row + s.missed if s.missed or s.in_a_row > s.allowed else 0
    s.gateway_seen, s.gateway_turns = count, turns
    for i in range(3):
        feedback[0].position[i] = axes[i].position
        feedback[0].age[i] = axes[i].syncs - axes[i].sampled
    _mark(state, moment, Part.MODE)
    return CONTINUE


@compiled()
def _next_end(s: Any, motion: MotionArrays, newest: int, code: int) -> int:
    """Return the cycle at most `most` cycles after `newest` in which the motion reaches the end of its goal.

    Return NO_CYCLE if there is none. `code` is the result of trirail.control.cycle.command in the newest cycle.
    """
    time = s.time
    for ahead in range(1, s.most + 1 if s.source == COMMAND else 1):
        time += s.period
        if cycle.ends_at(motion.knots, motion.law_knots, motion.law_pieces, time, s.target, s.course[1]) != code:
            return newest + ahead
    return NO_CYCLE


@compiled(i8(_STATE, i8[::1], _FRAME_TABLES, _ROBOT, _MOTION))
def solve(
    state: NDArray[np.void], moment: NDArray[np.int64], frames: FrameTables, robot: RobotArrays, motion: MotionArrays
) -> int:
    """Evaluate the feedback, and write the next setpoints into their frames. Return CONTINUE, or the reached stage."""
    s = state[0]
    s.behind = cycle.observe(
        *(robot.legs, robot.feedback, robot.written, robot.backlash, s.period, s.fastest, s.limit, s.at_rest),
        *(robot.jumps, robot.scratch, robot.monitored, robot.record),
    )
    if s.behind or (s.source == FOLLOW and (robot.jumps[0] or robot.jumps[1] or robot.jumps[2])):
        return Reached.OBSERVED
    _mark(state, moment, Part.MOTION)

    if s.source == COMMAND:
        s.time += s.period
        code = cycle.command(
            *(robot.legs, robot.bounds, motion.knots, motion.pieces, s.in_sliders, motion.tools),
            *(motion.law_knots, motion.law_pieces, s.time, s.target),
            *(motion.furthest, s.course[0], s.course[1], s.course[2]),
            robot.motion,
            robot.sliders,
            robot.backlash,
            robot.refused_values,
            robot.record,
        )
        if s.stops_first:
            progress, remaining = s.after_stop
            robot.record[0].progress, robot.record[0].remaining = progress, s.stop_duration - s.time + remaining
    elif s.source == HOLD:
        code = cycle.hold(
            *(robot.legs, robot.bounds, robot.motion, robot.sliders, robot.backlash, robot.refused_values),
            robot.record,
        )
    else:
        code = 0
        cycle.follow(
            *(robot.legs, robot.feedback, robot.jumps, s.held, False, s.step),
            *(robot.motion, robot.sliders, robot.backlash, robot.record),
        )
    monitored = robot.monitored[0]
    in_position = s.settles and (monitored.inside >= monitored.dwell or s.cycle + 1 >= s.timeout)
    s.ends = s.cycle + 1 if code != s.code else _next_end(s, motion, s.cycle + 1, code)
    s.decides, s.code = in_position or s.cycle + 1 >= min(s.due, s.ends) - s.lead, code
    late = _now_ns(state, moment) / 1e9 - s.synced > s.period
    if code >> 2 != 0 or late or not set_frames(frames.setpoints, frames.axes, robot.sliders[0]):
        return Reached.SOLVED
    return CONTINUE


@compiled()
def _switch_outputs(
    s: Any, axes: NDArray[np.void], record: NDArray[np.void], motion: MotionArrays, tables: OutputArrays
) -> bool:
    """Switch the outputs that are due with the setpoints. Return False, and change nothing, if Python must do it."""
    if len(tables.switches) == 0:
        return True
    if needs_python(axes):
        return False
    if s.logged == 0:
        s.report_due = s.cycle + s.report_after
    s.logged = outputs.switch(
        *(tables.switches, tables.planned, tables.words, tables.log, s.logged, motion.law_knots, motion.law_pieces),
        *(s.source == COMMAND, s.time, s.period, s.cycle + 1, s.deadline_ns, record),
    )
    s.decides = s.decides or s.logged >= outputs.TABLE_LENGTH or (s.logged > 0 and s.cycle + 1 >= s.report_due)
    for i in range(3):
        axes[i].outputs = record[0].outputs[i] = tables.words[i]
    return True


@compiled(i8(_STATE, _ROBOT, FRAMES))
def record(state: NDArray[np.void], robot: RobotArrays, batch: NDArray[np.uint8]) -> int:
    """Complete the record of the cycle, append it to the batch, and return the number of the cycle."""
    s, row = state[0], robot.record[0]
    s.cycle += 1
    row.cycle, row.deadline_ns, row.lateness_ns, row.overruns = s.cycle, s.deadline_ns, s.lateness_ns, s.overruns
    copy_vector(s.parts_ns, row.parts_ns)
    s.parts_ns[Part.DECIDE] = 0
    row.mode = s.mode
    copy_vector(robot.packed, batch[s.batched])
    s.batched += 1
    return int(s.cycle)


@compiled(void(i8[:, ::1], b1))
def copy_state(copies: NDArray[np.int64], back: bool) -> None:
    """Copy the control's arrays to the arrays of compiled code or, if `back` is set, from them.

    Parameters
    ----------
    copies : (n, 3)
        Address of each array of the control, address of the array of compiled code, and number of bytes.

    """
    for i in range(len(copies)):
        source, target = (1, 0) if back else (0, 1)
        memcpy(copies[i, target], copies[i, source], np.uint64(copies[i, 2]))


@compiled()
def _rehearse(state: NDArray[np.void], moment: NDArray[np.int64], motion: MotionArrays, rehearsal: Rehearsal) -> None:
    """Compute the next setpoints on copies, if there is twice as much time before the tick as that took last.

    Code and data are then in the processor's caches when the setpoints are computed behind the SYNC.
    """
    s, began = state[0], now_ns(moment)
    if s.injected_ns < 0 and began + 2 * s.rehearsal_ns > s.deadline_ns:
        s.rehearsal_ns -= s.rehearsal_ns // 4096  # after a single delay, rehearsals begin again
        return
    copy_state(rehearsal.copies, False)
    rehearsal.state[0].synced = _now_ns(state, moment) / 1e9
    copied = MotionArrays(
        *(motion.knots, motion.pieces, motion.tools, motion.law_knots, motion.law_pieces, rehearsal.furthest)
    )
    solve(rehearsal.state, moment, rehearsal.frames, rehearsal.robot, copied)
    s.rehearsal_ns = now_ns(moment) - began


@compiled()
def _may_switch(s: Any, motion: MotionArrays, tables: OutputArrays) -> bool:
    """Return True if an output may switch in one of the next cycles that could run beside a decision."""
    for k in range(len(tables.switches)):
        output = tables.switches[k]
        if output.until != 0 and output.until <= s.cycle + s.most:
            return True
        if s.source == COMMAND and output.next < output.end:
            # An output switches with the nearest setpoint, half a period early at most; one period more for rounding.
            time = s.time + (s.most + 2) * s.period + output.delay
            if tables.planned[output.next].s <= law_at(motion.law_knots, motion.law_pieces, time)[0]:
                return True
    return False


@compiled()
def _cycles_beside(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    motion: MotionArrays,
    tables: OutputArrays,
) -> int:
    """Return the number of cycles that must run beside a decision, so that none is late; 0 to decide before the next.

    A decision that is due in a certain cycle, or at the end of a motion, is made for exactly that cycle. No output
    switches beside a decision, because decisions change outputs as well.
    """
    s = state[0]
    if s.most == 0 or _needs_python(s, neighbours) or _may_switch(s, motion, tables):
        return 0
    missing_ns = s.budget_ns - (s.deadline_ns + s.period_ns - _now_ns(state, moment))
    until_due = min(s.due if s.due >= s.cycle else NO_CYCLE, s.ends) - s.cycle
    return int(until_due if until_due <= s.most else min(max(s.least, -(-missing_ns // s.period_ns)), s.most))


@compiled()
def _request_decision(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    motion: MotionArrays,
    tables: OutputArrays,
    copies: NDArray[np.int64],
) -> bool:
    """Let Python decide beside the next cycles, with the present state of the robot.

    Return False, and change nothing, if it must decide before the next cycle.
    """
    s, number = state[0], _cycles_beside(state, moment, neighbours, motion, tables)
    if number == 0:
        return False
    s.deciding, s.until = True, s.cycle + number
    s.requested, s.requested_deadline_ns, s.requested_called, s.requested_time = (
        s.cycle,
        s.deadline_ns,
        s.called,
        s.time,
    )
    s.requested_ns = _now_ns(state, moment)
    copy_state(copies, True)
    if s.injected_ns < 0:
        moment[0] = 1
        _write(s.doorbell, moment.ctypes.data, np.uint64(8))
    return True


@compiled()
def _exchange(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    robot: RobotArrays,
    motion: MotionArrays,
    rehearsal: Rehearsal,
) -> int:
    """Run the first half of a cycle: wait for the tick, send the SYNC, and read the drives' answers.

    Return CONTINUE, or the reached stage if Python must go on, for instance because a frame was unexpected.
    """
    reached = _begin(state, moment, neighbours, frames, motion, rehearsal)
    return reached if reached != CONTINUE else _read(state, moment, neighbours, frames, robot.feedback)


@compiled()
def _finish(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    robot: RobotArrays,
    motion: MotionArrays,
    tables: OutputArrays,
) -> int:
    """Run the second half of a cycle: compute the setpoints, send them with the outputs, and write the record.

    Return CONTINUE, or the reached stage if Python must go on.
    """
    s = state[0]
    reached = solve(state, moment, frames, robot, motion)
    if reached != CONTINUE:
        return reached
    if not _switch_outputs(s, frames.axes, robot.record, motion, tables):
        return Reached.SOLVED
    _mark(state, moment, Part.KINEMATICS)
    s.sent = send_frames(frames.bus, frames.departures, frames.setpoints, frames.times)
    accepted = s.sent == len(frames.departures) and send_outputs(
        frames.bus, frames.switchings, frames.pins, frames.axes, frames.times
    )
    _mark(state, moment, Part.WRITE)
    record(state, robot, neighbours.batch)
    _mark(state, moment, Part.RECORD)
    return CONTINUE if accepted else Reached.WRITTEN


@compiled()
def _run_cycles(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    robot: RobotArrays,
    motion: MotionArrays,
    tables: OutputArrays,
    copies: NDArray[np.int64],
    rehearsal: Rehearsal,
) -> int:
    """Run cycles until Python is needed; return the stage that the newest cycle has reached."""
    s = state[0]
    while s.cycle < s.until and s.batched < len(neighbours.batch):
        if s.most > 0 and not s.deciding:
            s.decides = s.cycle >= min(s.due, s.ends) - s.lead
            s.called = _await_call(state, moment, neighbours)
            if s.called or s.decides:
                requested = _request_decision(state, moment, neighbours, motion, tables, copies)
                if requested and s.injected_ns >= 0:
                    return Reached.DONE
        reached = _exchange(state, moment, neighbours, frames, robot, motion, rehearsal)
        if reached == CONTINUE:
            reached = _finish(state, moment, neighbours, frames, robot, motion, tables)
        if reached != CONTINUE:
            return reached
        if (s.called or s.decides) and not s.deciding:
            requested = _request_decision(state, moment, neighbours, motion, tables, copies)
            if not requested or s.injected_ns >= 0:
                return Reached.DONE
    return Reached.DONE


@compiled(
    i8(_STATE, i8[::1], i8[:, ::1], _NEIGHBOURS, _FRAME_TABLES, _ROBOT, _REHEARSAL, _MOTION, _OUTPUTS), releases=True
)
def run(
    state: NDArray[np.void],
    moment: NDArray[np.int64],
    copies: NDArray[np.int64],
    neighbours: Neighbours,
    frames: FrameTables,
    robot: RobotArrays,
    rehearsal: Rehearsal,
    motion: MotionArrays,
    tables: OutputArrays,
) -> int:
    """Run cycles until Python is needed; return the stage that the newest cycle has reached, as a number of Reached.

    The cycles use copies of the control's arrays. These are copied back when a decision beside the next cycles is
    requested, or at the end of the call.

    Parameters
    ----------
    moment : (2,)
        Memory for a struct timespec.
    copies
        The same as in `copy_state`.
    tables
        Tables of outputs; empty if the robot has no outputs.

    """
    s = state[0]
    if not s.deciding:
        copy_state(copies, False)
        s.ends = _next_end(s, motion, s.cycle, s.code)
    reached = _run_cycles(state, moment, neighbours, frames, robot, motion, tables, copies, rehearsal)
    if not s.deciding:
        copy_state(copies, True)
    return reached
