"""Procedures for the calibration of cameras. They are generators that request looks and motions of a driver.

trirail.alignment.procedure describes the protocol between procedures and drivers.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence

import numpy as np
from msgspec import structs
from trirail_drivers.interface import Triple

from trirail.alignment import arguments
from trirail.alignment.alignment_request import AlignmentRequest, LookReport, Observation, StageMotion
from trirail.alignment.camera_calibration import CalibrationSample, CameraCalibration, calibrate, check_moves
from trirail.alignment.fresh_pictures import observe_mean
from trirail.alignment.images import Lens, Pair
from trirail.errors import AlignmentError, AlignmentFault
from trirail.kinematics.geometry import Geometry, Room, travels

DEFAULT_MOVES: tuple[Triple, ...] = tuple(
    (x * 1e-3, y * 1e-3, math.radians(turn))
    for x, y, turn in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
)
"""Moves of a calibration relative to the start pose: 1 mm along x and y, and 1° of rotation, each in both
directions."""
ZERO_OFFSET: Triple = (0.0, 0.0, 0.0)
PLATFORM_CENTRE: Pair = (0.0, 0.0)


def calibration_moves(lens: Lens, by: float, turn: float) -> tuple[Triple, ...]:
    """Return moves with which a lens can be calibrated: ±by along x and y [m], and ±turn [rad].

    For lenses that are not affine, the moves also include the four corners at (±by, ±by).
    """
    straight = ((by, 0.0), (-by, 0.0), (0.0, by), (0.0, -by))
    corners = () if lens == "affine" else ((by, by), (-by, by), (-by, -by), (by, -by))
    translations = tuple((x, y, 0.0) for x, y in (*straight, *corners))
    return (*translations, (0.0, 0.0, turn), (0.0, 0.0, -turn))


def calibrate_by_moves(
    moves: Sequence[Triple] = DEFAULT_MOVES,
    views: Mapping[str, str] | None = None,
    lens: Lens = "affine",
    centre: Pair | Mapping[str, Pair] | None = None,
    looks: int = 1,
    approach: Triple | None = None,
) -> Generator[AlignmentRequest, Observation, CameraCalibration]:
    """Look at the current pose and at poses around it, return to the start pose, and compute the calibration.

    Each of the `moves` is relative to the start pose. If `approach` is given, every motion, including a first motion to
    the current pose, arrives from this offset. The other parameters are those of camera_calibration.calibrate.

    Raises
    ------
    RefusedError
        An argument is invalid.
    AlignmentError
        The looks do not determine the calibration.
    """
    arguments.check_moves(moves)
    arguments.check_views(views)
    arguments.check_lens(lens, centre)
    arguments.check_count(looks, "looks", 1)
    arguments.check_approach(approach)
    if approach is not None:
        yield StageMotion(ZERO_OFFSET, PLATFORM_CENTRE, approach)
    first = yield from observe_mean(looks)
    observations = [first]
    yield LookReport("calibration", first)
    poses = [_add(first.pose, move) for move in moves]
    try:
        _check_first(first, poses, views, lens, centre)
    except AlignmentError as error:
        yield LookReport("calibration", end=error.fault, words=str(error))
        raise
    for pose in poses:
        yield StageMotion(pose, approach=approach)
        observations.append((yield from observe_mean(looks)))
        yield LookReport("calibration", observations[-1])
    yield StageMotion(first.pose, approach=approach)
    samples = [CalibrationSample(each.pose, each.marks) for each in observations]
    try:
        calibration = structs.replace(calibrate(samples, views, lens, centre, looks), approach=plain_approach(approach))
    except AlignmentError as error:
        yield LookReport("calibration", end=error.fault, words=str(error))
        raise
    yield LookReport("calibration", end="calibrated", noise=calibration.noise)
    return calibration


def _check_first(
    first: Observation,
    poses: Sequence[Triple],
    views: Mapping[str, str] | None,
    lens: Lens,
    centre: Pair | Mapping[str, Pair] | None,
) -> None:
    """Check before any move that the first look shows marks, and that the moves determine the maps of their views.

    Raises AlignmentError.
    """
    if not first.marks:
        raise AlignmentError(
            AlignmentFault.MISSING, "no mark was found in the first look; check light, focus and threshold"
        )
    if views is not None and (unknown := sorted(set(first.marks) - set(views))):
        text = f"marks without a view: {', '.join(unknown)}; give each mark a view; views has {', '.join(views)}"
        raise AlignmentError(AlignmentFault.MISSING, text)
    check_moves([first.pose, *poses], sorted(first.marks), views, lens, centre)


def repeat_calibration(
    saved: CameraCalibration, looks: int = 1, poses: Sequence[Triple] | None = None
) -> Generator[AlignmentRequest, Observation, CameraCalibration]:
    """Repeat a saved calibration: calibrate the same views at the same poses, and move back to the current pose.

    The poses may span nearly the whole travel, so they are not shifted to the current pose. If some of them are outside
    the limits, `poses` are the others. Each motion arrives from the same side as in the saved calibration.
    """
    poses = saved.poses if poses is None else poses
    start = (yield StageMotion(ZERO_OFFSET, PLATFORM_CENTRE)).pose
    x, y, phi = poses[0]
    yield StageMotion((x, y, phi))
    moves = [(each[0] - x, each[1] - y, each[2] - phi) for each in poses[1:]]
    views = {name: mark.view for name, mark in saved.marks.items()}
    lens = next(iter(saved.views.values())).lens
    # Each view has its own centre if the geometry of the stage was calibrated with it.
    centres = {name: view.centre for name, view in saved.views.items()}
    calibration = yield from calibrate_by_moves(moves, views, lens, centres, looks, saved.approach)
    yield StageMotion(start)
    return calibration


def poses_within(room: Room, geometry: Geometry, saved: CameraCalibration) -> list[Triple]:
    """Return the poses of a saved calibration that are within the limits, also on the way of its approach.

    A calibration of the geometry corrects the poses at which it looked. After a homing error of 1 mm, some of them are
    outside the limits of the platform. Raises AlignmentError if no pose is within the limits.
    """
    beyond = np.add(saved.poses, saved.approach or ZERO_OFFSET)
    within = np.ones(len(saved.poses), bool)
    for poses in (np.array(saved.poses), beyond):
        within &= ((poses >= room.low) & (poses <= room.high)).all(axis=1) & room.holds(travels(geometry, poses))
    if not within.any():
        raise AlignmentError(
            AlignmentFault.MOVES, "all poses of the calibration are outside the limits of the stage; calibrate again"
        )
    return [pose for pose, is_within in zip(saved.poses, within.tolist(), strict=True) if is_within]


def plain_approach(approach: Triple | None) -> Triple | None:
    """Return an approach with Python floats, which can be written to a file, whatever its numbers are."""
    if approach is None:
        return None
    x, y, phi = map(float, approach)
    return x, y, phi


def _add(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
