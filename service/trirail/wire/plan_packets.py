"""What the loop asks the planner, and what the planner answers: all that a plan depends on, and all that comes of it.

Numbers that become motion are packed as they are in memory, so that a plan is the same to the last bit wherever it is
made, sent, or read from a recording.
"""

from __future__ import annotations

from msgspec import Struct, msgpack
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.decoding import decoder, prepare
from trirail.wire.goals import LoopGoal
from trirail.wire.messages import GoalReply


class PackedPath(Struct, frozen=True, array_like=True):
    """A path in time: float64 of this machine's byte order, as trirail.motion.paths has them."""

    knots: bytes
    pieces: bytes
    in_sliders: bool = False
    tools: bytes = b""


class PackedRun(Struct, frozen=True, array_like=True):
    """A path, and the law by which its time runs."""

    path: PackedPath
    law: PackedPath
    target: float
    """The rate that the law leads to."""
    time: float = 0.0
    """Time since the law began [s]."""
    seams: tuple[float, ...] = ()
    """Where on the path one goal ends and the next one begins, as times along it [s]."""


class PlanRequest(Struct, frozen=True):
    """Loop to planner: a goal, and the motion from which it is to be reached."""

    number: int
    """By which the answer is known."""
    version: int
    """Of the motion under way."""
    revision: int
    """Of the robot's geometry and limits: a planner with others must not answer."""
    cycle: int
    """Of the schedule, now."""
    lead: int
    """In how many cycles the new motion is to begin; it has no meaning where the robot stands."""
    rate: float
    """At which the goal's motion is to run."""
    commanded: tuple[Triple, Triple, Triple]
    """The platform's pose, velocity and acceleration now."""
    runs: tuple[PackedRun, ...]
    """The motion under way, and what follows it."""
    goal: LoopGoal
    """As trirail.motion.goal_planner.meant has it: its tools are points, its poses those of the base frame, its times
    the loop's."""
    blend: float | None = None
    """How far from the end of the last run this goal may follow it [m]; None where it preempts the motion."""


class Planned(Struct, frozen=True, tag=True):
    """Planner to loop: a motion that preempts the one under way."""

    number: int
    version: int
    first: int | None
    """The cycle in whose commanded state it begins; None where the robot stands, and it may begin at any time."""
    run: PackedRun
    reply: GoalReply
    """Reply to the goal's sender, to which the loop adds the goal's id; duration None at override zero."""
    stop: PackedPath | None = None
    """The law of that stop; None where the law that the motion under way has is the one to stand by."""
    bound: str | None = None
    """The limit before which a jog comes to rest, or beyond which a track's target is."""
    switches: bytes = b""
    """Planned switches of outputs, of trirail.motion.marks.SWITCH; their times count from the start of the path."""


class Extended(Struct, frozen=True, tag=True):
    """Planner to loop: a path that follows the last one under way."""

    number: int
    version: int
    s: float
    """From which time along that path [s]."""
    path: PackedPath
    reply: GoalReply
    """As in Planned; the loop adds the duration as well."""
    switches: bytes = b""
    """As in Planned."""


class NotPlanned(Struct, frozen=True, tag=True):
    """Planner to loop: why no motion leads there."""

    number: int
    version: int
    code: RefusalCode
    message: str
    slider: str | None = None
    value: float | None = None
    limit: float | None = None

    def error(self) -> RefusedError:
        """Return it as what is raised."""
        return RefusedError(self.code, self.message, slider=self.slider, value=self.value, limit=self.limit)


PlanAnswer = Planned | Extended | NotPlanned


class Overtaken(BaseException):
    """Planning ends without an answer: something newer has been asked. No Exception, since those become answers."""


prepare(PlanRequest, PlanAnswer)
encode = msgpack.Encoder().encode
decode_plan_request = decoder(PlanRequest, packed=True).decode
decode_plan_answer = decoder(PlanAnswer, packed=True).decode
