"""What a message may say, also where it was made in Python and never decoded: ids to be shown, numbers to plan with."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest
from trirail.wire.goals import (
    SHORTEST_PIECE,
    MoveGoal,
    NamedGoal,
    OwnLimits,
    PoseGoal,
    SlidersGoal,
    TrackGoal,
    TrajectoryGoal,
    TrajectoryPoint,
    VelocityGoal,
)
from trirail.wire.vocabulary import AcquireLease, Override

POINTS = (TrajectoryPoint(0.0, 0.0, 0.0, 0.0), TrajectoryPoint(1.0, 0.01, 0.0, 0.0))
GOOD: dict[type[Any], dict[str, Any]] = {
    PoseGoal: {"x": 0.01, "y": 0.0, "phi": 0.0},
    MoveGoal: {"x": 0.01, "y": 0.0, "phi": 0.0},
    NamedGoal: {"name": "pick"},
    SlidersGoal: {"position": (0.01, 0.0, 0.0)},
    VelocityGoal: {"x": 0.01, "y": 0.0, "phi": 0.0},
    TrackGoal: {"x": 0.01, "y": 0.0, "phi": 0.0},
    TrajectoryGoal: {"points": POINTS},
    AcquireLease: {},
}
NUMBERS = [
    (kind, name)
    for kind, content in GOOD.items()
    for name in ("x", "y", "phi", "speed", "timeout", "valid_for", "blend", "time")
    if name in kind.__struct_fields__ and (content or name == "timeout")
]
TRIPLES = [(SlidersGoal, "position"), (TrackGoal, "velocity")]
NO_NUMBERS = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("kind", GOOD)
def test_an_id_that_cannot_be_shown_is_refused(kind: type[Any]) -> None:
    assert kind(**GOOD[kind], id="g 17").id == "g 17"
    assert kind(**GOOD[kind]).id is None
    printable = "is not printable; use 1 to 64 characters"
    bad = {
        "": "'' is empty",
        "\x1b[2J": printable,
        "a\nb": printable,
        "x" * 65: r"is too long \(65 characters\); use 1 to 64",
    }
    for name, problem in bad.items():
        with pytest.raises(ValueError, match=problem):
            kind(**GOOD[kind], id=name)


@pytest.mark.parametrize("number", NO_NUMBERS)
@pytest.mark.parametrize(("kind", "name"), NUMBERS)
def test_a_number_that_is_not_finite_is_refused(kind: type[Any], name: str, number: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: .* is not a finite number"):
        kind(**GOOD[kind] | {name: number})


@pytest.mark.parametrize("number", NO_NUMBERS)
@pytest.mark.parametrize("index", range(3))
def test_so_is_any_of_three(index: int, number: float) -> None:
    three: Any = [0.1, 0.1, 0.1]
    three[index] = number
    for kind, name in TRIPLES:
        with pytest.raises(ValueError, match=f"{name}: .* is not a finite number"):
            kind(**GOOD[kind] | {name: tuple(three)})
    for name in ("velocity", "acceleration", "jerk"):
        with pytest.raises(ValueError, match=f"{name}: .* is not a finite number"):
            OwnLimits(**{name: tuple(three)})
    for name in ("velocity", "acceleration"):
        with pytest.raises(ValueError, match=f"{name}: .* is not a finite number"):
            TrajectoryPoint(0.0, 0.0, 0.0, 0.0, **{name: tuple(three)})


@pytest.mark.parametrize("later", [0.0, -1.0, 0.9 * SHORTEST_PIECE])
def test_the_times_of_a_trajectory_rise(later: float) -> None:
    for begin in (0.0, 100.0):
        first, last = (
            msgspec.structs.replace(point, t=begin + t) for point, t in zip(POINTS, (0.0, later), strict=True)
        )
        with pytest.raises(ValueError, match="times must rise"):
            TrajectoryGoal((first, last))


def test_points_may_follow_each_other_as_soon_as_is_said() -> None:
    """Wherever the clock stands, at which a difference loses its last digits."""
    for begin in (-86_000.0, 0.0, 0.3, 86_000.0):
        last = msgspec.structs.replace(POINTS[1], t=begin + SHORTEST_PIECE)
        assert TrajectoryGoal((msgspec.structs.replace(POINTS[0], t=begin), last)).points[1] == last


@pytest.mark.parametrize(("percent", "taken"), [(0.0, True), (1e-9, False), (0.99, False), (1.0, True), (150.0, True)])
def test_an_override_is_nothing_or_a_percent_at_least(percent: float, taken: bool) -> None:
    if taken:
        assert Override(percent).percent == percent
    else:
        with pytest.raises(ValueError, match="0, or 1 to 200"):
            Override(percent)
    with pytest.raises(ValueError, match="finite"):
        Override(math.nan)
