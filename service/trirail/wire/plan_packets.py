"""Requests of the loop to the planner, and the planner's answers.

Requests contain all inputs of a plan, and answers all results. The numbers of a motion are sent with the same bytes
as in memory, so that a plan is bit-identical in both processes and in a recording.
"""

from __future__ import annotations

from msgspec import Struct, msgpack
from trirail_drivers.interface import Triple

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.decoding import decoder, prepare
from trirail.wire.goals import LoopGoal
from trirail.wire.messages import GoalReply


class PackedPath(Struct, frozen=True, array_like=True):
    """Path over time in the layout of trirail.motion.paths, as float64 in this machine's byte order."""

    knots: bytes
    pieces: bytes
    in_sliders: bool = False
    tools: bytes = b""


class PackedRun(Struct, frozen=True, array_like=True):
    """Path and its time law."""

    path: PackedPath
    law: PackedPath
    target: float
    """Rate at the end of the time law."""
    time: float = 0.0
    """Time since the start of the time law [s]."""
    seams: tuple[float, ...] = ()
    """Times along the path at which one goal ends and the next begins [s]."""


class PlanRequest(Struct, frozen=True):
    """Request from the loop to the planner to plan a goal."""

    number: int
    """Number with which the loop matches the answer to the request."""
    version: int
    """Version of the present motion."""
    revision: int
    """Revision of the robot's geometry and limits; a planner with a different revision must not answer."""
    cycle: int
    """Present cycle of the schedule."""
    lead: int
    """Number of cycles until the new motion starts; ignored if the robot is at rest."""
    rate: float
    """Rate of time along the path of the goal."""
    commanded: tuple[Triple, Triple, Triple]
    """Commanded pose, velocity and acceleration of the platform."""
    runs: tuple[PackedRun, ...]
    """Present motion and the motions queued after it."""
    goal: LoopGoal
    """Goal after trirail.motion.goal_planner has replaced names by values.

    Tools are points, poses are in the base frame, and times are loop times."""
    blend: float | None = None
    """Distance from the end of the last run at which the goal's path may begin [m]; None if it preempts the motion."""


class PreemptingMotion(Struct, frozen=True, tag="Planned"):  # recordings contain this tag
    """Answer from the planner to the loop with a motion that preempts the present motion."""

    number: int
    version: int
    first: int | None
    """Cycle with the commanded state from which the motion starts; None at rest, when it may start at any time."""
    run: PackedRun
    reply: GoalReply
    """Reply to the sender of the goal. The loop adds the goal's id. The duration is None at override zero."""
    stop: PackedPath | None = None
    """Time law with which the present motion first stops; None if the present motion keeps its time law."""
    bound: str | None = None
    """Limit that stops a jog, or that the target of a track exceeds."""
    switches: bytes = b""
    """Planned switches of outputs in the layout of trirail.motion.marks.SWITCH.

    The times of the switches count from the start of the path."""


class PathExtension(Struct, frozen=True, tag="Extended"):  # recordings contain this tag
    """Answer from the planner to the loop with a path that follows the last queued path."""

    number: int
    version: int
    s: float
    """Time along the last queued path at which the new path starts [s]."""
    path: PackedPath
    reply: GoalReply
    """Reply to the sender of the goal. The loop adds the goal's id and the duration."""
    switches: bytes = b""
    """Planned switches as in PreemptingMotion."""


class NotPlanned(Struct, frozen=True, tag=True):
    """Answer from the planner to the loop that the goal is refused, because there is no valid motion."""

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
    """Exception that ends the planning of a goal when a newer request arrives.

    The class is not derived from Exception, because the planner converts each Exception to an answer.
    """


prepare(PlanRequest, PlanAnswer)
encode = msgpack.Encoder().encode
decode_plan_request = decoder(PlanRequest, packed=True).decode
decode_plan_answer = decoder(PlanAnswer, packed=True).decode
