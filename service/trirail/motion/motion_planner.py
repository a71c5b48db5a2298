"""Motion planner without state: from a request with a goal and the current motion to a new motion or a refusal.

A plan depends only on the request, and on the robot's geometry and limits, which are identified by a revision. The
planner can therefore run in a separate process or in the calling process, and can repeat recorded requests.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable

import msgspec
from msgspec import structs

from trirail.config import Config, corrected_geometry
from trirail.errors import RefusalCode, RefusedError
from trirail.motion.backlash_reserve import planned_limits
from trirail.motion.goal_planner import MOTIONS, Extension, GoalPlanner, PlannedMotion
from trirail.motion.marks import place_marks
from trirail.motion.packing import pack_path, pack_run, unpack_run
from trirail.motion.runs import MotionState
from trirail.motion.schedule import Schedule
from trirail.wire.plan_packets import NotPlanned, PackedRun, PathExtension, PlanAnswer, PlanRequest, PreemptingMotion


def revision(config: Config) -> int:
    """Return a checksum of all values in a configuration that affect plans."""
    limits = config.limits.platform, config.limits.slider, config.limits.singularity_margin
    correction = config.correction.as_built, config.correction.backlash
    return zlib.crc32(msgspec.json.encode((config.geometry, correction, limits, config.loop.rate_hz)))


class MotionPlanner:
    """Planner of one robot. During planning, `beat` is called repeatedly to show that the planner is alive."""

    def __init__(self, config: Config, beat: Callable[[], None] = lambda: None) -> None:
        robot = corrected_geometry(config)
        self._legs = robot.packed()
        self._period, self._beat = config.period, beat
        self._revision = revision(config)
        self._goals = GoalPlanner(robot, planned_limits(config.limits, config.correction.backlash), config.period, beat)

    def plan(self, request: PlanRequest) -> PlanAnswer:
        """Return the planned motion to the goal of a request, or a refusal. Any exception becomes a refusal."""
        try:
            decided = self._decide(request)
        except RefusedError as refusal:
            return _refusal(request, refusal)
        except Exception as error:  # noqa: BLE001 - the loop needs an answer to each request
            words = f"internal error in planning, please report it: {error!r}"
            return _refusal(request, RefusedError(RefusalCode.INTERNAL, words))
        number, version = request.number, request.version
        try:
            path = decided.path if isinstance(decided, Extension) else decided.run.path
            placed = place_marks(request.goal.marks, path, self._legs, request.commanded[0], self._period, self._beat)
        except RefusedError as refusal:
            return _refusal(request, refusal)
        reply, switches = structs.replace(decided.reply, marks=placed.marks), placed.switches.tobytes()
        if isinstance(decided, Extension):
            return PathExtension(number, version, decided.s, pack_path(decided.path), reply, switches)
        return PreemptingMotion(
            number,
            version,
            decided.first,
            pack_run(decided.run),
            reply,
            pack_path(decided.stop) if decided.stop is not None else None,
            decided.bound,
            switches,
        )

    def warm_up(self) -> None:
        """Plan one motion of each kind, because the first plan of a kind is slow."""
        start = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        runs: tuple[PackedRun, ...] = ()
        for goal in (goal for motion in MOTIONS.values() for goal in motion.examples):
            answer = self.plan(PlanRequest(0, 0, self._revision, 0, 2, 1.0, start, runs, goal))
            if isinstance(answer, PreemptingMotion):
                runs = (answer.run,)

    def _decide(self, request: PlanRequest) -> PlannedMotion | Extension:
        if request.revision != self._revision:
            raise RefusedError(RefusalCode.INTERNAL, "the planner and the loop have different geometries or limits")
        runs = deque(unpack_run(self._legs, run) for run in request.runs)
        if request.blend is not None and runs:
            return self._goals.append(request.goal, runs[-1], request.blend, request.lead)
        schedule = Schedule(MotionState(*request.commanded), self._period)
        schedule.cycle, schedule.runs = request.cycle, runs
        return self._goals.plan(request.goal, schedule, request.rate, request.lead)


def _refusal(request: PlanRequest, error: RefusedError) -> NotPlanned:
    return NotPlanned(request.number, request.version, error.code, str(error), error.slider, error.value, error.limit)
