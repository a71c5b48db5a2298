"""Capture of pictures of the current pose. Pictures are checked and averaged, and stale pictures are recognised.

Between two looks, the platform moves by a measured amount, and the calibration predicts the displacement of each mark.
If a picture shows the marks at other positions, there are two possible causes. The picture was taken before the motion,
because the camera buffers pictures, or the calibration no longer matches the camera. A single picture cannot
distinguish these causes. Further pictures can, because a late camera eventually shows the current pose.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trirail.alignment.alignment_request import LOOK, AlignmentRequest, Observation
from trirail.alignment.arguments import parse_pixel
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.alignment.images import Pair, locate_pixels
from trirail.alignment.rigid_motion import Floats, rotation_matrix
from trirail.errors import AlignmentError, AlignmentFault

MAX_STALE_PICTURES = 5
"""Number of pictures that contradict the motion after which the capture ends. Video drivers buffer 1 to 4 pictures."""
NOISE_DEVIATIONS = 4.0
"""Greatest difference of positions in the plane that is attributed to noise, in root-mean-square errors of a position.
Noise exceeds this difference in one of 10^7 cases."""
OLD_PICTURE_DEVIATIONS = 6.0
"""The same for a motion: with NOISE_DEVIATIONS, noise would let one in two old pictures agree with a motion of this
difference, and with this number, one in 400."""
MAX_MISS_SHARE = 0.2
"""Greatest distance of a mark from its predicted position, as a fraction of the motion. A camera rotated by 5°, an
error of the scale by 5 %, or an error of the centre of rotation by 5 mm cause a fraction of up to 0.1."""
MIN_TRAVEL_SHARE = 0.5
"""Fraction of the predicted travel below which a mark counts as unmoved."""


class PictureFit(NamedTuple):
    """Pictures after a motion, and their agreement with the motion."""

    pictures: Sequence[Observation]
    explained: bool
    """True if the pictures show the marks where the motion should have moved them."""
    still: bool = False
    """True if the pictures show the marks unmoved, or if the pictures contradict each other."""


def capture(count: int) -> Generator[AlignmentRequest, Observation, list[Observation]]:
    """Request and return `count` pictures. Raises AlignmentError if a picture has invalid pixels."""
    pictures = []
    for _ in range(count):
        pictures.append(validate_picture((yield LOOK)))  # noqa: PERF401 - a comprehension cannot yield
    return pictures


def validate_picture(picture: Observation) -> Observation:
    """Convert the pixels of a picture to Python floats. Raises AlignmentError unless its marks are {name: (u, v)}."""
    marks: object = picture.marks
    if not isinstance(marks, Mapping):
        raise AlignmentError(
            AlignmentFault.MISSING, f"look returned {marks!r:.100}: expected {{mark: (u, v)}} in pixels"
        )
    plain = {}
    for name, value in marks.items():
        pixel = parse_pixel(value)
        if not isinstance(name, str) or pixel is None:
            raise AlignmentError(
                AlignmentFault.MISSING,
                f"look returned {value!r:.60} for mark {name!r:.60}: expected two pixels within ±1e7",
            )
        plain[name] = pixel
    return picture._replace(marks=plain)


def average(pictures: Sequence[Observation]) -> Observation:
    """Return the mean of pictures. Each mark is averaged over the pictures that show the mark."""
    seen: dict[str, list[Pair]] = {}
    for each in pictures:
        for name, pixel in each.marks.items():
            seen.setdefault(name, []).append(pixel)
    marks = {
        name: (math.fsum(u for u, _ in p) / len(p), math.fsum(v for _, v in p) / len(p)) for name, p in seen.items()
    }
    x, y, phi = np.mean([each.pose for each in pictures], axis=0).tolist()
    readings = [each.sliders for each in pictures if each.sliders is not None]
    a, b, c = np.mean(readings, axis=0).tolist() if readings else (0.0, 0.0, 0.0)
    return Observation(marks, (x, y, phi), pictures[-1].time, (a, b, c) if readings else None)


def capture_after_motion(
    calibration: CameraCalibration, before: Observation, count: int, tolerance: float
) -> Generator[AlignmentRequest, Observation, PictureFit]:
    """Capture pictures after a motion until enough of them show the current pose.

    The capture ends when `count` pictures agree with the motion since the look `before`, or when MAX_STALE_PICTURES
    pictures contradict the motion. After a motion that is too small to be seen in a picture, the first
    MAX_STALE_PICTURES - 1 pictures are not used.

    Parameters
    ----------
    calibration
        Calibration of the cameras.
    before
        Look before the motion.
    count
        Number of pictures per look.
    tolerance
        Distance of a mark from its predicted position that is always accepted [m].
    """
    fresh: list[Observation] = []
    stale: list[Observation] = []
    (picture,) = yield from capture(1)
    old = picture._replace(marks=before.marks)
    if _is_explained(calibration, before, old, count, tolerance, OLD_PICTURE_DEVIATIONS):
        # An old picture would also agree with so small a motion, and would cause the same correction again.
        *_, picture = yield from capture(MAX_STALE_PICTURES - 1)
    while True:
        (fresh if _is_explained(calibration, before, picture, count, tolerance) else stale).append(picture)
        if len(fresh) == count or len(stale) == MAX_STALE_PICTURES:
            break
        (picture,) = yield from capture(1)
    if len(fresh) == count:
        return PictureFit(fresh, explained=True)
    # If the pictures agree with each other, but not with the motion, the calibration is wrong: `explained` and `still`
    # are False. If the camera is late, the marks are unmoved, or they move from picture to picture.
    newest = stale[-1]
    recent = stale[-min(count, MAX_STALE_PICTURES - 1) :]
    are_equal = all(_compare(calibration, newest, each, 1)[0] <= tolerance for each in recent)
    miss, travel = _compare(calibration, before, newest, count)
    is_unmoved = miss > (1.0 - MIN_TRAVEL_SHARE) * travel
    return PictureFit(stale[-count:], explained=False, still=not are_equal or is_unmoved)


def _is_explained(
    calibration: CameraCalibration,
    before: Observation,
    picture: Observation,
    count: int,
    tolerance: float,
    deviations: float = NOISE_DEVIATIONS,
) -> bool:
    """Return True if a picture agrees with the motion since the look `before`, the mean of `count` pictures."""
    miss, travel = _compare(calibration, before, picture, count, deviations)
    return miss <= MAX_MISS_SHARE * travel + tolerance


def is_consistent(
    calibration: CameraCalibration, look: Observation, picture: Observation, count: int, tolerance: float
) -> bool:
    """Return True if a picture agrees with a look within a tolerance [m] and the noise.

    `look` is the mean of `count` pictures.
    """
    return _compare(calibration, look, picture, count)[0] <= tolerance


def observe_mean(count: int) -> Generator[AlignmentRequest, Observation, Observation]:
    """Request `count` pictures and return their mean; see `average`."""
    return average((yield from capture(count)))


def single_picture_noise(calibration: CameraCalibration, view: str) -> float:
    """Return the standard deviation of the u or v of a mark of a view in a single picture [pixel]."""
    return calibration.noise_of(view) * math.sqrt(calibration.looks)


def _compare(
    calibration: CameraCalibration,
    before: Observation,
    picture: Observation,
    count: int,
    deviations: float = NOISE_DEVIATIONS,
) -> tuple[float, float]:
    """Compare a picture with the prediction from a look and the measured motion.

    Returns the greatest distance of a mark from its predicted position, minus `deviations` times the noise, and the
    longest predicted travel of a mark [m].
    """
    miss = travel = 0.0
    for name in sorted(set(before.marks) & set(picture.marks) & set(calibration.marks)):
        shown_by = calibration.marks[name].view
        view = calibration.views[shown_by]
        start, observed = locate_pixels(view, np.array([before.marks[name], picture.marks[name]]))
        predicted = _move_with_platform(start, before.pose, picture.pose)
        # Variance of the difference: 1 for the picture plus 1/count for the look, in each of two coordinates.
        noise = single_picture_noise(calibration, shown_by) / view.scale * math.sqrt(2.0 * (1.0 + 1.0 / count))
        miss = max(miss, float(np.linalg.norm(observed - predicted)) - deviations * noise)
        travel = max(travel, float(np.linalg.norm(predicted - start)))
    return miss, travel


def _move_with_platform(point: Floats, before: Sequence[float], now: Sequence[float]) -> Floats:
    """Return the position of a point of the platform, (2,) [m], after the platform has moved between two poses.

    `point` is the position in the base frame before the motion.
    """
    return np.asarray(now[:2] + rotation_matrix(now[2] - before[2]) @ (point - before[:2]))
