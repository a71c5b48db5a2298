"""The state as people read it: all that matters by name, with units, and limits only where they are near."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console
from trirail.cli import live, pendant, terminal
from trirail.client import picture
from trirail.client.client import Jog, Robot
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.processes.publications import info
from trirail.wire.state import (
    CommandedMotion,
    CorrectionInfo,
    FrameCounts,
    GoalState,
    LoopState,
    Percentiles,
    Pose,
    Sliders,
    State,
)
from trirail.wire.units import ANGLE, LENGTH, VELOCITY, quantity
from trirail_drivers.interface import NAMES

LIMITS = load(SIM).limits
NONE = Percentiles(0.0, 0.0, 0.0, 0.0)
COUNTS = FrameCounts(0, 0, 0, 0)
REST = (0.0, 0.0, 0.0)


def a_state(**changed: Any) -> State:
    state = State(
        seq=1,
        t=1.0,
        time=1.7e9,
        mode="holding",
        pose=Pose(*REST),
        velocity=REST,
        acceleration=REST,
        commanded=CommandedMotion(Pose(*REST), REST, REST, REST, REST, REST),
        sliders=Sliders(REST, REST, REST, REST, ("operation enabled",) * 3, (COUNTS,) * 3),
        goal=None,
        settled=True,
        override=1.0,
        faults=(),
        loop=LoopState(1000, 1, 0, NONE, NONE, NONE, 500.0, 0.5, 0.4, ()),
    )
    return msgspec.structs.replace(state, **changed)


def printed(state: State) -> dict[str, str]:
    """Return the lines by name."""
    console = Console(width=160, color_system=None, no_color=True)
    with console.capture() as captured:
        console.print(live.table(state, "demo", NAMES, LIMITS))
    rows = (re.fullmatch(r" *(\S+(?: \S+)?)  +(.*?) *", line) for line in captured.get().splitlines())
    return {row[1]: row[2] for row in rows if row}


@given(st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0)), st.floats(-0.3, 0.3))
def test_what_is_printed_can_be_typed(pose: tuple[float, float, float], slider: float) -> None:
    sliders = Sliders((slider, 0.0, 0.0), (slider, 0.0, 0.0), REST, REST, ("ready",) * 3, (COUNTS,) * 3)
    lines = printed(a_state(pose=pose, sliders=sliders))
    x, y, phi = re.findall(r"[xyφ] +(-?[\d.]+ ?(?:mm|°))", lines["measured"])
    assert quantity(x, LENGTH) == pytest.approx(pose[0], abs=0.51e-6)
    assert quantity(y, LENGTH) == pytest.approx(pose[1], abs=0.51e-6)
    assert quantity(phi, ANGLE) == pytest.approx(pose[2], abs=math.radians(0.51e-4))
    assert quantity(lines["slider A"].split("  ")[0], LENGTH) == pytest.approx(slider, abs=0.51e-6)
    rate = re.findall(r"-?[\d.]+ mm/s", lines["slider A"])[0]
    assert quantity(rate, VELOCITY) == pytest.approx(slider, abs=0.51e-5)


def test_measured_and_commanded_stand_below_each_other() -> None:
    commanded = CommandedMotion(Pose(0.01, -0.02, 0.1), REST, REST, REST, REST, REST)
    lines = printed(a_state(pose=(0.011, 0.0, 0.0), commanded=commanded))
    assert lines["measured"] == "x    11.000 mm   y     0.000 mm   φ    0.0000°"
    assert lines["commanded"] == "x    10.000 mm   y   -20.000 mm   φ    5.7296°"


def test_a_goal_is_shown_with_its_target_and_how_far_it_is() -> None:
    goal = GoalState("g-17", 0.25, 1.5, Pose(0.05, 0.0, 0.0))
    lines = printed(a_state(mode="moving", pose=(0.02, 0.0, 0.0), goal=goal, settled=False, override=0.5))
    assert lines["goal"] == "g-17  25%, 1.5 s left"
    assert lines["target"].startswith("x    50.000 mm")
    assert lines["to go"].startswith("x    30.000 mm")
    assert lines["override"] == "50 %"
    assert "paused" not in lines["robot"]
    assert "settled" not in lines["robot"]


def test_a_paused_goal_and_a_robot_that_has_settled_are_named() -> None:
    assert "holding  paused" in printed(a_state(goal=GoalState("g", 0.5, 1.0, None)))["robot"]
    assert printed(a_state(goal=GoalState("g", 0.5, 1.0, None)))["goal"] == "g  50%, no expected end while it is paused"
    slow = a_state(mode="moving", goal=GoalState("g", 0.5, 1.0, None), override=0.0)
    assert printed(slow)["goal"] == "g  50%, no expected end while the override is 0"
    assert "holding  settled" in printed(a_state())["robot"]
    assert printed(a_state(faults=("drive B: over-current",)))["fault"] == "drive B: over-current"


def near(state: State) -> list[str]:
    return list(live.near_limits(state, LIMITS, NAMES))


def test_limits_are_shown_only_where_they_are_near() -> None:
    assert near(a_state()) == []
    high = LIMITS.platform.x[1]
    assert near(a_state(pose=(high - 0.001, 0.0, 0.0))) == [
        f"x {(high - 0.001) * 1e3:.3f} mm, limit {high * 1e3:.3f} mm"
    ]
    error = LIMITS.slider.following_error
    sliders = Sliders(REST, REST, (0.0, -0.96 * error, 0.0), REST, ("ready",) * 3, (COUNTS,) * 3)
    (said,) = near(a_state(sliders=sliders))
    assert said == f"following error of B {-0.96e6 * error:.1f} µm, limit {-1e6 * error:.1f} µm"


@given(st.floats(-1.0, 1.0))
def test_a_position_beyond_its_limit_is_always_said(at: float) -> None:
    low, high = LIMITS.slider.positions[0]
    sliders = Sliders((at, 0.0, 0.0), REST, REST, REST, ("ready",) * 3, (COUNTS,) * 3)
    said = [words for words in near(a_state(sliders=sliders)) if words.startswith("slider A")]
    close = min(abs(at - low), abs(high - at)) <= 0.05 * (high - low)
    assert bool(said) == (close or not low <= at <= high)


def test_a_correction_that_is_on_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    plain = info(load(SIM))
    live.show(a_state(), plain)
    assert "corrected" not in capsys.readouterr().out
    told = CorrectionInfo("map.toml", "2026-05-01", (5e-5, 4e-5, 1e-4), (5e-5, 0.0, 1e-5))
    live.show(a_state(), msgspec.structs.replace(plain, correction=told))
    words = " ".join(capsys.readouterr().out.split())
    assert "corrected map.toml, measured 2026-05-01: up to 50.0 µm in x, 40.0 µm in y, 0.100 mrad; " in words
    assert "backlash of A 50.0 µm, B 0.0 µm, C 10.0 µm" in words


def test_the_share_of_the_time_that_the_bus_leaves_fits_a_narrow_terminal() -> None:
    state = a_state()
    late = msgspec.structs.replace(state.loop, setpoints_us=Percentiles(58.0, 234.0, 731.0, 9886.0))
    console = Console(width=80, color_system=None, no_color=True)
    with console.capture() as captured:
        console.print(live.table(msgspec.structs.replace(state, loop=late), "demo", NAMES, LIMITS))
    assert "p50 12%, p99.9 146%, worst 1977% of the 500 µs that the bus leaves" in captured.get()


@pytest.mark.parametrize("homed", [(True, True, True), (True, False, True), (False, False, False)])
def test_a_position_that_is_not_homed_is_not_shown_as_measured(homed: tuple[bool, bool, bool]) -> None:
    state = a_state()
    lines = printed(msgspec.structs.replace(state, sliders=msgspec.structs.replace(state.sliders, homed=homed)))
    assert ("not homed" in lines["measured"]) is not all(homed)
    for known, name in zip(homed, NAMES, strict=True):
        assert lines[f"slider {name}"].startswith("not homed") is not known


HOMED = st.tuples(st.booleans(), st.booleans(), st.booleans())
AT_LIMITS = Pose(LIMITS.platform.x[1], LIMITS.platform.y[0], LIMITS.platform.phi[1])


def state_homed(homed: tuple[bool, bool, bool]) -> State:
    """Return a state in which every measured value that is not homed would be near a limit."""
    ends = [high if known else low for known, (low, high) in zip(homed, LIMITS.slider.positions, strict=True)]
    a, b, c = ends
    sliders = Sliders((a, b, c), REST, REST, REST, ("operation enabled",) * 3, (COUNTS,) * 3, homed)
    return a_state(pose=AT_LIMITS, sliders=sliders, goal=GoalState("g-17", 0.25, 1.5, Pose(0.05, 0.0, 0.0)))


class States:
    """Robot that sends a single state."""

    def __init__(self, state: State) -> None:
        self.state = state

    def states(self, _timeout: float) -> list[State]:
        return [self.state]


@given(HOMED)
def test_a_pose_is_shown_only_if_all_sliders_are_homed(homed: tuple[bool, bool, bool]) -> None:
    state = state_homed(homed)
    with terminal.out.capture() as captured:
        live._print_once_a_second(cast(Robot, States(state)))
    shown = [
        captured.get(),
        picture.line("demo", state),
        picture.html(info(load(SIM)), state).split("<svg")[0],
        pendant._shown(cast(pendant.Pendant, SimpleNamespace(speed=REST, said="")), state).plain,
    ]
    for text in shown:
        assert ("not homed" in text) is not all(homed)
        assert (re.search(r"\bx +-?\d", text) is not None) is all(homed)
    lines = printed(state)
    assert ("to go" in lines) is all(homed)
    near_names = {words.split(",")[0].rsplit(" ", 2)[0] for words in near(state)}
    assert near_names >= {f"slider {name}" for name, known in zip(NAMES, homed, strict=True) if known}
    assert near_names <= {"x", "y", "φ"} | {f"slider {n}" for n, known in zip(NAMES, homed, strict=True) if known}
    assert ("x" in near_names) is all(homed)


@given(columns=st.integers(10, 200), faults=st.lists(st.text("ab ", min_size=1, max_size=200), max_size=2))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_state_in_a_pipe_is_neither_wrapped_nor_cut(
    columns: int, faults: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = []
    for width in (columns, 1000):
        with monkeypatch.context() as terminal_of_width:
            terminal_of_width.setenv("COLUMNS", str(width))
            live.show(a_state(faults=tuple(faults)), info(load(SIM)))
            shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]


def test_a_terminal_that_cannot_redraw_gets_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dumb = Console(force_terminal=True, width=200, _environ={"TERM": "dumb"})
    monkeypatch.setattr(terminal, "out", dumb)
    monkeypatch.setattr(live, "out", dumb)
    robot = SimpleNamespace(name="demo", info=lambda: info(load(SIM)), states=lambda _timeout: [a_state()])
    with pytest.raises(ServiceError, match="no longer sends its state"):
        live.watch(cast(Robot, robot), json_lines=False)
    assert capsys.readouterr().out.startswith("1.00 s  holding  ")


@pytest.mark.parametrize("show", [True, False])
def test_a_jog_that_prints_json_writes_no_terminal_codes(
    show: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live, "out", Console(force_terminal=True))
    jog = SimpleNamespace(error=None, result="done")
    robot = SimpleNamespace(name="demo", states=lambda _timeout: [a_state()])
    live.show_jog(cast(Robot, robot), cast(Jog, jog), NAMES, show=show)
    assert bool(capsys.readouterr().out) is show
