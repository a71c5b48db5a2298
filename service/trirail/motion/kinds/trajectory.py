"""Planning of timed trajectories."""

from __future__ import annotations

from trirail.motion.goal_motion import GoalMotion, PoseSource
from trirail.motion.path_planner import Plan
from trirail.motion.quintic import Point
from trirail.motion.runs import MotionState
from trirail.motion.tool_frames import NamedFrames
from trirail.wire.kinds.trajectory import TrajectoryGoal
from trirail.wire.packed_trajectory import PackedTrajectory, packed


class PackedMotion(GoalMotion[TrajectoryGoal]):
    """Conversion of trajectories to the packed form, which TrajectoryMotion plans."""

    kind = TrajectoryGoal

    @staticmethod
    def resolve(goal: TrajectoryGoal, frames: NamedFrames, source: PoseSource) -> PackedTrajectory:
        """Return the trajectory with its points packed."""
        del frames, source
        return packed(goal)


class TrajectoryMotion(GoalMotion[PackedTrajectory]):
    """Planning of motions through timed points, with a quintic between successive points."""

    kind = PackedTrajectory

    def plan(self, goal: PackedTrajectory, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion through the points of the trajectory."""
        del rate, begins
        points = [Point(*row) for row in goal.points]
        first = points[0].t  # subtract: a float resolves times since 1970 only to 0.2 µs, but differences are exact
        return self._planner.plan_trajectory(start, [p._replace(t=p.t - first) for p in points], goal.stretch)
