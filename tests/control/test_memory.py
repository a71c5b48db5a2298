"""Memory of the control: of goals that are over, it keeps no content, however they ended."""

from __future__ import annotations

import gc
from collections.abc import Callable
from types import FrameType, FunctionType, ModuleType, TracebackType

from control.test_refusal_words import GOALS
from control_rig import CONFIG, ControlRig
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import structs
from trirail.wire.goal_kind import GoalKind
from trirail.wire.goals import Goal, PoseGoal, TrackGoal, TrajectoryGoal, TrajectoryPoint, VelocityGoal
from trirail.wire.packed_trajectory import packed
from trirail.wire.packets import CheckRequest, CommandRequest, GoalRequest, PlannerLost, Refused
from trirail.wire.vocabulary import AcquireLease, Command, Mode, ReleaseLease, Stop

Step = Callable[[ControlRig, str], object]
"""What a user does, given an id that no other goal has."""


def kept_by(root: object) -> list[object]:
    """Return all objects that can be reached from one, but for the program: modules, classes and their functions."""
    kept: dict[int, object] = {}
    waiting = [root]
    while waiting:
        each = waiting.pop()
        if id(each) in kept or isinstance(each, type | ModuleType):
            continue
        kept[id(each)] = each
        if isinstance(each, FunctionType):
            waiting += each.__closure__ or ()
        elif not isinstance(each, FrameType):
            waiting += gc.get_referents(each)
    return list(kept.values())


def posts(goal: Goal, user: str = "ann", known: str = "", age: float = 0.0) -> Step:
    """A goal, of another's id if one is given, that was received so long ago."""
    return lambda rig, id: rig.cycle(  # noqa: A006
        GoalRequest(1, user, known or id, goal, round((rig.now + rig.config.period - age) * 1e9))
    )


def commands(name: Command, content: object = None, user: str = "ann") -> Step:
    return lambda rig, _: rig.cycle(CommandRequest(2, user, name, content))


def posts_and_stops(goal: Goal) -> Step:
    """A goal that is stopped in the cycle in which it arrives."""

    def step(rig: ControlRig, id: str) -> None:  # noqa: A002
        rig.more.append(GoalRequest(1, "ann", id, goal, round(rig.now * 1e9)))
        rig.cycle(CommandRequest(2, "ann", Command.STOP, Stop(id)))

    return step


def loses_planner(rig: ControlRig, id: str) -> None:  # noqa: A002
    rig.cycle(GoalRequest(1, "ann", id, PoseGoal(0.05, 0.0, 0.0), round(rig.now * 1e9)))
    rig.control.handle(PlannerLost("the planner has died"), round(rig.now * 1e9))


def trajectory(points: int) -> Goal:
    """A trajectory that ends beyond every limit, as clients send it and as the loop receives it."""
    return packed(TrajectoryGoal(tuple(TrajectoryPoint(0.1 * n, 0.5 * n, 0.0, 0.0) for n in range(points))))


JOG, TRACK = VelocityGoal(0.02, 0.0, 0.0, timeout=0.2), TrackGoal(0.01, 0.0, 0.0, timeout=0.2)
ANY = st.one_of(GOALS, st.integers(2, 50).map(trajectory))
STEPS: st.SearchStrategy[Step] = st.one_of(
    ANY.map(posts),
    ANY.map(lambda goal: posts(goal, user="ben")),
    ANY.map(lambda goal: posts(goal, known="again")),
    ANY.map(posts_and_stops),
    st.builds(PoseGoal, st.just(0.05), st.just(0.0), st.just(0.0), valid_for=st.just(0.01)).map(
        lambda goal: posts(goal, age=1.0)
    ),
    st.sampled_from([JOG, TRACK, VelocityGoal(9.0, 0.0, 0.0, timeout=0.2), TrackGoal(9.0, 0.0, 0.0, timeout=0.2)]).map(
        lambda goal: posts(goal, known="held")
    ),
    ANY.map(lambda goal: lambda rig, _: rig.cycle(CheckRequest(3, "ann", goal))),
    st.sampled_from(
        [
            *(commands(name) for name in (Command.STOP, Command.PAUSE, Command.DISABLE, Command.ENABLE)),
            commands(Command.QUICK_STOP),
            commands(Command.RESET),
            commands(Command.ACQUIRE, AcquireLease("mine", 0.1), user="ben"),
            commands(Command.RELEASE, ReleaseLease("mine"), user="ben"),
            loses_planner,
        ]
    ),
    st.integers(1, 300).map(lambda cycles: lambda rig, _: rig.cycles(cycles)),
)


@settings(max_examples=100)
@example(steps=[posts(trajectory(50))], enabled=False)
@example(steps=[posts(trajectory(50)), lambda rig, _: rig.cycles(50)], enabled=True)
@given(steps=st.lists(STEPS, min_size=1, max_size=12), enabled=st.booleans())
def test_of_goals_that_are_over_nothing_is_kept_but_their_ends(steps: list[Step], enabled: bool) -> None:
    rig = ControlRig(CONFIG)
    if enabled:
        rig.enable()
    for number, step in enumerate(steps):
        step(rig, f"g{number}")
    rig.cycles(300)  # until what was sent has been answered, and jogs and leases are over
    rig.command("quick_stop")
    rig.until(lambda: rig.mode is Mode.FAULT)
    last = PoseGoal(0.0, 0.0, 0.0)
    assert isinstance(rig.send("last", last), Refused)
    kept = kept_by(rig.control)
    assert [each for each in kept if isinstance(each, BaseException | TracebackType | FrameType)] == []
    assert [each for each in kept if isinstance(each, GoalKind) and structs.asdict(each) != structs.asdict(last)] == []
