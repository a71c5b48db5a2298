"""Alignment and calibration procedures: generators that request looks and motions, and return a result.

A procedure yields LOOK or a StageMotion and receives an Observation. Its driver has the camera, the robot and the time;
the procedure itself moves nothing. It also yields a LookReport after each look, whose answer it ignores.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from trirail_drivers.interface import Triple

from trirail.alignment import arguments, fresh_pictures
from trirail.alignment.alignment_request import LOOK, AlignmentRequest, LookReport, Observation, StageMotion
from trirail.alignment.calibration_procedure import (
    DEFAULT_MOVES,
    PLATFORM_CENTRE,
    ZERO_OFFSET,
    calibrate_by_moves,
    calibration_moves,
    repeat_calibration,
)
from trirail.alignment.camera_calibration import CameraCalibration
from trirail.alignment.fresh_pictures import observe_mean
from trirail.alignment.images import Pair
from trirail.alignment.misalignment import (
    DEFAULT_DISTANCE_ERROR,
    Misalignment,
    check_targets_known,
    measure_misalignment,
)
from trirail.alignment.results import Alignment, AlignmentCorrection, AlignmentEnd, Measurement
from trirail.alignment.rigid_motion import rotation_matrix
from trirail.errors import AlignmentError, AlignmentFault, RefusalCode, RefusedError

__all__ = [
    "DEFAULT_MOVES",
    "LOOK",
    "Alignment",
    "AlignmentCorrection",
    "AlignmentEnd",
    "AlignmentRequest",
    "AlignmentTask",
    "Measurement",
    "Observation",
    "StageMotion",
    "align",
    "calibrate_and_align",
    "calibrate_by_moves",
    "calibration_moves",
    "measure_part",
    "observe_mean",
    "repeat_calibration",
]

DEFAULT_TOLERANCE_M, DEFAULT_ANGLE_RAD = 1e-6, math.radians(5.0 / 3600.0)
"""Tolerances of a mark's position and of the part's angle: 1 µm, 5 arcsec."""
DEFAULT_CORRECTIONS = 3
MAX_UNCONFIRMED_TRAVEL = 2.0
"""Greatest travel of a mark in the first correction with an unconfirmed calibration, as a multiple of its travel in the
calibration's moves."""
NOISE_LIMIT_DEVIATIONS = 2.0
"""Number of standard deviations of a look within which an error is not corrected, if the noise exceeds the
tolerance."""
CONFIRMATION_SHARE = 0.2
"""Greatest miss of the predicted remaining error, as a share of the correction, with which it confirms the
calibration."""


class AlignmentTask(NamedTuple):
    """Arguments of an alignment."""

    calibration: CameraCalibration
    targets: Mapping[str, Pair]
    """Targets of the marks [pixel]."""
    tolerance: float = DEFAULT_TOLERANCE_M
    angle: float = DEFAULT_ANGLE_RAD
    corrections: int = DEFAULT_CORRECTIONS
    distance: float = DEFAULT_DISTANCE_ERROR
    looks: int = 1
    """Pictures per measurement."""
    approach: Triple | None = None

    @property
    def noise_share(self) -> float:
        """Noise of a measurement, as a share of the noise of a look of the calibration."""
        return math.sqrt(self.calibration.looks / self.looks)

    def check(self) -> None:
        """Raise RefusedError, with the value and the allowed range, for the first invalid argument."""
        calibration: object = self.calibration
        if not isinstance(calibration, CameraCalibration):
            text = f"calibration is {calibration!r:.100}: expected the CameraCalibration that calibrate_camera returns"
            raise RefusedError(RefusalCode.MALFORMED, text)
        arguments.check_targets(self.targets)
        check_targets_known(calibration, self.targets)
        arguments.check_above_zero(self.tolerance, "tolerance")
        arguments.check_above_zero(self.angle, "angle")
        arguments.check_above_zero(self.distance, "distance")
        arguments.check_count(self.corrections, "corrections", 0)
        arguments.check_count(self.looks, "looks", 1)
        arguments.check_approach(self.approach)


AlignmentProcedure = Generator[AlignmentRequest, Observation, Alignment]


def align(task: AlignmentTask) -> AlignmentProcedure:
    """Measure and correct until the part is within tolerance, no correction is left, or the error grows.

    A look after a correction counts only if the correction explains it. With an approach, the platform first reaches
    its current pose from that side.

    Raises
    ------
    RefusedError
        An argument is invalid.
    AlignmentError
        The looks do not determine the part's pose. Such a look causes no motion.
    """
    task.check()
    measurements: list[Measurement] = []
    corrections: list[AlignmentCorrection] = []
    confirmed = task.calibration.confirmed
    if task.approach is not None:
        yield StageMotion(ZERO_OFFSET, PLATFORM_CENTRE, task.approach)
    look, misalignment = yield from _measure_first(task)
    explained = True
    while True:
        measurements.append(measurement := _measurement(look, misalignment))
        if len(measurements) > 1:
            confirmed = confirmed or (explained and _is_as_predicted(task, measurements, corrections[-1].share))
        end = _end_reason(task, measurements, misalignment.deviations(task.noise_share))
        if end is not None:
            # Pictures that no motion explains may be stale, so they must not report success.
            if end is AlignmentEnd.REACHED and not explained:
                raise (yield from _report_stale(look))
            yield LookReport("alignment", look, measurement, end=end)
            seconds = measurements[-1].time - measurements[0].time
            confirmed = confirmed and end is not AlignmentEnd.GROWING
            return Alignment(end, tuple(measurements), tuple(corrections), seconds, confirmed)
        # A wrong sign or scale shows in the next look, so an unconfirmed calibration may only move about as far as it
        # has moved the stage itself.
        max_travel = MAX_UNCONFIRMED_TRAVEL * task.calibration.reach
        share = 1.0 if confirmed else min(1.0, max_travel / max(misalignment.worst, 1e-12))
        motion = _correction_motion(misalignment, look.pose, share, task.approach)
        yield LookReport("alignment", look, measurement, motion.by)
        arrived = yield motion
        corrections.append(AlignmentCorrection(motion.by, share, arrived.time - look.time))
        look, misalignment, explained = yield from _measure_again(task, look, misalignment)


def calibrate_and_align(
    task: Callable[[CameraCalibration], AlignmentTask], looks: int, approach: Triple | None
) -> AlignmentProcedure:
    """Calibrate by DEFAULT_MOVES, then align with that calibration."""
    calibration = yield from calibrate_by_moves(looks=looks, approach=approach)
    return (yield from align(task(calibration)))


def measure_part(task: AlignmentTask) -> Generator[AlignmentRequest, Observation, Measurement]:
    """Measure the part once, without a motion."""
    task.check()
    look = yield from observe_mean(task.looks)
    misalignment = yield from _measure_misalignment(task, look, "check")
    measurement = _measurement(look, misalignment)
    yield LookReport("check", look, measurement, end="checked")
    return measurement


def _measure_first(task: AlignmentTask) -> Generator[AlignmentRequest, Observation, tuple[Observation, Misalignment]]:
    """Return the first look and its misalignment. No motion can show that the first look is new.

    A look that shows an aligned part is compared with further pictures, because a late camera still shows an earlier
    state.
    """
    pictures = yield from fresh_pictures.capture(task.looks)
    for _ in range(fresh_pictures.MAX_STALE_PICTURES):
        look = fresh_pictures.average(pictures)
        newest, tolerance = pictures[-1], 0.5 * task.tolerance
        if all(fresh_pictures.is_consistent(task.calibration, newest, each, 1, tolerance) for each in pictures):
            misalignment = yield from _measure_misalignment(task, look, "alignment")
            # A stale look that shows an error is found out by the correction; one that shows none would end it.
            if not _is_within(task, misalignment):
                return look, misalignment
            tolerance = _miss_tolerance(task, misalignment)
            pictures = yield from fresh_pictures.capture(max(fresh_pictures.MAX_STALE_PICTURES - 1, task.looks))
            if all(
                fresh_pictures.is_consistent(task.calibration, look, each, task.looks, tolerance) for each in pictures
            ):
                return look, misalignment
            pictures = pictures[-task.looks :]
        else:
            pictures = yield from fresh_pictures.capture(task.looks)
    raise (yield from _report_stale(look))


def _measure_again(
    task: AlignmentTask, before: Observation, previous: Misalignment
) -> Generator[AlignmentRequest, Observation, tuple[Observation, Misalignment, bool]]:
    """Return the look after a correction, its misalignment, and True if the correction explains the look.

    Raises AlignmentError if the pictures show the marks unmoved.
    """
    tolerance = _miss_tolerance(task, previous)
    fit = yield from fresh_pictures.capture_after_motion(task.calibration, before, task.looks, tolerance)
    look = fresh_pictures.average(fit.pictures)
    misalignment = yield from _measure_misalignment(task, look, "alignment")
    deviation, _ = misalignment.deviations(task.noise_share)
    if fit.still and not _has_grown(task, previous.worst, misalignment.worst, deviation):
        raise (yield from _report_stale(look))
    return look, misalignment, fit.explained


def _report_stale(look: Observation) -> Generator[AlignmentRequest, Observation, AlignmentError]:
    """Report that the pictures do not show the robot's current pose. Return the error to raise."""
    words = (
        f"{fresh_pictures.MAX_STALE_PICTURES} pictures do not show the marks where the motion put them; take a new "
        "picture at each look (a camera's buffer holds old ones), or remove backlash with an approach"
    )
    yield LookReport("alignment", look, end=AlignmentFault.STILL, words=words)
    return AlignmentError(AlignmentFault.STILL, words)


def _measure_misalignment(
    task: AlignmentTask, look: Observation, purpose: Literal["alignment", "check"]
) -> Generator[AlignmentRequest, Observation, Misalignment]:
    """Return the misalignment shown by a look; report an error before it is raised."""
    try:
        return measure_misalignment(task.calibration, look.marks, task.targets, task.distance)
    except AlignmentError as error:
        yield LookReport(purpose, look, end=error.fault, words=str(error))
        raise


def _miss_tolerance(task: AlignmentTask, misalignment: Misalignment) -> float:
    """Return the miss of a mark's predicted position that is always accepted [m]: half of the tolerance."""
    return 0.5 * min(task.tolerance, task.angle * misalignment.arm)


def _is_within(task: AlignmentTask, misalignment: Misalignment) -> bool:
    return misalignment.worst <= task.tolerance and abs(misalignment.motion.turn) <= task.angle


def _has_grown(task: AlignmentTask, before: float, now: float, deviation: float) -> bool:
    """Return True if an error has grown by more than the tolerance and the noise of both looks."""
    return now > before + task.tolerance + fresh_pictures.NOISE_DEVIATIONS * math.sqrt(2.0) * deviation


def _measurement(look: Observation, misalignment: Misalignment) -> Measurement:
    motion = misalignment.motion
    displacements = (misalignment.targets - misalignment.positions).tolist()
    return Measurement(
        marks=dict(look.marks),
        errors={name: _pair(each) for name, each in zip(misalignment.names, displacements, strict=True)},
        worst=misalignment.worst,
        shift=_pair(motion.shift.tolist()),
        turn=motion.turn,
        misfit=float(np.linalg.norm(motion.misfit, axis=1).max()),
        distance=misalignment.distance,
        pose=look.pose,
        time=look.time,
    )


def _end_reason(
    task: AlignmentTask, measurements: Sequence[Measurement], deviations: tuple[float, float]
) -> AlignmentEnd | None:
    """Return the reason to end, None to continue; `deviations` are those of the last `worst` [m] and `turn` [rad]."""
    now, (place, turn) = measurements[-1], deviations
    is_precise = place <= task.tolerance and turn <= task.angle
    if is_precise and now.worst <= task.tolerance and abs(now.turn) <= task.angle:
        return AlignmentEnd.REACHED
    if len(measurements) > 1 and _has_grown(task, measurements[-2].worst, now.worst, place):
        return AlignmentEnd.GROWING
    # Within its own noise a further correction is as likely to make the error larger as smaller.
    is_near = (
        now.worst <= task.tolerance + NOISE_LIMIT_DEVIATIONS * place
        and abs(now.turn) <= task.angle + NOISE_LIMIT_DEVIATIONS * turn
    )
    if is_near and not is_precise:
        return AlignmentEnd.NOISE
    return AlignmentEnd.CORRECTIONS if len(measurements) > task.corrections else None


def _is_as_predicted(task: AlignmentTask, measurements: Sequence[Measurement], share: float) -> bool:
    """Return True if the last correction, of a share of the error, has left the predicted error."""
    before, now = (each.worst for each in measurements[-2:])
    return abs(now - (1.0 - share) * before) <= max(task.tolerance, CONFIRMATION_SHARE * share * before)


def _correction_motion(misalignment: Misalignment, pose: Triple, share: float, approach: Triple | None) -> StageMotion:
    """Return the correction about the marks' centroid."""
    motion = misalignment.motion
    x, y = (share * motion.shift).tolist()
    tool = rotation_matrix(-pose[2]) @ (motion.centroid - pose[:2])
    return StageMotion((x, y, share * motion.turn), _pair(tool.tolist()), approach)


def _pair(values: Sequence[float]) -> Pair:
    return float(values[0]), float(values[1])
