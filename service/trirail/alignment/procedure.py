"""Alignment and calibration as conversations: each asks for looks and motions, and ends with a result.

A generator yields what it wants, LOOK or a StageMotion, and is sent a Sighting; whoever drives it has the camera, the
robot and the time. It moves nothing itself. It also yields a LookReport of each look, for which it wants nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import CameraCalibration, Sight, calibrate
from trirail.alignment.images import Lens, Pair
from trirail.alignment.misplacement import DISTANCE, Misplacement, misplacement
from trirail.alignment.results import Alignment, AlignmentCorrection, AlignmentEnd, Measurement
from trirail.alignment.rigid import turned
from trirail.alignment.wishes import LOOK, LookReport, Sighting, StageMotion, Wish
from trirail.errors import AlignmentError, AlignmentFault

__all__ = [
    "LOOK",
    "MOVES",
    "Alignment",
    "AlignmentCorrection",
    "AlignmentEnd",
    "Measurement",
    "Sighting",
    "StageMotion",
    "Task",
    "Wish",
    "align",
    "calibrated_first",
    "calibration_again",
    "calibration_by_moves",
    "look_only",
    "mean_look",
    "moves_for",
]

MOVES: tuple[Triple, ...] = tuple(
    (x * 1e-3, y * 1e-3, math.radians(turn))
    for x, y, turn in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
)
"""The moves of a calibration where none are given: 1 mm and 1°, each both ways, from where it begins."""
NO_WAY: Triple = (0.0, 0.0, 0.0)
CENTRE: Pair = (0.0, 0.0)
"""Of the platform, in its own frame."""
TOLERANCE, ANGLE = 1e-6, math.radians(5.0 / 3600.0)
"""How far a mark may be from where it should be [m], and by what angle a part may be turned [rad]: 1 µm, 5 arcsec."""
CORRECTIONS = 3
BEYOND = 2.0
"""The first correction with a calibration that is not confirmed moves no mark farther than so many times as its moves
did."""
CONFIRMS = 0.2
"""A correction confirms the calibration where it misses what it was to leave by no more than this share of its way."""


class Task(NamedTuple):
    """What is asked of an alignment."""

    calibration: CameraCalibration
    targets: Mapping[str, Pair]
    """Where marks should be in the pictures [pixel]."""
    tolerance: float = TOLERANCE
    angle: float = ANGLE
    corrections: int = CORRECTIONS
    distance: float = DISTANCE
    looks: int = 1
    """Pictures a measurement."""
    approach: Triple | None = None


Conversation = Generator[Wish, Sighting, Alignment]


def moves_for(lens: Lens, by: float, turn: float) -> tuple[Triple, ...]:
    """Return the moves that tell a lens: ±by along x and y [m], ±turn [rad], for a bent one into the corners too."""
    straight = ((by, 0.0), (-by, 0.0), (0.0, by), (0.0, -by))
    corners = () if lens == "affine" else ((by, by), (-by, by), (-by, -by), (by, -by))
    ways = tuple((x, y, 0.0) for x, y in (*straight, *corners))
    return (*ways, (0.0, 0.0, turn), (0.0, 0.0, -turn))


def align(task: Task) -> Conversation:
    """Measure, correct, measure again, until the part lies right, or no correction is left, or the error grows.

    With an approach the table comes from that side before the first look too. Raises AlignmentError where a look does
    not tell how the part lies, before anything is moved because of it.
    """
    measurements: list[Measurement] = []
    corrections: list[AlignmentCorrection] = []
    confirmed = task.calibration.confirmed
    if task.approach is not None:
        yield StageMotion(NO_WAY, CENTRE, task.approach)
    while True:
        sight, found = yield from _measure(task, "alignment")
        measurements.append(measured := _measurement(sight, found))
        if len(measurements) > 1:
            confirmed = confirmed or _as_meant(task, measurements, corrections[-1].share)
        if (why := _ended(task, measurements)) is not None:
            yield LookReport("alignment", sight, measured, end=why)
            seconds = measurements[-1].time - measurements[0].time
            confirmed = confirmed and why is not AlignmentEnd.GROWING
            return Alignment(why, tuple(measurements), tuple(corrections), seconds, confirmed)
        share = 1.0 if confirmed else min(1.0, BEYOND * task.calibration.reach / max(found.worst, 1e-12))
        motion = _motion(found, sight.pose, share, task.approach)
        yield LookReport("alignment", sight, measured, motion.by)
        arrived = yield motion
        corrections.append(AlignmentCorrection(motion.by, share, arrived.time - sight.time))


def calibrated_first(task: Callable[[CameraCalibration], Task], looks: int, approach: Triple | None) -> Conversation:
    """Do the same with a calibration that is made first, by MOVES."""
    calibration = yield from calibration_by_moves(looks=looks, approach=approach)
    return (yield from align(task(calibration)))


def look_only(task: Task) -> Generator[Wish, Sighting, Measurement]:
    """Measure and move nothing."""
    sight, found = yield from _measure(task, "check")
    measured = _measurement(sight, found)
    yield LookReport("check", sight, measured, end="checked")
    return measured


def calibration_by_moves(
    moves: Sequence[Triple] = MOVES,
    views: Mapping[str, str] | None = None,
    lens: Lens = "affine",
    centre: Pair = (0.0, 0.0),
    looks: int = 1,
    approach: Triple | None = None,
) -> Generator[Wish, Sighting, CameraCalibration]:
    """Look where the robot stands and after each move from there, return there, and calibrate.

    With an `approach` it comes to where it stands from that side before. Raises AlignmentError where the looks do not
    tell it.
    """
    if approach is not None:
        yield StageMotion(NO_WAY, CENTRE, approach)
    first = yield from mean_look(looks)
    sights = [first]
    yield LookReport("calibration", first)
    for move in moves:
        yield StageMotion(_sum(first.pose, move), approach=approach)
        sights.append((yield from mean_look(looks)))
        yield LookReport("calibration", sights[-1])
    yield StageMotion(first.pose, approach=approach)
    try:
        found = calibrate([Sight(each.pose, each.marks) for each in sights], views, lens, centre)
    except AlignmentError as error:
        yield LookReport("calibration", end=error.fault, words=str(error))
        raise
    yield LookReport("calibration", end="calibrated", noise=found.noise)
    return found


def calibration_again(kept: CameraCalibration, looks: int = 1) -> Generator[Wish, Sighting, CameraCalibration]:
    """Calibrate the same views by the same moves, from where the robot stands."""
    x, y, phi = kept.poses[0]
    moves = [(each[0] - x, each[1] - y, each[2] - phi) for each in kept.poses[1:]]
    views = {name: mark.view for name, mark in kept.marks.items()}
    view = next(iter(kept.views.values()))
    return (yield from calibration_by_moves(moves, views, view.lens, view.centre, looks))


def mean_look(pictures: int) -> Generator[Wish, Sighting, Sighting]:
    """Return the mean of several pictures, for each mark over those that show it."""
    taken = []
    for _ in range(pictures):
        taken.append((yield LOOK))  # noqa: PERF401 - a comprehension cannot yield
    seen: dict[str, list[Pair]] = {}
    for each in taken:
        for name, pixel in each.marks.items():
            seen.setdefault(name, []).append((float(pixel[0]), float(pixel[1])))
    for name, pixels in seen.items():
        if not np.isfinite(pixels).all():
            raise AlignmentError(AlignmentFault.MISSING, f"mark {name} is at {pixels}: finite pixels are wanted")
    marks = {
        name: (math.fsum(u for u, _ in p) / len(p), math.fsum(v for _, v in p) / len(p)) for name, p in seen.items()
    }
    x, y, phi = np.mean([each.pose for each in taken], axis=0).tolist()
    return Sighting(marks, (x, y, phi), taken[-1].time)


def _measure(
    task: Task, purpose: Literal["alignment", "check"]
) -> Generator[Wish, Sighting, tuple[Sighting, Misplacement]]:
    sight = yield from mean_look(task.looks)
    try:
        return sight, misplacement(task.calibration, sight.marks, task.targets, task.distance)
    except AlignmentError as error:
        yield LookReport(purpose, sight, end=error.fault, words=str(error))
        raise


def _measurement(sight: Sighting, found: Misplacement) -> Measurement:
    error = found.error
    errors = {name: _pair(e) for name, e in zip(found.names, (found.to - found.at).tolist(), strict=True)}
    misfit = float(np.linalg.norm(error.misfit, axis=1).max())
    shift = _pair(error.shift.tolist())
    return Measurement(
        dict(sight.marks), errors, found.worst, shift, error.turn, misfit, found.distance, sight.pose, sight.time
    )


def _ended(task: Task, measurements: Sequence[Measurement]) -> AlignmentEnd | None:
    now = measurements[-1]
    if now.worst <= task.tolerance and abs(now.turn) <= task.angle:
        return AlignmentEnd.REACHED
    if len(measurements) > 1 and now.worst > measurements[-2].worst + task.tolerance:
        return AlignmentEnd.GROWING
    return AlignmentEnd.CORRECTIONS if len(measurements) > task.corrections else None


def _as_meant(task: Task, measurements: Sequence[Measurement], share: float) -> bool:
    """Whether the newest correction, of a share of the error, has left what it was to leave."""
    before, now = (each.worst for each in measurements[-2:])
    return abs(now - (1.0 - share) * before) <= max(task.tolerance, CONFIRMS * share * before)


def _motion(found: Misplacement, pose: Triple, share: float, approach: Triple | None) -> StageMotion:
    """Return the correction about the marks' middle."""
    error = found.error
    x, y = (share * error.shift).tolist()
    tool = turned(-pose[2]) @ (error.middle - pose[:2])
    return StageMotion((x, y, share * error.turn), _pair(tool.tolist()), approach)


def _sum(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _pair(values: Sequence[float]) -> Pair:
    return float(values[0]), float(values[1])
