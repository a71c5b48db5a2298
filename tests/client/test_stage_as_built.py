"""A stage as it is built, seen by simulated cameras: play, its own map of errors, lag, exposure and frame delay."""

from __future__ import annotations

import dataclasses
import math
import threading

import numpy as np
import pytest
from alignment.cameras import Stage, camera, part_at
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from trirail.alignment.images import CameraView, Pair, project_points
from trirail.alignment.procedure import AlignmentTask, StageMotion, align, calibrate_by_moves
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.client import stage_as_built
from trirail.client.alignment import goals
from trirail.client.stage_as_built import StageAsBuilt
from trirail.errors import ServiceError
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse
from trirail.wire.goals import MoveGoal, PoseGoal
from trirail.wire.records import DTYPE
from trirail_drivers.interface import Triple
from trirail_drivers.simulated.servo import Servo

ROBOT = Geometry.symmetric(0.3)
PART: dict[str, Pair] = {"left": (-0.06, 0.01), "right": (0.06, 0.01)}
seeds = st.integers(0, 2**32 - 1)


def records(positions: NDArray[np.float64], begin: float = 0.0, rate_hz: int = 1000) -> bytes:
    """Return a record a cycle in which drives measured these positions, (N, 3) [m]."""
    made = np.zeros(len(positions), DTYPE)
    made["cycle"] = np.arange(len(positions))
    made["deadline_ns"] = np.round((begin + np.arange(len(positions)) / rate_hz) * 1e9)
    made["position"] = positions
    return made.tobytes()


def walk(rng: np.random.Generator, length: int, step: float) -> NDArray[np.float64]:
    """Return a random way of three motors that turn back now and then, (N, 3) [m]."""
    turns = rng.choice([-1.0, 1.0], (length, 3), p=[0.3, 0.7]).cumprod(axis=0)
    return np.asarray((turns * rng.uniform(0.0, step, (length, 3))).cumsum(axis=0))


@given(seeds)
def test_sliders_stand_where_those_of_drives_with_play_do(seed: int) -> None:
    """As the simulated drives have it, counts for metres, however their records are cut into batches."""
    rng = np.random.default_rng(seed)
    play, motors = rng.uniform(0.0, 5e-5, 3), walk(rng, 60, 1e-5)
    stage = StageAsBuilt(ROBOT, (float(play[0]), float(play[1]), float(play[2])))
    cut = int(rng.integers(1, 59))
    stage.add_records(records(motors[:cut]))
    stage.add_records(records(motors[cut:], cut * 1e-3))
    wanted = []
    for path, width in zip(motors.T, play, strict=True):
        servo = Servo(0.0, time_constant=0.0, max_velocity=1.0, max_acceleration=1.0)
        servo.play = width
        for way in np.diff(path):
            servo.turn(way)
        wanted.append(path[0] + servo.driven)
    assert stage.sliders_at(0.059) == pytest.approx(wanted, abs=1e-15)


def bent(rng: np.random.Generator, size: float) -> Geometry:
    """Return the robot with a map of errors: smooth, of some micrometres and microradians."""
    nodes = rng.uniform(-size, size, (5, 5, 5, 3))
    return dataclasses.replace(ROBOT, correction=Correction((-0.05, -0.05, -0.3), (0.05, 0.05, 0.3), nodes))


@given(seeds)
def test_the_table_stands_where_the_stages_own_errors_have_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    built, pose = bent(rng, 5e-5), rng.uniform(-1.0, 1.0, 3) * (0.03, 0.03, 0.2)
    believed = inverse(ROBOT, pose).position
    stage = StageAsBuilt(built)
    stage.add_records(records(np.tile(believed, (2, 1))))
    true = stage.pose_at(0.001)
    assert inverse(built, true).position == pytest.approx(believed, abs=1e-12)
    assert built.correction is not None
    assert np.add(true, built.correction.at(np.array([true]))[0]) == pytest.approx(pose, abs=1e-9)


SCALE = 2.5e5
VIEW = CameraView((0.0, 0.0), (160.0, 120.0), ((SCALE, 0.0), (0.0, -SCALE)))
CAMERA = SimulatedCamera(VIEW, {"m": DrawnMark(MarkShape("disc", 160e-6), (0.0, 0.0))}, 320, 240, 0.0)


def moments(picture: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the middle of what is light along u, and how wide that is: its variance [pixel, pixel²]."""
    light = picture.astype(float).sum(axis=0)
    u = np.arange(len(light))
    middle = float((light * u).sum() / light.sum())
    return middle, float((light * (u - middle) ** 2).sum() / light.sum())


@given(
    speed=st.floats(-0.01, 0.01), exposure=st.floats(0.0, 0.01), delay=st.floats(0.0, 0.02), time=st.floats(0.04, 0.06)
)
@settings(max_examples=40)
def test_a_picture_is_of_the_time_of_its_exposure_and_smeared_by_the_way_in_it(
    speed: float, exposure: float, delay: float, time: float
) -> None:
    """The middle lags by the delay and half the exposure; a way w in it adds w²/12 to the variance of the light."""
    x = speed * (np.arange(101) * 1e-3 - 0.05)
    poses = np.stack([x, np.zeros(101), np.zeros(101)], axis=1)
    stage = StageAsBuilt(ROBOT)
    stage.add_records(records(inverse(ROBOT, poses).position))
    camera = CAMERA._replace(exposure=exposure, delay=delay)
    rng = np.random.default_rng(0)
    middle, width = moments(camera.picture(stage.pose_at, time, rng))
    _, still = moments(CAMERA.picture(lambda _: (0.0, 0.0, 0.0), 0.0, rng))
    at = speed * (time - delay - exposure / 2.0 - 0.05)
    assert middle == pytest.approx(160.0 + SCALE * at, abs=0.05)
    assert width - still == pytest.approx((SCALE * speed * exposure) ** 2 / 12.0, rel=0.03, abs=0.5)


@given(lag=st.floats(4e-3, 0.02), step=st.floats(1e-5, 2e-4), waited=st.floats(0.0, 0.05))
@settings(max_examples=30)
def test_what_has_not_settled_is_seen_where_it_is(lag: float, step: float, waited: float) -> None:
    """A picture too early shows the rest of the way, step · exp(-t / lag), and one after that nothing of it."""
    t = np.arange(101) * 1e-3
    x = step * (1.0 - np.exp(-t / lag))
    stage = StageAsBuilt(ROBOT)
    stage.add_records(records(inverse(ROBOT, np.stack([x, 0.0 * x, 0.0 * x], axis=1)).position))
    middle, _ = moments(CAMERA.picture(stage.pose_at, waited, np.random.default_rng(0)))
    assert (middle - 160.0) / SCALE == pytest.approx(step * (1.0 - math.exp(-waited / lag)), abs=5e-8 + 0.02 * step)


def test_records_of_a_time_are_waited_for_and_those_that_are_gone_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_as_built, "COMES_WITHIN", 60.0)
    stage = StageAsBuilt(ROBOT)
    timer = threading.Timer(0.05, lambda: stage.add_records(records(np.zeros((10, 3)), 5.0)))
    timer.start()
    assert stage.pose_at(5.004) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    timer.join()
    with pytest.raises(ServiceError, match="before the first record"):
        stage.pose_at(4.0)
    monkeypatch.setattr(stage_as_built, "COMES_WITHIN", 0.01)
    with pytest.raises(ServiceError, match="check that the service is running"):
        stage.pose_at(6.0)


def test_a_mark_of_the_table_goes_where_the_table_really_goes() -> None:
    """Half the play is missing on the way there: the picture is that much behind what the drives measure."""
    play: Triple = (4e-5, 4e-5, 4e-5)
    stage = StageAsBuilt(ROBOT, play)
    ends = inverse(ROBOT, np.array([(0.0, 0.0, 0.0), (2e-4, 0.0, 0.0)])).position
    ways = np.linspace(0.0, 1.0, 50)[:, None]
    stage.add_records(records(ends[0] + ways * (ends[1] - ends[0])))
    moved = ends[1] - ends[0]
    true = stage.pose_at(0.049)
    sliders = ends[1] - np.sign(np.where(np.abs(moved) > 2e-5, moved, 0.0)) * 2e-5
    assert inverse(ROBOT, true).position == pytest.approx(np.where(np.abs(moved) > 2e-5, sliders, ends[0]), abs=1e-12)
    u, _ = project_points(VIEW, np.array([true[:2]]))[0]
    assert moments(CAMERA.picture(stage.pose_at, 0.049, np.random.default_rng(0)))[0] == pytest.approx(u, abs=0.02)


class StageWithPlay(Stage):
    """Goes where goals send it, by motors with play: pictures show the table, poses are what the encoders have."""

    def __init__(self, rng: np.random.Generator, play: float) -> None:
        super().__init__({name: camera(rng, place) for name, place in PART.items()}, PART, rng, 0.02)
        self._stage = StageAsBuilt(ROBOT, (play, play, play))
        self._time = 0.0
        for _ in range(2):
            self._to(self.pose)

    def look(self) -> dict[str, Pair]:
        believed, self.pose = self.pose, self._stage.pose_at(self._time - 1e-9)
        try:
            return super().look()
        finally:
            self.pose = believed

    def go(self, motion: StageMotion) -> None:
        for goal in goals(motion, 1.0):
            assert isinstance(goal, PoseGoal | MoveGoal)
            assert not isinstance(goal.tool, str)
            super().go(StageMotion((goal.x, goal.y, goal.phi), goal.tool))
            self._to(self.pose)

    def _to(self, pose: Triple) -> None:
        end = inverse(ROBOT, pose).position
        self._stage.add_records(records(np.stack([end]), self._time + 1e-3))
        self._time += 1e-3


@given(seeds)
@settings(max_examples=40)
def test_play_is_no_matter_where_the_table_always_comes_from_the_same_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stage = StageWithPlay(rng, 2e-5)
    beyond = (4e-4, 3e-4, 3e-3)  # all three sliders turn back on the way from there
    calibration = stage.drive(calibrate_by_moves(approach=beyond))
    targets = stage.look()
    x, y, phi = rng.uniform(-1.0, 1.0, 3) * (5e-4, 5e-4, 4e-3)
    stage.part = part_at(PART, (float(x), float(y), float(phi)))
    for pose in ((-1e-3, -1e-3, -1e-2), (0.0, 0.0, 0.0)):
        stage.go(StageMotion(pose))  # as whoever brings the part: from the other side
    found = stage.drive(align(AlignmentTask(calibration, targets, tolerance=2e-6, angle=5e-5, approach=beyond)))
    assert found.reached
    assert len(found.corrections) == 1


def test_play_is_seen_where_the_table_comes_from_either_side() -> None:
    """Half of 20 µm on each side: the first correction leaves micrometres, not tenths."""
    left = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        stage = StageWithPlay(rng, 2e-5)
        calibration = stage.drive(calibrate_by_moves())
        targets = stage.look()
        stage.part = part_at(PART, (3e-4, -2e-4, 2e-3))
        found = stage.drive(align(AlignmentTask(calibration, targets, tolerance=1e-7, angle=1e-9, corrections=1)))
        left.append(found.measurements[-1].worst)
    assert 2e-6 < float(np.median(left)) < 3e-5
