"""Alignment of random parts on stages of both kinds: corrections, residuals, and the duration of one correction.

The stage is computed, without timing. The commander's model converts a commanded pose into slider positions, the
sliders move to whole counts, and the kinematics of the stage as built determine where the table then is. The residuals
thus contain only errors of the kinematics, the calibration and the cameras, not those of drives. The durations are
measured with a running service on simulated drives with lag.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, Pair, project_points
from trirail.alignment.procedure import (
    LOOK,
    AlignmentRequest,
    AlignmentTask,
    Observation,
    StageMotion,
    align,
    calibrate_by_moves,
)
from trirail.alignment.rigid_motion import Floats, fit_rigid_motion, rotation_matrix
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.client.stage_as_built import built_otherwise
from trirail.config import SIM, geometry, load
from trirail.kinematics.geometry import CrossLeg, Geometry, Leg, other_kind
from trirail.kinematics.robot import forward, inverse
from trirail_drivers.interface import Triple

T = TypeVar("T")
Model = Callable[[Floats], Floats]
"""Function from a pose to slider positions [m]."""
SEED = 28
SCALE = 1.0 / 3.75e-6
NOISE = 0.1
COUNT = 1e-7
OFF, TURNED = 1e-3, math.radians(0.5)
PLACES, ANGLES = 50e-6, 0.1e-3
"""Maximum differences between the legs as built and as configured, in each coordinate [m] and angle [rad]."""
DISTORTION, AXIS_OFF = 0.005, 150.0
"""Maximum distortion at the edge of a picture, as a fraction, and maximum distance of the lens's axis from the middle
of the picture [pixel].
"""
TOLERANCE, ARC = 1e-6, math.radians(5.0 / 3600.0)
PICTURES_PER_PLACE = 4
"""Number of pictures that are averaged at each place, for calibration, targets and parts, unless a case uses one."""
PART: dict[str, Pair] = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}
FILES = {"3-PRP": "uvw.toml", "3-PPR": "uvw-ppr.toml"}
AIMS = {
    "ideal": ("within 1 µm and 5 arcsec after one correction", 0.95),
    "as built": ("reached after two corrections at most", 0.95),
}


class ComputedStage:
    """Stage as built that is commanded through a model, which may be wrong, with two cameras above it."""

    def __init__(self, built: Geometry, model: Model, rng: np.random.Generator, field: Pair | None = None) -> None:
        self._built, self.model, self._rng, self._field = built, model, rng, field
        self.scales = np.zeros(3)
        """Relative error of each encoder's scale."""
        self.views = {name: _view(rng, place, field) for name, place in PART.items()}
        self.part: Mapping[str, Pair] = PART
        self.pose: Triple = (0.0, 0.0, 0.0)
        """Pose according to the model."""

    @property
    def sliders(self) -> Floats:
        """Slider positions as the encoders show them, (3,) [m]."""
        return np.asarray(np.round(self.model(np.array(self.pose)) / COUNT) * COUNT)

    @property
    def true(self) -> Triple:
        """True pose of the table [m, m, rad]."""
        x, y, phi = forward(self._built, self.sliders * (1.0 + self.scales)).tolist()
        return x, y, phi

    def pixels(self, noise: float) -> dict[str, Pair]:
        """Return the pixel coordinates of the part's marks that are in their pictures, with `noise` [pixels]."""
        pose = self.true
        exact = {
            name: project_points(self.views[name], to_base_frame(q, pose)[None])[0] for name, q in self.part.items()
        }
        noisy = {name: (at + noise * self._rng.standard_normal(2)).tolist() for name, at in exact.items()}
        return {name: (u, v) for name, (u, v) in noisy.items() if self._is_in_picture(u, v)}

    def _is_in_picture(self, u: float, v: float) -> bool:
        return self._field is None or (0.0 <= u < self._field[0] and 0.0 <= v < self._field[1])

    def move(self, motion: StageMotion) -> None:
        """Move to a pose, or by a relative motion about a point, according to the model."""
        if motion.tool is None:
            self.pose = motion.by
            return
        phi = self.pose[2] + motion.by[2]
        x, y = (to_base_frame(motion.tool, self.pose) + motion.by[:2] - rotation_matrix(phi) @ motion.tool).tolist()
        self.pose = (x, y, phi)

    def drive(
        self, requests: Generator[AlignmentRequest, Observation, T], after: Callable[[], None] = lambda: None
    ) -> T:
        """Fulfil the requests of a procedure and return its result; `after` is called after each motion."""
        marks: Mapping[str, Pair] = {}
        try:
            request = next(requests)
            while True:
                if request == LOOK:
                    marks = self.pixels(NOISE)
                elif isinstance(request, StageMotion):
                    self.move(request)
                    after()
                a, b, c = self.sliders.tolist()
                request = requests.send(Observation(marks, self.pose, 0.0, (a, b, c)))
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]


def measure(parts: int, goals: int) -> dict[str, Any]:
    """Return the results of `parts` parts for each kind of stage and each case, and the durations on a service."""
    results: dict[str, Any] = {"aims": [f"{name}: {aim}, {share:.0%}" for name, (aim, share) in AIMS.items()]}
    results |= computed(parts)
    results["seconds of a correction, a service"] = seconds(goals)
    return results


def computed(parts: int) -> dict[str, Any]:
    """Return the results of `parts` parts for each kind of stage and each case."""
    results: dict[str, Any] = {}
    for kind, file in FILES.items():
        ideal = geometry(load(SIM.with_name(file)).geometry)
        mistaken = other_kind(ideal)
        exact: Model = lambda pose, robot=ideal: inverse(robot, pose).position  # type: ignore[misc]  # noqa: E731
        other: Model = lambda pose, robot=mistaken: inverse(robot, pose).position  # type: ignore[misc]  # noqa: E731
        cases: dict[str, tuple[Any, ...]] = {
            "ideal": (lambda _, robot=ideal: robot, exact),
            "as built": (lambda rng, robot=ideal: built_otherwise(robot, rng, PLACES, ANGLES), exact),
            "ideal, one picture of a part": (lambda _, robot=ideal: robot, exact, 1),
            "small angles": (lambda _, robot=ideal: robot, small_angles(ideal)),
            "the other kind's model": (lambda _, robot=ideal: robot, other),
        }
        results[kind] = {name: _case(parts, *case) for name, case in cases.items()}
    return results


def _case(
    parts: int, built: Callable[[np.random.Generator], Geometry], model: Model, looks: int = PICTURES_PER_PLACE
) -> dict[str, Any]:
    made, one, left, counts, first_ok, reached, two = [], [], [], [], 0, 0, 0
    for seed in range(parts):
        rng = np.random.default_rng((SEED, seed))
        stage = ComputedStage(built(rng), model, rng)
        calibration = stage.drive(calibrate_by_moves(looks=PICTURES_PER_PLACE))
        views = [stage.pixels(NOISE) for _ in range(PICTURES_PER_PLACE)]
        targets = {name: tuple(np.mean([view[name] for view in views], axis=0).tolist()) for name in PART}
        aim = np.array([to_base_frame(q, stage.true) for q in PART.values()])
        error = (*rng.uniform(-OFF, OFF, 2), rng.uniform(-TURNED, TURNED))
        stage.part = {name: tuple(to_base_frame(q, error).tolist()) for name, q in PART.items()}
        after: list[tuple[float, float]] = []
        task = AlignmentTask(calibration, targets, looks=looks)
        result = stage.drive(align(task), lambda: after.append(distance_left(stage, aim)))  # noqa: B023
        made.append(len(result.corrections))
        one.append(after[0][0])
        left.append(after[-1][0])
        first_ok += after[0][0] <= TOLERANCE and after[0][1] <= ARC
        reached += result.reached
        two += result.reached and len(result.corrections) <= 2
        counts.append(str(result.why))
    quantiles = (50.0, 95.0, 100.0)
    return {
        "within 1 µm, 5 arcsec after one": first_ok / parts,
        "reached after at most two": two / parts,
        "reached": reached / parts,
        "ended": dict(Counter(counts)),
        "corrections": dict(sorted(Counter(map(str, made)).items())),
        "µm after one, p50/p95/max": [1e6 * float(v) for v in np.percentile(one, quantiles)],
        "µm at the end, p50/p95/max": [1e6 * float(v) for v in np.percentile(left, quantiles)],
    }


def distance_left(stage: ComputedStage, aim: Floats) -> tuple[float, float]:
    """Return the true distance of the worst mark from its target [m], and the angular error of the part [rad]."""
    at = np.array([to_base_frame(q, stage.true) for q in stage.part.values()])
    return float(np.linalg.norm(at - aim, axis=1).max()), abs(fit_rigid_motion(at, aim).turn)


def small_angles(robot: Geometry) -> Model:
    """Return the small-angle model that most programs for such stages use: slider = x - y' phi, or y + x' phi."""
    middle = inverse(robot, np.zeros(3)).position
    rows = []
    for leg in robot.each:
        x, y = leg.pivot if isinstance(leg, CrossLeg) else cast(Leg, leg).edge_point
        c, s = math.cos(leg.rail_angle), math.sin(leg.rail_angle)
        rows.append((c, s, s * x - c * y))
    return lambda pose: np.asarray(middle + np.array(rows) @ pose)


def _view(rng: np.random.Generator, place: Pair, field: Pair | None = None) -> CameraView:
    """Return a camera above a place. With a `field`, its long side is along y, and its lens distorts the picture."""
    mirror = np.diag([1.0, rng.choice([-1.0, 1.0])])
    turn = rng.uniform(-math.pi, math.pi) if field is None else math.pi / 2.0 + rng.uniform(-0.05, 0.05)
    matrix = SCALE * rotation_matrix(turn) @ mirror @ (np.eye(2) + rng.uniform(-0.01, 0.01, (2, 2)))
    (a, b), (c, d) = matrix.tolist()
    if field is None:
        return CameraView(place, (1000.0, 800.0), ((a, b), (c, d)))
    middle, half = np.array(field) / 2.0, max(field) / 2.0
    (u, v), (axis_u, axis_v) = (middle + rng.uniform(-AXIS_OFF, AXIS_OFF, (2, 2))).tolist()
    bend = (float(rng.uniform(-DISTORTION, DISTORTION)) / half**2, 0.0)
    return CameraView(place, (u, v), ((a, b), (c, d)), "radial", bend, (axis_u, axis_v))


def seconds(goals: int) -> dict[str, Any]:
    """Return the durations of corrections by 0.5 mm on a running service, without the time of the cameras [s]."""
    with tempfile.TemporaryDirectory(prefix="trirail-") as name:
        folder = Path(name)
        locator = f"unixsock-stream/{folder}/zenoh"
        text = SIM.with_name("uvw.toml").read_text(encoding="utf-8")
        changes = {"listen": f'["{locator}"]', "max_overruns": "1000", "missed_syncs": "2000"}
        changes |= {"missed_positions": "1000", "heartbeat": "1.0"}
        for key, value in changes.items():
            text = re.sub(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
        config = folder / "uvw.toml"
        config.write_text(text.replace("[telemetry]", "[telemetry]\nlive_port = 0"), encoding="utf-8")
        with own_service.service(config, folder / "align.rrd"), Robot("uvw", locator, user="bench") as robot:
            robot.enable()
            return _seconds(robot, goals)


def _seconds(robot: Robot, goals: int) -> dict[str, Any]:
    rng = np.random.default_rng(SEED)
    views = {name: _view(rng, place) for name, place in PART.items()}
    part = dict(PART)

    def capture_marks() -> dict[str, Pair]:
        pose = robot.state().pose
        seen = {name: project_points(views[name], to_base_frame(q, pose)[None])[0].tolist() for name, q in part.items()}
        return {name: (u, v) for name, (u, v) in seen.items()}

    targets, calibration = capture_marks(), robot.calibrate_camera(capture_marks)
    times, whole = [], []
    for n in range(goals):
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(30.0)
        way = 5e-4 * np.array((math.cos(n), math.sin(n)))
        part = {name: (float(x + way[0]), float(y + way[1])) for name, (x, y) in PART.items()}
        result = robot.align(capture_marks, targets, calibration)
        times.append(result.corrections[0].seconds)
        whole.append(result.seconds)
    quantiles = (50.0, 95.0, 100.0)
    return {
        "aim": "at most 0.4 s",
        "a correction of 0.5 mm, p50/p95/max": [float(v) for v in np.percentile(times, quantiles)],
        "first look to last, p50/p95/max": [float(v) for v in np.percentile(whole, quantiles)],
    }
