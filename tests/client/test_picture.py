"""A robot as notebooks show it: well-formed, to scale, and nothing of what others have named read as markup."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import msgspec
import numpy as np
import pytest
from cli.test_live import COUNTS, REST, a_state
from hypothesis import given
from hypothesis import strategies as st
from trirail.client import picture
from trirail.config import SIM, geometry, load
from trirail.kinematics.robot import inverse
from trirail.processes.publications import info
from trirail.wire.state import CommandedMotion, GoalState, Pose, Sliders, State
from trirail.workspace import part_positions

SHIPPED = sorted(SIM.parent.glob("*.toml"))
SVG = "{http://www.w3.org/2000/svg}"
SHARES = st.floats(-0.3, 0.3)


def at(pose: tuple[float, float, float], path: Path) -> State:
    moved = inverse(geometry(load(path).geometry), np.array(pose), np.zeros(3), np.zeros(3))
    a, b, c = moved.position.tolist()
    sliders = Sliders((a, b, c), (a, b, c), REST, REST, ("operation enabled",) * 3, (COUNTS,) * 3)
    return a_state(
        pose=pose, sliders=sliders, commanded=CommandedMotion(Pose(*pose), REST, REST, (a, b, c), REST, REST)
    )


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
@given(shares=st.tuples(SHARES, SHARES, SHARES))
def test_the_drawing_shows_carriages_and_platform_where_they_are(
    path: Path, shares: tuple[float, float, float]
) -> None:
    config = load(path)
    reach = max(high - low for low, high in config.limits.slider.positions)
    pose = (shares[0] * reach / 4.0, shares[1] * reach / 4.0, 0.05 * shares[2])
    state = at(pose, path)
    drawn = ET.fromstring(picture.html(info(config), state))
    (svg,) = drawn.iter(f"{SVG}svg")
    left, top, width, height = map(float, svg.attrib["viewBox"].split())
    circles = [(float(each.attrib["cx"]), float(each.attrib["cy"])) for each in svg.iter(f"{SVG}circle")]
    robot = geometry(config.geometry)
    carriages = part_positions.slider_points(robot, np.array([state.sliders.position]))[0]
    np.testing.assert_allclose(circles[:3], carriages, rtol=1e-5, atol=1e-6 * width)
    np.testing.assert_allclose(circles[-1], pose[:2], rtol=1e-5, atol=1e-9)
    for x, y in circles:
        assert left <= x <= left + width
        assert top <= -y <= top + height


@given(st.tuples(st.booleans(), st.booleans(), st.booleans()))
def test_the_drawing_shows_carriages_and_platform_only_if_all_are_homed(homed: tuple[bool, bool, bool]) -> None:
    state = at((0.01, 0.02, 0.0), SIM)
    state = msgspec.structs.replace(state, sliders=msgspec.structs.replace(state.sliders, homed=homed))
    drawn = ET.fromstring(picture.html(info(load(SIM)), state))
    assert bool(list(drawn.iter(f"{SVG}circle"))) is all(homed)
    assert list(drawn.iter(f"{SVG}polyline"))


@given(st.text(max_size=20), st.text(min_size=1, max_size=20))
def test_what_others_have_named_is_no_markup(goal: str, fault: str) -> None:
    goal, fault = (f"<b>&{words}" if words.isprintable() else "<i>" for words in (goal, fault))
    state = a_state(goal=GoalState(goal, 0.5, 1.0, None), faults=(fault,), mode="fault")
    drawn = ET.fromstring(picture.html(info(load(SIM)), state))
    assert [bold.text for bold in drawn.iter("b")] == ["demo", goal, fault]


def test_a_line_says_where_it_is_and_what_it_does() -> None:
    state = a_state(mode="moving", pose=(0.02, -0.01, 0.1), goal=GoalState("g-17", 0.5, 1.0, None))
    assert picture.line("demo", state) == "<Robot demo: moving to g-17, x 20 mm, y -10 mm, φ 5.72958°>"
    assert picture.line("demo", a_state(mode="fault", faults=("drive A: gone",))).startswith(
        "<Robot demo: fault: drive A: gone, x 0 mm"
    )
