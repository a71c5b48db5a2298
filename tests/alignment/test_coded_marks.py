"""Codes: each is read with its number, and placed as well as a round mark."""

import math

import numpy as np
import pytest
from trirail.alignment.code_family import CodeFamily
from trirail.alignment.coded_marks import code_shape, find_codes
from trirail.alignment.finding import find
from trirail.alignment.images import CameraView
from trirail.alignment.rigid_motion import Floats, rotation_matrix
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera

pytest.importorskip("cv2", reason="codes are read by OpenCV: pip install 'trirail[vision]'")
SCALE, SIDE = 2.6e5, 300e-6
AT = (3.1e-5, -1.7e-5, 0.05)
FAMILIES: tuple[CodeFamily, ...] = ("4x4_50", "5x5_100", "apriltag_16h5", "apriltag_36h11")


def drawn(shape: MarkShape, turn: float, mirror: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return a picture of a dark mark in uneven light, and the pixel of its middle."""
    (a, b), (c, d) = (SCALE * rotation_matrix(turn) @ np.diag([1.0, mirror])).tolist()
    view = CameraView((0.0, 0.0), (160.0, 120.0), ((a, b), (c, d)))
    camera = SimulatedCamera(view, {"m": DrawnMark(shape, (0.0, 0.0))}, 320, 240, 180.0, -120.0, noise=4.0, shade=0.2)
    return camera.picture(lambda _: AT, 0.0, rng).astype(float), np.array(camera.pixels_at(AT)["m"])


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_code_is_read_in_any_direction_and_placed(family: CodeFamily, mirror: float) -> None:
    rng = np.random.default_rng(4)
    for number in (0, 8, 17):
        turn = float(rng.uniform(-math.pi, math.pi))
        picture, at = drawn(code_shape(family, number, SIDE), turn, mirror, rng)
        (found,) = find_codes(picture, family)
        assert found.number == number
        assert (found.mark.u, found.mark.v) == pytest.approx(at, abs=0.03)
        assert found.side == pytest.approx(SIDE * SCALE, rel=0.01)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_codes_are_read_at_every_depth(bits: int) -> None:
    picture, at = drawn(code_shape("4x4_50", 7, SIDE), 0.4, 1.0, np.random.default_rng(bits))
    (found,) = find_codes((picture * 2.0 ** (bits - 8)).astype(np.uint16), "4x4_50")
    assert found.number == 7
    assert (found.mark.u, found.mark.v) == pytest.approx(at, abs=0.03)


@pytest.mark.long
def test_codes_are_placed_as_well_as_discs_of_their_size() -> None:
    rng = np.random.default_rng(5)
    codes, discs = [], []
    for number in range(8):
        turn = float(rng.uniform(-math.pi, math.pi))
        picture, at = drawn(code_shape("4x4_50", number, SIDE), turn, 1.0, rng)
        (code,) = find_codes(picture, "4x4_50")
        codes.append(np.subtract((code.mark.u, code.mark.v), at))
        picture, at = drawn(MarkShape("disc", SIDE), turn, 1.0, rng)
        disc = find(picture, MarkShape("disc", SIDE * SCALE))
        assert disc is not None
        discs.append(np.subtract((disc.u, disc.v), at))
    assert np.sqrt(np.mean(np.square(codes))) < 1.2 * np.sqrt(np.mean(np.square(discs)))


def test_a_code_that_is_there_twice_and_one_of_another_family_are_not_taken() -> None:
    rng = np.random.default_rng(6)
    picture, _ = drawn(code_shape("4x4_50", 3, SIDE), 0.3, 1.0, rng)
    assert len(find_codes(picture, "4x4_50")) == 1
    assert find_codes(np.hstack([picture, picture]), "4x4_50") == []
    assert find_codes(picture, "apriltag_36h11") == []
    assert find_codes(np.full((240, 320), 90.0), "4x4_50") == []
