"""Digital outputs, and the marks on the path of a goal at which outputs switch.

The drives apply setpoints and outputs at the same SYNC. An output therefore switches in the cycle that has the
setpoints nearest to the mark, and the error is at most half a cycle. If the device behind an output has a delay, the
output switches earlier by this delay. This is possible because the commanded path is known in advance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numba import b1, f8, from_dtype, i8
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES

from trirail.config import Input, Output
from trirail.errors import RefusalCode, RefusedError
from trirail.kinematics.algebra import copy_vector
from trirail.kinematics.arrays import Array
from trirail.kinematics.compiled import compiled
from trirail.motion.marks import GoalMarks, pulse_cycles
from trirail.motion.paths import constant_law, law_at
from trirail.motion.runs import Run
from trirail.wire.marks import Mark, Switch
from trirail.wire.messages import Outcome
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import Mode

OUTPUT: Final = np.dtype(
    [
        ("axis", "<i8"),
        ("bit", "<i8"),  # mask of the output's bit in the drive's word
        ("delay", "<f8"),  # delay of the device that the output switches [s]
        ("next", "<i8"),  # index of the next planned switch, and end of this output's rows in the table
        ("end", "<i8"),
        ("goal", "<i8"),  # number of the goal with an active pulse or stretch on the output; 0 if there is none
        ("mark", "<i8"),  # index of the mark that has switched the output
        ("opened", "<i8"),  # value of the output during the pulse or stretch
        ("until", "<i8"),  # cycle in which the pulse ends; 0 if no pulse is active
    ],
    align=True,
)
"""State of an output."""
PLANNED: Final = np.dtype(
    [
        ("s", "<f8"),  # time along the path [s]
        ("on", "<i8"),
        ("cycles", "<i8"),  # duration of a pulse [cycles]; 0 if the switch is not a pulse
        ("opens", "<i8"),  # whether this goal later switches the output back
        ("goal", "<i8"),
        ("mark", "<i8"),
    ],
    align=True,
)
"""Planned switch of an output. The table of planned switches is sorted by output and by time along the path."""
SWITCHED: Final = np.dtype(
    [
        ("cycle", "<i8"),
        ("output", "<i8"),
        ("on", "<i8"),
        ("goal", "<i8"),
        ("mark", "<i8"),
        ("closed", "<i8"),
        ("deadline_ns", "<i8"),  # deadline of the cycle on the monotonic clock; 0 until the record of the cycle exists
        ("commanded", "<f8", 3),
        ("measured", "<f8", 3),
    ],
    align=True,
)
"""Record of a switch that has taken place."""
LOG_LENGTH = 512
"""Number of rows in the log of switches, which compiled code fills and Python empties."""
TABLE_DELAY = 0.1
"""Longest time for which switches are collected before they are reported in one message [s]."""
TABLE_LENGTH = 50
"""Greatest number of switches in one message."""

_AT_REST = constant_law(0.0)
OUTPUTS, PLAN, LOG = from_dtype(OUTPUT)[::1], from_dtype(PLANNED)[::1], from_dtype(SWITCHED)[::1]
RECORDS = from_dtype(DTYPE)[::1]


@compiled()
def _set(words: NDArray[np.int64], output: NDArray[np.void], on: int) -> None:
    """Set the bit of an output in the word of its drive."""
    if on:
        words[output.axis] |= output.bit  # type: ignore[attr-defined]
    else:
        words[output.axis] &= ~output.bit  # type: ignore[attr-defined]


@compiled()
def _note(
    log: NDArray[np.void],
    number: int,
    cycle: int,
    deadline_ns: int,
    output: int,
    on: int,
    goal: int,
    mark: int,
    record: NDArray[np.void],
) -> int:
    """Append a switch to the log and return the new number of rows. If the log is full, the switch is not logged."""
    if number < len(log):
        row = log[number]
        row.cycle, row.output, row.on, row.goal, row.mark, row.closed = cycle, output, on, goal, mark, 0
        row.deadline_ns = deadline_ns
        copy_vector(record[0].commanded_pose, row.commanded)
        copy_vector(record[0].pose, row.measured)
    return min(number + 1, len(log))


@compiled(i8(OUTPUTS, PLAN, i8[::1], LOG, i8, f8[::1], f8[:, :, ::1], b1, f8, f8, i8, i8, RECORDS))
def switch(
    outputs: NDArray[np.void],
    planned: NDArray[np.void],
    words: NDArray[np.int64],
    log: NDArray[np.void],
    number: int,
    law_knots: Array,
    law_pieces: Array,
    moves: bool,
    time: float,
    period: float,
    cycle: int,
    deadline_ns: int,
    record: NDArray[np.void],
) -> int:
    """Switch the outputs that are due in this cycle, and return the number of rows in the log.

    Parameters
    ----------
    outputs, planned
        State of the outputs, and table of their planned switches.
    words : (3,)
        Requested values of the drives' output words.
    log, number
        Log for the switches that take place, and the number of rows in use.
    law_knots, law_pieces, moves, time
        Law of the motion, whether there is a motion, and the time of the law in this cycle [s].
    period, cycle, deadline_ns
        Period [s], number of the cycle, and its deadline on the monotonic clock [ns]; 0 if the deadline is not known
        yet.
    record
        Record of the cycle, with the commanded and the measured pose.
    """
    for k in range(len(outputs)):
        output = outputs[k]
        if output.until != 0 and cycle >= output.until:
            _set(words, output, 1 - output.opened)
            number = _note(log, number, cycle, deadline_ns, k, 1 - output.opened, output.goal, output.mark, record)
            output.until, output.goal = 0, 0
        if not moves or output.next >= output.end:
            continue
        # Switch together with the setpoint that is nearer to the mark: with the current setpoint if the mark is before
        # the middle between the current and the next setpoint. The law gives both setpoints, even while it brakes. No
        # later decision can change the motion within one period.
        here = law_at(law_knots, law_pieces, time + output.delay)[0]
        there = law_at(law_knots, law_pieces, time + period + output.delay)[0]
        if there == 0.0:
            continue  # the motion has not begun, since the override is 0
        while output.next < output.end and planned[output.next].s <= (here + there) / 2.0:
            due = planned[output.next]
            _set(words, output, due.on)
            number = _note(log, number, cycle, deadline_ns, k, due.on, due.goal, due.mark, record)
            output.until = cycle + due.cycles if due.cycles else 0
            output.goal, output.mark, output.opened = (due.goal if due.opens else 0), due.mark, due.on
            output.next += 1
    return number


_SAFE_IN = (Mode.DISABLED, Mode.FAULT)
"""Modes in which outputs have their safe values."""


class Outputs:
    """Digital outputs and inputs of a robot, by their names in the configuration."""

    def __init__(self, outputs: Mapping[str, Output], inputs: Mapping[str, Input], period: float) -> None:
        self._named = dict(outputs)
        self._names = tuple(outputs)
        self._inputs = {name: (NAMES.index(each.drive), 1 << each.bit) for name, each in inputs.items()}
        self._period = period
        self._path_allowed = (True, True, True)
        self.words = np.zeros(3, np.int64)
        """Requested values of the drives' output words, (3,)."""
        self.state = np.zeros(len(self._names), OUTPUT)
        self.planned = np.zeros(0, PLANNED)
        self.log = np.zeros(LOG_LENGTH, SWITCHED)
        self.logged = 0
        """Number of rows of the log in use."""
        for row, output in zip(self.state, self._named.values(), strict=True):
            row["axis"], row["bit"], row["delay"] = NAMES.index(output.drive), 1 << output.bit, output.delay
        self.make_safe()
        self._goals: dict[str, int] = {}
        """Number that represents each goal in the tables, under the id of the goal. The number 0 represents no goal."""
        self._number = 0
        self._over: set[str] = set()
        """Goals that have ended, but with switches that have not been reported yet."""
        self._table: list[GoalMarks] = []
        """Marks of the goals that have switches in the table."""
        self._built_for: tuple[Run | None, int, int] = (None, -1, 0)
        self._first = [0] * len(self._names)
        """First row of the table for each output."""
        self._mode: Mode | None = None
        self._reported = 0
        """Cycle in which switches were last reported."""

    @property
    def any(self) -> bool:
        """Whether the robot has outputs."""
        return bool(self._names)

    def allow_paths(self, allowed: tuple[bool, bool, bool]) -> None:
        """Set which drives apply outputs together with setpoints. Only their outputs can switch along a path."""
        self._path_allowed = allowed

    # ------------------------------------------------------------------ values

    def values(self) -> dict[str, bool]:
        """Return the requested value of each output."""
        words = self.words.tolist()
        return {
            name: bool(words[row["axis"]] & int(row["bit"])) for name, row in zip(self._names, self.state, strict=True)
        }

    def set(self, name: str, value: bool, mode: Mode) -> None:
        """Set an output now. Raises RefusedError if the output is unknown or the mode does not allow the change."""
        output = self._find(name)
        if mode in _SAFE_IN and not output.always:
            code = RefusalCode.FAULT if mode is Mode.FAULT else RefusalCode.NOT_ENABLED
            safe, where = "on" if output.safe else "off", "in fault" if mode is Mode.FAULT else mode
            raise RefusedError(
                code,
                f"output {name!r} stays at its safe value, {safe}, while the robot is {where}: "
                "send enable first, or set always = true for this output in the configuration",
            )
        self.follow_mode(mode)  # otherwise the next cycle would reset the output
        row = self.state[self._names.index(name)]
        row["until"] = row["goal"] = 0
        self._write(self._names.index(name), value)

    def follow_mode(self, mode: Mode) -> None:
        """Set all outputs to their safe values if the robot has just become disabled or gone into fault.

        A reset changes no output: all have had their safe values since the fault, unless somebody has set one.
        """
        before, self._mode = self._mode, mode
        if mode is not before and mode in _SAFE_IN and (before, mode) != (Mode.FAULT, Mode.DISABLED):
            self.make_safe()

    def make_safe(self) -> None:
        """Set all outputs to their safe values, and end active pulses and stretches."""
        self.state["until"] = self.state["goal"] = 0
        for number, output in enumerate(self._named.values()):
            self._write(number, output.safe)

    def _write(self, number: int, value: bool) -> None:
        axis, bit = int(self.state[number]["axis"]), int(self.state[number]["bit"])
        self.words[axis] = self.words[axis] | bit if value else self.words[axis] & ~bit

    def _find(self, name: str) -> Output:
        if name not in self._named:
            known = f"the robot has {', '.join(self._names)}" if self._names else "the configuration has no [outputs]"
            raise RefusedError(RefusalCode.UNKNOWN_OUTPUT, f"there is no output {name!r}: {known}")
        return self._named[name]

    # ------------------------------------------------------------------ inputs

    def edges(self, before: Sequence[int], now: Sequence[int]) -> list[tuple[str, bool]]:
        """Return the names and new values of the inputs that differ between two readings of the drives' input words."""
        return [
            (name, bool(now[axis] & bit))
            for name, (axis, bit) in self._inputs.items()
            if (before[axis] ^ now[axis]) & bit
        ]

    def check_input(self, name: str) -> None:
        """Raise RefusedError if the input is unknown."""
        if name not in self._inputs:
            known = f"the robot has {', '.join(self._inputs)}" if self._inputs else "the configuration has no [inputs]"
            raise RefusedError(RefusalCode.UNKNOWN_OUTPUT, f"there is no input {name!r}: {known}")

    # ------------------------------------------------------------------ marks

    def check_marks(self, marks: Sequence[Mark]) -> None:
        """Raise RefusedError if a mark names an unknown output, or an output that cannot switch along a path."""
        for mark in marks:
            drive = self._find(mark.output).drive
            if not self._path_allowed[NAMES.index(drive)]:
                raise RefusedError(
                    RefusalCode.BAD_MARK,
                    f"output {mark.output!r} cannot switch on a path, because drive {drive} accepts object 60FEh only "
                    "by "
                    "SDO: use set_output, or an output of another drive",
                )

    def prepare(self, run: Run | None, version: int) -> None:
        """Build the table of digital outputs to switch during a motion, unless the table is already up to date."""
        goals = list(run.marks) if run is not None else []
        key = run, version, len(goals)
        if key == self._built_for:
            return
        self._built_for = key
        self._note_passed()
        ends = [seam.s for seam in run.seams] if run is not None else []
        self._table = [goal for goal in goals if goal.has_switches]
        limits = dict(zip(map(id, goals), [*ends, math.inf], strict=False))
        tables = [np.zeros(0, PLANNED)]
        for number, name in enumerate(self._names):
            row = self.state[number]
            row["next"] = row["end"] = self.state[number - 1]["end"] if number else 0
            for goal in self._table:
                tables.append(self._planned_switches(goal, name, limits[id(goal)]))
                row["end"] += len(tables[-1])
        self._first = self.state["next"].tolist()
        self.planned = np.concatenate(tables)

    def _planned_switches(self, goal: GoalMarks, output: str, end: float) -> NDArray[np.void]:
        """Return the rows of the table for the switches of an output that a goal has left, up to a time of the path."""
        switches, opens = goal.pending(output, end)
        rows = np.zeros(len(switches), PLANNED)
        if len(rows):
            cycles = pulse_cycles(switches["width"], self._period)
            rows["s"], rows["on"], rows["mark"], rows["opens"] = switches["s"], switches["on"], switches["mark"], opens
            rows["cycles"], rows["goal"] = np.where(np.isnan(cycles), 0.0, cycles), self._number_of(goal.goal)
        return rows

    def _number_of(self, goal: str) -> int:
        if goal not in self._goals:
            self._number += 1
            self._goals[goal] = self._number
        return self._goals[goal]

    def _note_passed(self) -> None:
        """Inform the marks of each goal in the table which of their switches have taken place."""
        for number, name in enumerate(self._names):
            passed = self.planned["goal"][self._first[number] : int(self.state[number]["next"])]
            for goal in (goal for goal in self._table if goal.goal in self._goals):
                goal.note_passed(name, int(np.count_nonzero(passed == self._number_of(goal.goal))))

    def step(self, run: Run | None, time: float, version: int, cycle: int, record: NDArray[np.void]) -> None:
        """Switch the outputs that are due in this cycle."""
        if not self._names:
            return
        self.prepare(run, version)
        law = run.law if run is not None else _AT_REST
        self.logged = switch(
            *(self.state, self.planned, self.words, self.log, self.logged, law.knots, law.pieces),
            *(run is not None, time, self._period, cycle, 0, record),
        )

    def stamp(self, deadline_ns: int) -> None:
        """Store the deadline of the latest cycle in all log entries that have no time yet [ns]."""
        for row in self.log[: self.logged]:
            row["deadline_ns"] = row["deadline_ns"] or deadline_ns

    @property
    def report_after(self) -> int:
        """Number of cycles for which switches are collected before they are reported."""
        return math.ceil(TABLE_DELAY / self._period)

    @property
    def report_due(self) -> int:
        """Cycle after which the collected switches are reported."""
        return self._reported + self.report_after

    def update_log(self, logged: int, report_due: int) -> None:
        """Set the number of rows in the log, and the cycle after which the log is reported, after compiled cycles."""
        self.logged, self._reported = logged, report_due - self.report_after

    def close(self, goal: str, outcome: Outcome, cycle: int, record: NDArray[np.void]) -> None:
        """Switch back the outputs that are still switched by an ended goal.

        If the goal is done, its pulses still run to their end. The rows of the log are reported before `cycle` runs.
        They therefore have the poses of the latest cycle, and the deadline of `cycle` is computed.
        """
        if goal not in self._goals:
            return
        number, latest = self._goals[goal], record[0]
        self._over.add(goal)
        later_ns = (cycle - int(latest["cycle"])) * round(self._period * 1e9)
        deadline_ns = int(latest["deadline_ns"]) + later_ns if latest["deadline_ns"] else 0
        for k, row in enumerate(self.state):
            if row["goal"] != number or (outcome == "done" and row["until"]):
                continue
            value = not row["opened"]
            self._write(k, value)
            if self.logged < len(self.log):
                poses = latest["commanded_pose"], latest["pose"]
                self.log[self.logged] = cycle, k, value, number, row["mark"], 1, deadline_ns, *poses
                self.logged += 1
            row["goal"] = row["until"] = 0

    def pop_switches(self, cycle: int, *, all_: bool = False) -> list[tuple[Switch, ...]]:
        """Remove and return the switches that must be reported now, in one tuple per message.

        The times of the switches are on the monotonic clock, or NaN if the deadline of the cycle is not known yet.
        """
        due = all_ or self.logged >= TABLE_LENGTH or (cycle - self._reported) * self._period >= TABLE_DELAY
        if self.logged and not due:
            return []
        self._reported = cycle
        rows, self.logged = self.log[: self.logged], 0
        names = {number: goal for goal, number in self._goals.items()}
        switches = [
            Switch(
                names[int(row["goal"])],
                int(row["mark"]),
                self._names[int(row["output"])],
                bool(row["on"]),
                int(row["cycle"]),
                int(row["cycle"]) * self._period,
                int(row["deadline_ns"]) * 1e-9 or math.nan,
                tuple(row["commanded"].tolist()),
                tuple(row["measured"].tolist()),
                bool(row["closed"]),
            )
            for row in rows
        ]
        active = set(self.state["goal"].tolist())  # the pulses of a goal that is done are still to end
        for goal in [goal for goal in self._over if self._goals[goal] not in active]:
            del self._goals[goal]
            self._over.remove(goal)
        return [tuple(switches[k : k + TABLE_LENGTH]) for k in range(0, len(switches), TABLE_LENGTH)]
