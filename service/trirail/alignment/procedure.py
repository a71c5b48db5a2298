"""Alignment and calibration procedures: generators that request looks and motions, and return a result.

A procedure yields LOOK or a StageMotion, and its driver sends an Observation. The driver has access to the camera, the
robot and the clock; the procedure itself has no side effects. After each look, the procedure also yields a LookReport,
and ignores the answer of the driver.
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
    poses_within,
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
    "poses_within",
    "repeat_calibration",
]

DEFAULT_TOLERANCE_M, DEFAULT_ANGLE_RAD = 1e-6, math.radians(5.0 / 3600.0)
"""Default tolerances of the positions of marks and of the angle of the part: 1 µm and 5 arcsec."""
DEFAULT_CORRECTIONS = 3
MAX_UNCONFIRMED_TRAVEL = 2.0
"""Greatest travel of a mark in a correction with an unconfirmed calibration, as a multiple of
CameraCalibration.reach."""
NOISE_LIMIT_DEVIATIONS = 2.0
"""If the noise of a look exceeds the tolerance, errors that exceed the tolerance by less than this number of standard
deviations are not corrected."""
CONFIRMATION_SHARE = 0.2
"""Greatest difference between the remaining error and its prediction, as a fraction of the correction, with which the
correction confirms the calibration."""


class AlignmentTask(NamedTuple):
    """Arguments of an alignment."""

    calibration: CameraCalibration
    targets: Mapping[str, Pair]
    """Target pixels of the marks."""
    tolerance: float = DEFAULT_TOLERANCE_M
    """Greatest distance of a mark from its target [m]."""
    angle: float = DEFAULT_ANGLE_RAD
    """Greatest error of the angle of the part [rad]."""
    corrections: int = DEFAULT_CORRECTIONS
    """Greatest number of corrections."""
    distance: float = DEFAULT_DISTANCE_ERROR
    """Greatest relative error of the distance between two marks."""
    looks: int = 1
    """Number of pictures per measurement."""
    approach: Triple | None = None
    """Offset from which every motion arrives, as in StageMotion."""

    @property
    def noise_share(self) -> float:
        """Ratio of a measurement's noise to the noise of a look during the calibration."""
        return math.sqrt(self.calibration.looks / self.looks)

    def check(self) -> None:
        """Raise RefusedError for the first invalid argument, with the value and the permitted range."""
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
    """Measure and correct the misalignment of a part until one of the reasons in AlignmentEnd applies.

    After a correction, success is reported only if the new look agrees with the motion, and further pictures agree with
    the new look. If an approach is given, the platform first moves to its current pose from this offset.

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
        end = _end_reason(task, measurements, misalignment)
        if end is not None:
            # Pictures that do not agree with the motion may be stale. They must not lead to a report of success.
            if end is AlignmentEnd.REACHED and not explained:
                raise (yield from _report_stale(look))
            yield LookReport("alignment", look, measurement, end=end)
            seconds = measurements[-1].time - measurements[0].time
            confirmed = confirmed and end is not AlignmentEnd.GROWING
            return Alignment(end, tuple(measurements), tuple(corrections), seconds, confirmed)
        # A wrong sign or scale of the calibration is only detected in the next look. With an unconfirmed calibration,
        # the correction is therefore limited to about the distance that was travelled during the calibration.
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
    """Calibrate the cameras by DEFAULT_MOVES, and then align the part with this calibration."""
    calibration = yield from calibrate_by_moves(looks=looks, approach=approach)
    return (yield from align(task(calibration)))


def measure_part(task: AlignmentTask) -> Generator[AlignmentRequest, Observation, Measurement]:
    """Measure the misalignment of the part once, without a motion."""
    task.check()
    look = yield from observe_mean(task.looks)
    misalignment = yield from _measure_misalignment(task, look, "check")
    measurement = _measurement(look, misalignment)
    yield LookReport("check", look, measurement, end="checked")
    return measurement


def _measure_first(task: AlignmentTask) -> Generator[AlignmentRequest, Observation, tuple[Observation, Misalignment]]:
    """Return the first look and the misalignment that it shows.

    Before the first look, there is no motion that could reveal a stale picture. The pictures of the look must therefore
    agree with each other.
    """
    for _ in range(fresh_pictures.MAX_STALE_PICTURES):
        pictures = yield from fresh_pictures.capture(task.looks)
        look = fresh_pictures.average(pictures)
        newest, tolerance = pictures[-1], 0.5 * task.tolerance
        if all(fresh_pictures.is_consistent(task.calibration, newest, each, 1, tolerance) for each in pictures):
            misalignment = yield from _measure_misalignment(task, look, "alignment")
            return (yield from _confirm(task, look, misalignment))
    raise (yield from _report_stale(look))


def _confirm(
    task: AlignmentTask, look: Observation, misalignment: Misalignment
) -> Generator[AlignmentRequest, Observation, tuple[Observation, Misalignment]]:
    """Return the look, or a newer look if the look shows an aligned part and further pictures contradict it.

    If a stale look shows an error, the next correction reveals it. If it shows no error, only further pictures reveal
    it: the last of them show the current pose, also if the camera is late by MAX_STALE_PICTURES - 1 pictures.
    """
    for _ in range(fresh_pictures.MAX_STALE_PICTURES):
        if not _is_within(task, misalignment):
            return look, misalignment
        tolerance = _miss_tolerance(task, misalignment)
        pictures = yield from fresh_pictures.capture(max(fresh_pictures.MAX_STALE_PICTURES - 1, task.looks))
        newest = fresh_pictures.average(pictures[-task.looks :])
        shown = yield from _measure_misalignment(task, newest, "alignment")
        if _is_near(task, shown) and all(
            fresh_pictures.is_consistent(task.calibration, look, each, task.looks, tolerance) for each in pictures
        ):
            return look, misalignment
        look, misalignment = newest, shown
    raise (yield from _report_stale(look))


def _measure_again(
    task: AlignmentTask, before: Observation, previous: Misalignment
) -> Generator[AlignmentRequest, Observation, tuple[Observation, Misalignment, bool]]:
    """Return the look after a correction, its misalignment, and True if the look agrees with the correction.

    Raises AlignmentError if the pictures show the marks unmoved.
    """
    tolerance = _miss_tolerance(task, previous)
    fit = yield from fresh_pictures.capture_after_motion(task.calibration, before, task.looks, tolerance)
    look = fresh_pictures.average(fit.pictures)
    misalignment = yield from _measure_misalignment(task, look, "alignment")
    deviation, _ = misalignment.deviations(task.noise_share)
    if fit.still and not _has_grown(task, previous.worst, misalignment.worst, deviation):
        raise (yield from _report_stale(look))
    if fit.explained:
        look, misalignment = yield from _confirm(task, look, misalignment)
    return look, misalignment, fit.explained


def _report_stale(look: Observation) -> Generator[AlignmentRequest, Observation, AlignmentError]:
    """Report that the pictures do not show the current pose of the robot. Return the error, which the caller raises."""
    words = (
        f"{fresh_pictures.MAX_STALE_PICTURES} pictures do not show the marks where the motion put them; take a new "
        "picture at each look (a camera's buffer holds old ones), or remove backlash with an approach"
    )
    yield LookReport("alignment", look, end=AlignmentFault.STILL, words=words)
    return AlignmentError(AlignmentFault.STILL, words)


def _measure_misalignment(
    task: AlignmentTask, look: Observation, purpose: Literal["alignment", "check"]
) -> Generator[AlignmentRequest, Observation, Misalignment]:
    """Return the misalignment that a look shows. If this fails, yield a report before raising the error."""
    try:
        return measure_misalignment(task.calibration, look.marks, task.targets, task.distance)
    except AlignmentError as error:
        yield LookReport(purpose, look, end=error.fault, words=str(error))
        raise


def _miss_tolerance(task: AlignmentTask, misalignment: Misalignment) -> float:
    """Return the distance of a mark from its predicted position that is always accepted [m]: half of the tolerance."""
    return 0.5 * min(task.tolerance, task.angle * misalignment.arm)


def _is_within(task: AlignmentTask, misalignment: Misalignment) -> bool:
    return misalignment.worst <= task.tolerance and abs(misalignment.motion.turn) <= task.angle


def _is_near(task: AlignmentTask, misalignment: Misalignment) -> bool:
    """Return True if an error exceeds the tolerance by no more than the noise of a look."""
    place, turn = misalignment.deviations(task.noise_share)
    return (
        misalignment.worst <= task.tolerance + NOISE_LIMIT_DEVIATIONS * place
        and abs(misalignment.motion.turn) <= task.angle + NOISE_LIMIT_DEVIATIONS * turn
    )


def _has_grown(task: AlignmentTask, before: float, now: float, deviation: float) -> bool:
    """Return True if an error has grown by more than the sum of the tolerance and the noise of both looks."""
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
    task: AlignmentTask, measurements: Sequence[Measurement], misalignment: Misalignment
) -> AlignmentEnd | None:
    """Return the reason why the alignment ends after the last measurement, of `misalignment`; None if it continues."""
    now, (place, turn) = measurements[-1], misalignment.deviations(task.noise_share)
    is_precise = place <= task.tolerance and turn <= task.angle
    if is_precise and _is_within(task, misalignment):
        return AlignmentEnd.REACHED
    if len(measurements) > 1 and _has_grown(task, measurements[-2].worst, now.worst, place):
        return AlignmentEnd.GROWING
    # If the error is within the noise, a further correction is as likely to increase the error as to reduce it.
    if _is_near(task, misalignment) and not is_precise:
        return AlignmentEnd.NOISE
    return AlignmentEnd.CORRECTIONS if len(measurements) > task.corrections else None


def _is_as_predicted(task: AlignmentTask, measurements: Sequence[Measurement], share: float) -> bool:
    """Return True if the error after the last correction is as predicted. `share` is the corrected fraction."""
    before, now = (each.worst for each in measurements[-2:])
    return abs(now - (1.0 - share) * before) <= max(task.tolerance, CONFIRMATION_SHARE * share * before)


def _correction_motion(misalignment: Misalignment, pose: Triple, share: float, approach: Triple | None) -> StageMotion:
    """Return the motion that corrects a fraction `share` of the misalignment, with the marks' centroid as its tool."""
    motion = misalignment.motion
    x, y = (share * motion.shift).tolist()
    tool = rotation_matrix(-pose[2]) @ (motion.centroid - pose[:2])
    return StageMotion((x, y, share * motion.turn), _pair(tool.tolist()), approach)


def _pair(values: Sequence[float]) -> Pair:
    return float(values[0]), float(values[1])
