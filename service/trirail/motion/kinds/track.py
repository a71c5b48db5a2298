"""Planning of tracks, which follow a moving target."""

from __future__ import annotations

from msgspec import structs

from trirail.motion.goal_motion import GoalMotion
from trirail.motion.path_planner import PathPlanner, Plan
from trirail.motion.runs import MotionState
from trirail.motion.tracking import Tracker
from trirail.wire.kinds.track import TrackGoal


class TrackMotion(GoalMotion[TrackGoal]):
    """Planning of motions that follow a moving target."""

    kind = TrackGoal
    examples = (TrackGoal(0.0, 0.0, 0.0, (0.01, 0.0, 0.0), 0.0),)

    def __init__(self, planner: PathPlanner) -> None:
        super().__init__(planner)
        self._tracker = Tracker(planner)

    def plan(self, goal: TrackGoal, start: MotionState, rate: float, begins: float) -> Plan:
        """Plan a motion that follows the target, from the pose that the target has at the start of the path.

        The velocity of the target is converted from real time to the time along the path.
        """
        rate, late = rate or 1.0, begins - goal.time if goal.time is not None else 0.0
        pose = [at + late * v for at, v in zip(goal.target, goal.velocity, strict=True)]
        plan = self._tracker.follow(start, pose, [v / rate for v in goal.velocity], goal.timeout)
        lag = self._planner.distance(start.pose, pose)
        return plan._replace(reply=structs.replace(plan.reply, lag=lag))
