"""Calibration of the geometry of computed stages by their own cameras, and corrections before and after it.

A stage differs from its configuration in every leg and in the scale of each encoder, and the lenses distort. The
pictures are large enough for the travel: 9344 × 7000 pixels of 3.75 µm, a sensor of 65 megapixels at 1:1. A correction
moves the part from one pose of the stage to another, both anywhere in the travel. The remaining error is that of the
stage as built.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, cast

import numpy as np
from bench_align import (
    ANGLES,
    ARC,
    FILES,
    NOISE,
    PART,
    PICTURES_PER_PLACE,
    PLACES,
    SEED,
    TOLERANCE,
    ComputedStage,
    Model,
    distance_left,
)
from msgspec import structs
from trirail.alignment.camera_calibration import CameraCalibration, to_base_frame
from trirail.alignment.code_family import CodeFamily
from trirail.alignment.coded_marks import code_shape, find_codes
from trirail.alignment.finding import find
from trirail.alignment.geometry_calibration import (
    GeometryTask,
    calibrate_geometry,
    calibrated_cameras,
    start_model,
)
from trirail.alignment.images import CameraView
from trirail.alignment.procedure import AlignmentTask, align, calibrate_by_moves
from trirail.alignment.rigid_motion import Floats, rotation_matrix
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.alignment.stage_fit import fit_stage
from trirail.client.stage_as_built import built_otherwise
from trirail.config import SIM, geometry, load, room
from trirail.errors import TrirailError
from trirail.kinematics.geometry import Geometry, Room, travels
from trirail.kinematics.robot import inverse

SCALES = 200e-6
"""Maximum relative error of the scale of an encoder."""
FIELD = (9344.0, 7000.0)
CODES: tuple[CodeFamily, ...] = ("4x4_50", "apriltag_36h11")
MARK_SIDE = 300e-6
"""Size of the marks whose errors are compared [m]."""
PLACES_OF_STAGE = 4
"""Number of corrections on each stage."""
MARGIN = 0.95
"""Fraction of the travel within which corrections begin and end."""
AIM = "at least 95 % within 1 µm and 5 arcsec after one correction, never more than three"


def measure(stages: int) -> dict[str, Any]:
    """Return the results of `stages` stages of each kind."""
    return {"aim": AIM} | {kind: _kind(file, stages) for kind, file in FILES.items()}


def marks(count: int) -> dict[str, Any]:
    """Return the position errors of codes and of discs of the same size, as root mean square [pixel].

    Each kind of mark is measured in `count` pictures. The marks are 300 µm (80 pixels) wide, dark, and turned at
    random. The light is uneven, and the noise is 4 of 255 grey levels.
    """
    errors: dict[str, list[Floats]] = {}
    for seed in range(count):
        rng = np.random.default_rng((SEED, 3, seed))
        (a, b), (c, d) = (rotation_matrix(rng.uniform(-np.pi, np.pi)) / 3.75e-6).tolist()
        view = CameraView((0.0, 0.0), (320.0, 240.0), ((a, b), (c, d)))
        pose = (*rng.uniform(-2e-4, 2e-4, 2).tolist(), float(rng.uniform(-0.1, 0.1)))
        shapes = {str(family): code_shape(family, seed % 30, MARK_SIDE) for family in CODES}
        for name, shape in (shapes | {"disc": MarkShape("disc", MARK_SIDE)}).items():
            mark = {"mark": DrawnMark(shape, (0.0, 0.0))}
            camera = SimulatedCamera(view, mark, ground=180.0, contrast=-120.0, noise=4.0, shade=0.2)
            picture = camera.picture(lambda _: pose, 0.0, rng)  # noqa: B023
            if name == "disc":
                disc = find(picture, MarkShape("disc", MARK_SIDE * view.scale))
                places = [] if disc is None else [(disc.u, disc.v)]
            else:
                places = [(code.mark.u, code.mark.v) for code in find_codes(picture, cast(CodeFamily, name))]
            errors.setdefault(name, []).extend(np.subtract(at, camera.pixels_at(pose)["mark"]) for at in places)
    return {name: [float(np.sqrt(np.mean(np.square(each)))), f"{len(each)} found"] for name, each in errors.items()}


def _kind(file: str, stages: int) -> dict[str, Any]:
    results: dict[str, list[tuple[float, float, int]]] = {}
    failures: Counter[str] = Counter()
    looks, noise, held_out = [], [], []
    for seed in range(stages):
        config = load(SIM.with_name(file))
        robot, limits = geometry(config.geometry), room(config.limits)
        rng = np.random.default_rng((SEED, 2, seed))
        configured: Model = lambda pose, robot=robot: inverse(robot, pose).position  # type: ignore[misc]  # noqa: E731
        stage = ComputedStage(built_otherwise(robot, rng, PLACES, ANGLES), configured, rng, FIELD)
        stage.scales = rng.uniform(-SCALES, SCALES, 3)
        small = stage.drive(calibrate_by_moves(looks=PICTURES_PER_PLACE))
        task = GeometryTask(robot, limits, FIELD, looks=PICTURES_PER_PLACE)
        calibration = stage.drive(calibrate_geometry(task))
        looks.append(len(calibration.looks))
        noise.append(calibration.noise)
        held_out.append((calibration.residual.before_m, calibration.residual.after_m))
        model, *_ = start_model(task, calibration.looks[:7])
        wide = calibrated_cameras(
            model, fit_stage(model, calibration.looks, fixed_legs=True), calibration.looks, PICTURES_PER_PLACE
        )
        calibrated: Model = lambda pose, calibration=calibration: (  # type: ignore[misc]  # noqa: E731
            inverse(calibration.geometry, pose).position / (1.0 + np.array(calibration.scales))
        )
        ways = [_way(rng, robot, limits, stage) for _ in range(PLACES_OF_STAGE)]
        cases = {
            "calibrated geometry": (calibrated, calibration.cameras, PICTURES_PER_PLACE),
            "calibrated geometry, one picture of a part": (calibrated, calibration.cameras, 1),
            "configured, cameras over the travel": (configured, wide, PICTURES_PER_PLACE),
            "configured, cameras by 1 mm and 1°": (configured, small, PICTURES_PER_PLACE),
        }
        for name, (moved_by, cameras, pictures) in cases.items():
            stage.model = moved_by
            for begin, end in ways:
                try:
                    results.setdefault(name, []).append(_correct(stage, cameras, begin, end, pictures))
                except TrirailError:
                    failures[name] += 1
    summary: dict[str, Any] = {name: _summary(each, failures[name]) for name, each in results.items()}
    return summary | {
        "looks of a calibration": max(looks),
        "residual of looks, pixel, p50/max": [float(np.median(noise)), float(max(noise))],
        "µm at held-out looks, before/after": (1e6 * np.median(held_out, axis=0)).tolist(),
    }


def _way(rng: np.random.Generator, robot: Geometry, limits: Room, stage: ComputedStage) -> tuple[Floats, Floats]:
    """Return two random poses in the travel at which all marks are in their pictures."""
    low, high = np.array(limits.low), np.array(limits.high)
    poses: list[Floats] = []
    while len(poses) < 2:
        pose = MARGIN * rng.uniform(low, high)
        stage.pose = (float(pose[0]), float(pose[1]), float(pose[2]))
        if limits.holds(travels(robot, pose)) and len(stage.pixels(NOISE)) == len(PART):
            poses.append(pose)
    return poses[0], poses[1]


def _correct(
    stage: ComputedStage, cameras: CameraCalibration, begin: Floats, end: Floats, pictures: int
) -> tuple[float, float, int]:
    """Align a part from one pose to another; return the errors after the first correction, and their number.

    The errors are a distance [m] and an angle [rad]. The number of corrections is 0 if the target was not reached.
    """
    stage.pose = (float(end[0]), float(end[1]), float(end[2]))
    views = [stage.pixels(NOISE) for _ in range(PICTURES_PER_PLACE)]
    targets = {name: tuple(np.mean([view[name] for view in views], axis=0).tolist()) for name in PART}
    aim = np.array([to_base_frame(q, stage.true) for q in PART.values()])
    stage.pose = (float(begin[0]), float(begin[1]), float(begin[2]))
    after: list[tuple[float, float]] = []
    # The calibration counts as confirmed, as after a first part: otherwise a long first correction would be divided.
    task = AlignmentTask(structs.replace(cameras, confirmed=True), targets, looks=pictures)
    result = stage.drive(align(task), lambda: after.append(distance_left(stage, aim)))
    return *after[0], len(result.corrections) if result.reached else 0


def _summary(results: list[tuple[float, float, int]], failures: int) -> dict[str, Any]:
    every = np.array(results).reshape(-1, 3)
    count = len(every) + failures
    within = (every[:, 0] <= TOLERANCE) & (every[:, 1] <= ARC)
    quantiles = (50.0, 95.0, 100.0)
    return {
        "within 1 µm, 5 arcsec after one": float(within.sum()) / count,
        "reached": float((every[:, 2] > 0).sum()) / count,
        "refused": failures / count,
        "corrections": dict(sorted(Counter(str(int(n)) for n in every[:, 2] if n).items())),
        "µm after one, p50/p95/max": (1e6 * np.percentile(every[:, 0], quantiles)).tolist() if len(every) else [],
        "arcsec after one, p50/p95/max": np.degrees(np.percentile(every[:, 1], quantiles) * 3600.0).tolist()
        if len(every)
        else [],
    }
