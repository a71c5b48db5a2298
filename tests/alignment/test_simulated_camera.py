"""The simulated camera: its marks are where they are found, and motion moves and smears them as it should."""

import math
from typing import Any

import numpy as np
import pytest
from alignment.cameras import camera
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.alignment.finding import find
from trirail.alignment.images import LENSES, CameraView, Lens
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail_drivers.interface import Triple

DISC = DrawnMark(MarkShape("disc", 160e-6), (0.06, 0.01))
VIEW = CameraView((0.06, 0.01), (160.0, 120.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
SHARP = SimulatedCamera(VIEW, {"m": DISC}, 320, 240, noise=1.0, shade=0.3)


@settings(max_examples=20)  # half a second each: pictures of 3 million pixels
@given(st.integers(0, 2**32 - 1), st.sampled_from(LENSES))
def test_a_mark_is_found_where_the_robot_really_stands(seed: int, lens: Lens) -> None:
    rng = np.random.default_rng(seed)
    view = camera(rng, DISC.place, lens)
    shown = SimulatedCamera(view, {"m": DISC}, 2000, 1600, noise=1.0, shade=0.2)
    pose = (rng.uniform(-2e-4, 2e-4), rng.uniform(-2e-4, 2e-4), rng.uniform(-2e-3, 2e-3))
    u, v = shown.pixels_at(pose)["m"]
    picture = shown.picture(lambda _: pose, 0.0, rng)
    left, top = max(0, int(u) - 80), max(0, int(v) - 80)
    found = find(picture[top : top + 160, left : left + 160], MarkShape("disc", 160e-6 * view.scale))
    assert found is not None
    assert (found.u + left, found.v + top) == pytest.approx((u, v), abs=0.05)


def moving(speed: float) -> tuple[float, float]:
    """Return where a mark is found, in u, while the table moves, and how sharp it is by its steepest edge."""
    shown = SHARP._replace(exposure=0.004, delay=0.010, noise=0.0)
    pose_at = lambda t: (speed * t, 0.0, 0.0)  # noqa: E731
    picture = shown.picture(pose_at, 0.0, np.random.default_rng(0))
    found = find(picture, MarkShape("disc", 40.0))
    assert found is not None
    return found.u, float(np.abs(np.diff(picture[120].astype(float))).max())


def test_a_moving_mark_is_where_it_was_at_the_middle_of_its_exposure_and_smeared() -> None:
    u, sharp = moving(0.0)
    moved, smeared = moving(0.01)
    assert moved - u == pytest.approx(-0.01 * 0.012 * 2.5e5, abs=0.2)
    assert smeared < 0.5 * sharp


def test_all_poses_of_an_exposure_are_read_before_the_picture_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes seconds on a slow machine, and the positions of a stage are kept only for seconds."""
    done: list[str] = []
    rendered = SimulatedCamera._render_marks

    def render(camera: SimulatedCamera, pose: Triple) -> Any:
        done.append("draw")
        return rendered(camera, pose)

    def pose_at(_time: float) -> Triple:
        done.append("read")
        return 0.0, 0.0, 0.0

    monkeypatch.setattr(SimulatedCamera, "_render_marks", render)
    SHARP._replace(exposure=0.004).picture(pose_at, 0.0, np.random.default_rng(0))
    assert done == sorted(done, reverse=True)
    assert done.count("draw") == done.count("read") > 1


def test_a_mark_outside_is_not_in_the_picture() -> None:
    away: Triple = (0.01, 0.0, math.radians(1.0))
    assert find(SHARP.picture(lambda _: away, 0.0, np.random.default_rng(0)), MarkShape("disc", 40.0)) is None
