"""Capture of pictures that show the current pose. Pictures are checked, averaged, and separated from stale ones.

Between two looks, the platform moves by a measured amount, and the calibration predicts the displacement of each mark.
A picture that shows the marks elsewhere was either taken before the motion, because the camera buffers pictures, or the
calibration no longer matches the camera. A single look cannot distinguish these cases. A further picture can, because a
late camera catches up.
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
"""Number of pictures contradicting the motion after which the capture ends. Video drivers buffer 1 to 4 pictures."""
NOISE_DEVIATIONS = 4.0
"""Root mean square errors of a place in the plane beyond which noise does not explain a difference: 1 in 10^7."""
MAX_MISS_SHARE = 0.2
"""Share of a motion by which a mark may miss its predicted position. A camera turned by 5°, an error of 5 % in
scale, or an error of 5 mm in the centre of rotation causes a miss of up to a tenth."""
MIN_TRAVEL_SHARE = 0.5
"""Share of its predicted travel below which a mark counts as unmoved."""


class PictureFit(NamedTuple):
    """Agreement of pictures with the preceding motion."""

    pictures: Sequence[Observation]
    explained: bool
    """True if the motion explains the pictures."""
    still: bool = False
    """True if the pictures show the marks unmoved, or contradict each other."""


def capture(count: int) -> Generator[AlignmentRequest, Observation, list[Observation]]:
    """Return `count` pictures. Raises AlignmentError if one has no valid pixels."""
    pictures = []
    for _ in range(count):
        pictures.append(validate_picture((yield LOOK)))  # noqa: PERF401 - a comprehension cannot yield
    return pictures


def validate_picture(picture: Observation) -> Observation:
    """Return a picture with plain floats. Raises AlignmentError unless its marks are {name: (u, v)}."""
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
                AlignmentFault.MISSING, f"look returned {value!r:.60} for mark {name!r:.60}: expected two finite pixels"
            )
        plain[name] = pixel
    return picture._replace(marks=plain)


def average(pictures: Sequence[Observation]) -> Observation:
    """Return the mean of pictures. The mean of a mark is taken over the pictures that show it."""
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
    """Return `count` pictures that agree with the motion since `before`, or the last of MAX_STALE_PICTURES that do not.

    Parameters
    ----------
    calibration
        Calibration of the cameras.
    before
        Look before the motion.
    count
        Pictures per look.
    tolerance
        Miss of a predicted place that is always accepted [m].
    """
    fresh: list[Observation] = []
    stale: list[Observation] = []
    while len(fresh) < count and len(stale) < MAX_STALE_PICTURES:
        (picture,) = yield from capture(1)
        miss, travel = _compare(calibration, before, picture, count)
        (fresh if miss <= MAX_MISS_SHARE * travel + tolerance else stale).append(picture)
    if len(fresh) == count:
        return PictureFit(fresh, explained=True)
    # Several pictures that agree with each other, but not with the motion, contradict the calibration: explained and
    # still are both False. A camera that is late shows the marks unmoved, or moves them between the pictures.
    newest = stale[-1]
    recent = stale[-min(count, MAX_STALE_PICTURES - 1) :]
    are_equal = all(_compare(calibration, newest, each, 1)[0] <= tolerance for each in recent)
    miss, travel = _compare(calibration, before, newest, count)
    is_unmoved = miss > (1.0 - MIN_TRAVEL_SHARE) * travel
    return PictureFit(stale[-count:], explained=False, still=not are_equal or is_unmoved)


def is_consistent(
    calibration: CameraCalibration, look: Observation, picture: Observation, count: int, tolerance: float
) -> bool:
    """Return True if a picture agrees with a look, the mean of `count` pictures, within a tolerance [m] and noise."""
    return _compare(calibration, look, picture, count)[0] <= tolerance


def observe_mean(count: int) -> Generator[AlignmentRequest, Observation, Observation]:
    """Return the mean of `count` pictures. The mean of a mark is taken over the pictures that show it."""
    return average((yield from capture(count)))


def single_picture_noise(calibration: CameraCalibration) -> float:
    """Return the standard deviation of a mark's u or v in a single picture [pixel]."""
    return calibration.noise * math.sqrt(calibration.looks)


def _compare(
    calibration: CameraCalibration, before: Observation, picture: Observation, count: int
) -> tuple[float, float]:
    """Return the greatest miss of a mark beyond the noise, and the longest predicted travel of one [m]."""
    miss = travel = 0.0
    for name in sorted(set(before.marks) & set(picture.marks) & set(calibration.marks)):
        view = calibration.views[calibration.marks[name].view]
        start, observed = locate_pixels(view, np.array([before.marks[name], picture.marks[name]]))
        predicted = _move_with_platform(start, before.pose, picture.pose)
        # Variances in units of one coordinate: 1 for the picture, 1/count for the mean before it; both coordinates.
        noise = single_picture_noise(calibration) / view.scale * math.sqrt(2.0 * (1.0 + 1.0 / count))
        miss = max(miss, float(np.linalg.norm(observed - predicted)) - NOISE_DEVIATIONS * noise)
        travel = max(travel, float(np.linalg.norm(predicted - start)))
    return miss, travel


def _move_with_platform(point: Floats, before: Sequence[float], now: Sequence[float]) -> Floats:
    """Return a point of the base frame, (2,) [m], after a motion of the platform that carries it between two poses."""
    return np.asarray(now[:2] + rotation_matrix(now[2] - before[2]) @ (point - before[:2]))
