"""State of the compiled call between cycles, with its settings and its results, in memory shared with compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import MutableSequence
from typing import Final

import numpy as np
from trirail_drivers.driver.axis_row import set_fields

from trirail.wire.records import Part

Unsigned = int
"""Counter of trirail.processes.heartbeats."""
PartTimes = MutableSequence[int]
"""Durations of the parts of a cycle, in the order of trirail.wire.records.Part [ns]."""
Pair = tuple[float, float]
"""Values of trirail.motion.schedule.Schedule.after_stop."""
Span = tuple[float, float, float]
"""Values of a trirail.motion.runs.GoalSpan."""


class CycleState(ctypes.Structure):
    """State of the compiled call; the Python attributes are views of the memory that compiled code uses."""

    # The tick
    period_ns: int
    period: float
    """Period of the loop [s]."""
    injected_ns: int
    """Time of an injected clock in tests; negative to use the monotonic clock."""
    busy_wait_ns: int
    """Time before each deadline at which the loop wakes up."""
    rehearsal_ns: int
    """Duration of the newest rehearsal of a cycle, or less if it was too long for the next."""
    deadline_ns: int
    """Time at which the newest tick was due."""
    lateness_ns: int
    synced: float
    """Time at which the SYNC of the newest cycle was sent [s]."""
    marked_ns: int
    """Time at which the newest part of the cycle ended."""
    overruns: int
    """Number of missed ticks since the start."""
    in_a_row: int
    """Number of consecutive missed ticks before the newest tick."""
    allowed: int
    """Tolerated maximum of `in_a_row`."""
    missed: int
    """Number of ticks missed immediately before the newest tick."""
    parts_ns: PartTimes

    # The cycle
    cycle: int
    until: int
    """Last cycle that may be run."""
    due: int
    """Cycle after which a decision is due."""
    lead: int
    """Number of cycles before `due` or `ends` at which a decision beside these cycles is requested."""
    ends: int
    """Cycle in which the motion reaches the end of its goal, if that is at most `most` cycles away."""
    called: bool
    """Whether a neighbour has called before the newest cycle or, at a request for a decision, before the next."""
    decides: bool
    """Whether a decision is due after the newest cycle."""
    mode: int
    """Number of the mode, as in a record."""
    batched: int
    """Number of records in the batch."""

    # The motion
    source: int
    """Source of the setpoints: FOLLOW, HOLD or COMMAND of trirail.processes.cycle_core."""
    held: bool
    """Argument of trirail.control.cycle.follow."""
    step: float
    """Argument of trirail.control.cycle.follow."""
    at_rest: bool
    """Argument of trirail.control.cycle.observe."""
    fastest: float
    """Argument of trirail.control.cycle.observe."""
    limit: float
    """Argument of trirail.control.cycle.observe."""
    behind: int
    """Result of trirail.control.cycle.observe."""
    in_sliders: bool
    """Property of the path."""
    time: float
    """Time in the law of the motion [s]."""
    target: float
    """Rate to which the law leads."""
    course: Span
    code: int
    """Result of trirail.control.cycle.command."""
    stops_first: bool
    """Whether the motion only stops the robot before the motion of the current goal."""
    stop_duration: float
    """Duration of the law of such a motion [s]."""
    after_stop: Pair
    """Completed fraction of the current goal, and duration of the motions after the stop [s]."""
    settles: bool
    """Whether a goal waits until the robot is in position."""
    timeout: int
    """Cycle at which that wait times out."""

    # The neighbours
    least: int
    most: int
    """Minimum and maximum number of cycles that run beside a decision."""
    budget_ns: int
    """Time that a decision beside the cycles needs, from the request until its result can be used."""
    doorbell: int
    """Descriptor of the eventfd that wakes up the thread which decides beside the cycles."""
    deciding: bool
    """Whether Python decides beside the cycles, so that calls, other decisions and a lost gateway wait."""
    requested: int
    """Cycle after which a decision beside the next cycles, up to `until`, was requested; -1 if none was requested."""
    requested_ns: int
    """Time of the request."""
    requested_deadline_ns: int
    """Value of `deadline_ns` at the request."""
    requested_called: bool
    """Value of `called` at the request."""
    requested_time: float
    """Value of `time` at the request."""
    urgent_seen: Unsigned
    """Count of urgent requests at the last check."""
    gateway_seen: Unsigned
    """Count of the gateway's heartbeats; this and the next two are the state of a trirail.processes.heartbeats.Watch.
    """
    gateway_turns: int
    gateway_patience: int
    gateway_place: int
    """Index of the gateway's heartbeat."""

    # The frames
    arrived: int
    """Number of frames that have been received; Python must process those not handled."""
    handled: int
    """Number of frames that have been processed."""
    error: int
    """Error of receiving frames, a number of errno.h."""
    sent: int
    """Number of setpoints that the bus has accepted."""

    # The outputs
    logged: int
    """Number of rows in the log of switches."""
    report_due: int
    """Cycle after which the log of switches is reported."""
    report_after: int
    """Number of cycles from the first row of the log to its report."""


set_fields(
    CycleState,
    Unsigned=ctypes.c_uint64,
    PartTimes=ctypes.c_int32 * len(Part),
    Pair=ctypes.c_double * 2,
    Span=ctypes.c_double * 3,
)
STATE: Final = np.dtype(CycleState)
"""CycleState as a numpy type, for compiled code."""
