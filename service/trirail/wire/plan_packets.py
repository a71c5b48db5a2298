"""Requests of the loop to the planner and the planner's answers, which contain all inputs and results of a plan.

Numbers of the motion have the same bytes as in memory, so that a plan is bit-identical wherever it is computed, sent,
or read from a recording.
"""

from __future__ import annotations

from msgspec import Struct, msgpack
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.decoding import decoder, prepare
from trirail.wire.goals import LoopGoal
from trirail.wire.messages import GoalReply


class PackedPath(Struct, frozen=True, array_like=True):
    """A path over time: float64 in this machine's byte order, in the layout of trirail.motion.paths."""

    knots: bytes
    pieces: bytes
    in_sliders: bool = False
    tools: bytes = b""


class PackedRun(Struct, frozen=True, array_like=True):
    """A path and its time law."""

    path: PackedPath
    law: PackedPath
    target: float
    """Final rate of the law."""
    time: float = 0.0
    """Time since the start of the law [s]."""
    seams: tuple[float, ...] = ()
    """Times along the path at which one goal ends and the next begins [s]."""


class PlanRequest(Struct, frozen=True):
    """Request from the loop to the planner: a goal and the motion from which it starts."""

    number: int
    """Number with which the loop matches the answer to the request."""
    version: int
    """Version of the present motion."""
    revision: int
    """Revision of the robot's geometry and limits; a planner with a different revision must not answer."""
    cycle: int
    """Present cycle of the schedule."""
    lead: int
    """Number of cycles until the new motion starts; ignored at rest."""
    rate: float
    """Rate of the goal's motion."""
    commanded: tuple[Triple, Triple, Triple]
    """Commanded pose, velocity and acceleration of the platform."""
    runs: tuple[PackedRun, ...]
    """The present motion and those queued after it."""
    goal: LoopGoal
    """Goal as resolved by trirail.motion.goal_planner: tools as points, poses in the base frame, times of the loop."""
    blend: float | None = None
    """Distance from the end of the last run at which this goal may follow it [m]; None if it preempts the motion."""


class PreemptingMotion(Struct, frozen=True, tag="Planned"):  # as recordings have it
    """Answer from the planner to the loop: a motion that preempts the present one."""

    number: int
    version: int
    first: int | None
    """Cycle in whose commanded state the motion starts; None at rest, where the motion may start at any time."""
    run: PackedRun
    reply: GoalReply
    """Reply to the goal's sender, without the goal's id, which the loop adds; its duration is None at override zero."""
    stop: PackedPath | None = None
    """Time law of the preceding stop; None if the present motion keeps its law."""
    bound: str | None = None
    """Limit that stops a jog, or that the target of a track exceeds."""
    switches: bytes = b""
    """Planned switches of outputs, of trirail.motion.marks.SWITCH; their times count from the start of the path."""


class PathExtension(Struct, frozen=True, tag="Extended"):  # as recordings have it
    """Answer from the planner to the loop: a path that follows the last queued one."""

    number: int
    version: int
    s: float
    """Time along the last path at which the new one starts [s]."""
    path: PackedPath
    reply: GoalReply
    """Reply as in PreemptingMotion; the loop adds the duration as well."""
    switches: bytes = b""
    """Planned switches as in PreemptingMotion."""


class NotPlanned(Struct, frozen=True, tag=True):
    """Answer from the planner to the loop: the goal is refused because it has no valid motion."""

    number: int
    version: int
    code: RefusalCode
    message: str
    slider: str | None = None
    value: float | None = None
    limit: float | None = None

    def error(self) -> RefusedError:
        """Return the refusal as an exception."""
        return RefusedError(self.code, self.message, slider=self.slider, value=self.value, limit=self.limit)


PlanAnswer = PreemptingMotion | PathExtension | NotPlanned


class Overtaken(BaseException):
    """Raised when a newer request cancels the planning. Not an Exception, because those become answers."""


prepare(PlanRequest, PlanAnswer)
encode = msgpack.Encoder().encode
decode_plan_request = decoder(PlanRequest, packed=True).decode
decode_plan_answer = decoder(PlanAnswer, packed=True).decode
