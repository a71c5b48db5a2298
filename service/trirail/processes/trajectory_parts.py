"""Assembly of trajectories whose parts arrive in several messages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

from trirail.errors import RefusalCode, RefusedError
from trirail.processes.incoming import Incoming
from trirail.wire.call_mark import CallMark
from trirail.wire.kinds.trajectory import TrajectoryGoal
from trirail.wire.packed_trajectory import ROW, PackedTrajectory, joined, packed
from trirail.wire.sizes import MAX_POINTS
from trirail.wire.text import quoted

PARTS_WITHIN = 5.0
"""Maximum time between two parts of a trajectory [s]. After that time, the goal is refused."""


class _Received(NamedTuple):
    incoming: Incoming
    goal: PackedTrajectory


class _Incomplete:
    """Trajectory of which some parts have not arrived yet."""

    def __init__(self, of: int) -> None:
        self.of = of
        self.received: dict[int, _Received] = {}
        self.due = 0.0

    @property
    def message(self) -> Incoming:
        """All received parts as one message with the number of the first part. An answer is sent for all parts."""
        first, *others = sorted((part.incoming for part in self.received.values()), key=lambda each: each.number)
        newest = others[-1] if others else first
        size = first.size + sum(each.size for each in others)
        return first._replace(arrived_ns=newest.arrived_ns, size=size, alike=tuple(others))

    @property
    def missing(self) -> str:
        """Text for people that lists the missing parts."""
        numbers = [number for number in range(1, self.of + 1) if number not in self.received]
        listed = ", ".join(map(str, numbers[:5])) + (f" and {len(numbers) - 5} more" if len(numbers) > 5 else "")
        return f"part{'s' if len(numbers) > 1 else ''} {listed} of {self.of}"


class TrajectoryParts:
    """Assembler of trajectories from their parts.

    The memory of a part is counted for its user until the part is answered.

    Parameters
    ----------
    refuse
        Function that refuses all parts of a goal.
    clock
        Function that returns the monotonic time [s].

    """

    def __init__(
        self, refuse: Callable[[Incoming, RefusedError], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._refuse = refuse
        self._clock = clock
        self._incomplete: dict[tuple[str, str, CallMark | None], _Incomplete] = {}

    def __iter__(self) -> Iterator[Incoming]:
        """Yield the messages that have not been answered."""
        return (goal.message for goal in self._incomplete.values())

    def is_incomplete(self, goal_id: str) -> bool:
        """Return True if some parts of the goal with this id have arrived, but not all."""
        return any(goal_id == incomplete_id for _, incomplete_id, _ in self._incomplete)

    def add(self, incoming: Incoming, user: str, goal: TrajectoryGoal) -> tuple[Incoming, PackedTrajectory] | None:
        """Add a part. If all parts have arrived, return the whole goal and its parts as one message, else None.

        Only parts of one call are joined. If the part does not match the previous parts, these are refused, too: a
        program without marks may have begun to send the goal again. Raises RefusedError for the part itself.
        """
        if goal.part is None or goal.id is None:
            return incoming, packed(goal)
        key, (number, of) = (user, goal.id, incoming.mark), (goal.part.number, goal.part.of)
        incomplete = self._incomplete.get(key) or _Incomplete(of)
        try:
            _check(incomplete, goal, number, of)
        except RefusedError as error:
            if self._incomplete.pop(key, None) is not None:
                self._refuse(incomplete.message, error)
            raise
        incomplete.received[number] = _Received(incoming._replace(payload=b""), packed(goal))
        incomplete.due = self._clock() + PARTS_WITHIN
        self._incomplete[key] = incomplete
        if len(incomplete.received) < of:
            return None
        del self._incomplete[key]
        try:
            return incomplete.message, joined([incomplete.received[n].goal for n in range(1, of + 1)])
        except ValueError as error:
            self._refuse(incomplete.message, RefusedError(RefusalCode.MALFORMED, f"not a goal: {error}"))
        return None

    def poll(self) -> None:
        """Refuse goals whose parts have not arrived in time."""
        now = self._clock()
        for key, goal in list(self._incomplete.items()):
            if goal.due < now:
                del self._incomplete[key]
                text = (
                    f"trajectory {quoted(key[1])}: {goal.missing} not received within {PARTS_WITHIN:g} s: "
                    "send all parts of the goal again, one after the other"
                )
                self._refuse(goal.message, RefusedError(RefusalCode.EXPIRED, text))


def _check(incomplete: _Incomplete, goal: TrajectoryGoal, number: int, of: int) -> None:
    """Raise RefusedError if a part does not match the previous parts."""
    problem = ""
    points = sum(len(part.goal.rows) // ROW for part in incomplete.received.values()) + len(goal.points)
    first = next(iter(incomplete.received.values()), None)
    if of != incomplete.of:
        problem = f"states a total of {of} parts, the other parts state {incomplete.of}"
    elif number in incomplete.received:
        problem = "has already been received"
    elif first is not None and _options(first.goal) != _options(goal):
        options = "stretch, settle, valid_for, marks and stop_at"
        problem = f"has other options than the earlier parts: give all parts the same {options}"
    elif points > MAX_POINTS:
        problem = (
            f"makes {points} points in total, the maximum is {MAX_POINTS}: send fewer, since paths between points are "
            "quintic"
        )
    if problem:
        text = f"trajectory {quoted(goal.id or '')}: part {number} {problem}"
        raise RefusedError(RefusalCode.MALFORMED, text)


def _options(goal: PackedTrajectory | TrajectoryGoal) -> tuple[object, ...]:
    return goal.stretch, goal.settle, goal.valid_for, goal.marks, goal.stop_at
