"""Marks that show their own name: ArUco and AprilTag codes. OpenCV finds them, and a fit of their shape locates them.

Two round marks can be mistaken for each other, but two codes cannot. OpenCV's detector (Garrido-Jurado et al. 2014,
Automatic generation and detection of highly reliable fiducial markers under occlusion) reads the number and gives the
corners. trirail.alignment.finding then fits all edges of the code to obtain its position.
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
"""Greatest relative difference between a code's sides in a picture. Marks on the table are seen nearly from above."""


class CodedMark(NamedTuple):
    """Code that has been found in a picture."""

    number: int
    mark: DetectedMark
    """Position of the middle of the code. `turn` is the direction of its upper side; sizes are relative to OpenCV's
    side."""
    side: float
    """Side of the code with its border [pixel]."""


def code_shape(family: CodeFamily, number: int, side: float) -> MarkShape:
    """Return the shape of a code with its border, as printed with the second axis downwards; `side` in any unit.

    Raises ImportError without OpenCV.
    """
    return MarkShape("code", side, cells=_cells(family, number))


def find_codes(picture: NDArray[np.generic], family: CodeFamily) -> list[CodedMark]:
    """Return the codes of a family in a grey picture, (rows, columns). Each number occurs once.

    A code that appears twice is ambiguous and is left out. The picture may be a mirror image of the table. It is
    therefore read in both orientations, and the one that shows more codes is used, because some codes are their own
    mirror images. Raises ImportError without OpenCV.
    """
    grey = np.ascontiguousarray(picture, np.uint8)
    detections, reflected = _detect(grey, family), _detect(grey[:, ::-1], family)
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
        if is_mirrored:  # as printed, its second axis would be to the left of the first
            shape = shape._replace(cells=shape.cells[::-1])
        u, v = corners.mean(axis=0).tolist()
        mark = fit_at(np.asarray(grey, float), shape, (u, v), turn)
        if mark is not None:
            marks.append(CodedMark(number, mark, side * mark.size))
    return marks


def _detect(grey: NDArray[np.uint8], family: CodeFamily) -> list[tuple[int, Floats]]:
    """Return numbers and corners, (4, 2) [pixel] from the upper left one clockwise as printed."""
    corners, numbers, _ = _detector(family).detectMarkers(np.ascontiguousarray(grey))
    if numbers is None:
        return []
    return [
        (int(number), np.asarray(each, float).reshape(4, 2))
        for number, each in zip(np.ravel(numbers), corners, strict=True)
    ]


def _mirrored(corners: Floats, columns: int) -> Floats:
    """Convert corners in the mirrored picture to the original picture."""
    return np.column_stack([columns - 1.0 - corners[:, 0], corners[:, 1]])


@functools.cache
def _detector(family: CodeFamily) -> Any:
    cv2 = importlib.import_module("cv2")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # A corrected bit may turn the mirror image of one code into another. A wrong name is worse than a missed code.
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
