"""Detection of coded marks (ArUco and AprilTag), which contain a number and cannot be mistaken for each other.

The detector of OpenCV (Garrido-Jurado et al. 2014, Automatic generation and detection of highly reliable fiducial
markers under occlusion) reads the number of a code and returns its corners. For an accurate position,
trirail.alignment.finding then fits all edges of the code.
"""

from __future__ import annotations

import functools
import importlib
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trirail.alignment.code_family import CodeFamily
from trirail.alignment.finding import DetectedMark, fit_at
from trirail.alignment.rigid_motion import Floats
from trirail.alignment.shapes import MarkShape

MAX_SKEW = 0.1
"""Greatest relative difference between the sides of a code in a picture. Codes on the table are seen nearly from above,
and their sides are nearly equal."""


class CodedMark(NamedTuple):
    """Code that has been found in a picture."""

    number: int
    mark: DetectedMark
    """Position of the middle of the code. `turn` is the direction of the upper side. `size` is relative to the side
    that OpenCV found."""
    side: float
    """Length of the side of the code, including its border [pixel]."""


def code_shape(family: CodeFamily, number: int, side: float) -> MarkShape:
    """Return the shape of a code with its border. The second axis points downwards on the printed code.

    `side` may have any unit. Raises ImportError if OpenCV is not installed.
    """
    return MarkShape("code", side, cells=_cells(family, number))


def find_codes(picture: NDArray[np.generic], family: CodeFamily) -> list[CodedMark]:
    """Return the codes of a family in a grey picture, (rows, columns). Each number occurs at most once.

    Numbers that appear twice are ambiguous and are left out. The picture may be a mirror image of the table. Codes are
    therefore searched in the picture and in its mirror image, and the orientation with more codes is used. It is not
    enough that a code is found, because some codes are their own mirror images. Raises ImportError if OpenCV is not
    installed.
    """
    grey = np.asarray(picture, float)
    # OpenCV needs 8 bits. The values of a camera with 10 or 12 bits use only a part of 16 bits.
    low, high = float(grey.min()), float(grey.max())
    eight_bits = np.rint((grey - low) * (255.0 / max(high - low, 1e-300))).astype(np.uint8)
    detections, reflected = _detect(eight_bits, family), _detect(eight_bits[:, ::-1], family)
    is_mirrored = len(reflected) > len(detections)
    if is_mirrored:
        detections = [(number, _mirrored(corners, grey.shape[1])) for number, corners in reflected]
    numbers = [number for number, _ in detections]
    marks = []
    for number, corners in detections:
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        if numbers.count(number) > 1 or np.ptp(sides) > MAX_SKEW * sides.mean():
            continue
        side = float(sides.mean())
        shape = code_shape(family, number, side)
        along = corners[1] + corners[2] - corners[0] - corners[3]
        turn = math.atan2(along[1], along[0])
        if is_mirrored:  # in the picture, the second axis of the code is on the other side of the first axis
            shape = shape._replace(cells=shape.cells[::-1])
        u, v = corners.mean(axis=0).tolist()
        mark = fit_at(grey, shape, (u, v), turn)
        if mark is not None:
            marks.append(CodedMark(number, mark, side * mark.size))
    return marks


def _detect(grey: NDArray[np.uint8], family: CodeFamily) -> list[tuple[int, Floats]]:
    """Return number and corners (4, 2) [pixel] of each code, clockwise on the print from the upper left corner."""
    corners, numbers, _ = _detector(family).detectMarkers(np.ascontiguousarray(grey))
    if numbers is None:
        return []
    return [
        (int(number), np.asarray(each, float).reshape(4, 2))
        for number, each in zip(np.ravel(numbers), corners, strict=True)
    ]


def _mirrored(corners: Floats, columns: int) -> Floats:
    """Convert corners in the mirror image of a picture to corners in the original picture."""
    return np.column_stack([columns - 1.0 - corners[:, 0], corners[:, 1]])


@functools.cache
def _detector(family: CodeFamily) -> Any:
    cv2 = importlib.import_module("cv2")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # By error correction, the mirror image of a code could be read as another code. A wrong number is worse than a
    # missed code.
    parameters.errorCorrectionRate = 0.0
    return cv2.aruco.ArucoDetector(_dictionary(family), parameters)


@functools.cache
def _dictionary(family: CodeFamily) -> Any:
    cv2 = importlib.import_module("cv2")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family.upper()}"))


@functools.cache
def _cells(family: CodeFamily, number: int) -> tuple[tuple[int, ...], ...]:
    dictionary = _dictionary(family)
    side = dictionary.markerSize + 2
    return tuple(tuple(int(each == 0) for each in row) for row in dictionary.generateImageMarker(number, side))
