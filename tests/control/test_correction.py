"""As-built errors, end to end: played, measured on a grid, calibrated by the tool, corrected, and judged from outside.

The judge knows the robot as it was built: its true geometry, and where the sliders stand behind the backlash.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import calibrate
import msgspec
import numpy as np
import pytest
from conftest import Rig
from control_rig import CONFIG
from numpy.typing import NDArray
from trirail.config import SIM, Config, corrected_geometry, geometry, load
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import forward, inverse
from trirail.wire.vocabulary import Mode

Array = NDArray[np.float64]

OFF = 50e-6
"""How far legs and sliders are from where they should be [m]."""
GOOD = 5e-6
"""What may be left of that."""
REACH = 0.17
"""How far the platform's edges are from its centre: an angle counts by what it moves there [m]."""
NOISE = (1e-6, 1e-6, 5e-6)
"""Of the instrument [m, m, rad]."""
PLAIN = geometry(CONFIG.geometry)
WINDOWS = msgspec.structs.replace(CONFIG.limits.in_position, sliders=(1e-6,) * 3, pose=(2e-6, 2e-6, 1e-5))
QUICK = msgspec.structs.replace(
    CONFIG,
    loop=msgspec.structs.replace(CONFIG.loop, rate_hz=250),
    limits=msgspec.structs.replace(CONFIG.limits, in_position=WINDOWS),
)
"""Few cycles, and `done` only where the drives really are."""
GRID = list(itertools.product(*[np.linspace(-0.147, 0.147, 7)] * 2, np.linspace(-0.9, 0.84, 5)))
"""Of which four in ten are within the sliders' travel."""


def as_built() -> Geometry:
    """The legs 50 µm and a tenth of a milliradian off, to all sides."""
    random = np.random.default_rng(4)

    def off(point: tuple[float, float]) -> tuple[float, float]:
        dx, dy = OFF * random.choice((-1.0, 1.0), 2)
        return point[0] + dx, point[1] + dy

    a, b, c = (
        replace(
            leg,
            anchor=off(leg.anchor),
            edge_point=off(leg.edge_point),
            rail_angle=leg.rail_angle + random.uniform(-1e-4, 1e-4),
            edge_angle=leg.edge_angle + random.uniform(-1e-4, 1e-4),
        )
        for leg in PLAIN.legs
    )
    return Geometry((a, b, c))


TRUE = as_built()


class Judged:
    """A robot that was built so, and an instrument that sees where its platform really is."""

    def __init__(self, config: Config, backlash: float = OFF) -> None:
        self.rig = Rig(config)
        self.rig.bus.faults.add(f"all play {backlash}")
        self.rig.enable()
        self._number = itertools.count()

    def go(self, x: float, y: float, phi: float) -> None:
        """Go there and settle."""
        self.rig.goal(f"g{next(self._number)}", x, y, phi)
        self.rig.until(self.rig.holds)
        assert self.rig.outcomes()[-1][1] == "done"

    def pose(self) -> Array:
        return forward(TRUE, self.rig.bus.faults.carriages.read(), near=self.rig.control.measured.pose)

    def told_sliders(self) -> Array:
        record = self.rig.control.measured.record[0]
        sliders: Array = record["position"] - record["backlash"]
        return sliders


def with_backlash(config: Config, backlash: float = OFF) -> Config:
    told = msgspec.structs.replace(config.correction, backlash=(backlash,) * 3)
    return msgspec.structs.replace(config, correction=told)


def reachable(poses: list[tuple[float, float, float]]) -> Iterator[tuple[float, float, float]]:
    """The poses that the limits allow, with room for a correction."""
    slider = CONFIG.limits.slider
    for pose in poses:
        found = inverse(PLAIN, pose)
        places = np.array([found.position, found.passive_position])
        if (places > slider.positions[0][0] + 0.003).all() and (places < slider.positions[0][1] - 0.003).all():
            yield pose


def error(seen: Array, wanted: tuple[float, float, float]) -> float:
    """How far the platform is from there, at its centre or by its angle at its edges [m]."""
    dx, dy, dphi = seen - wanted
    return max(float(np.hypot(dx, dy)), abs(float(dphi)) * REACH)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Poses on a grid, as an instrument sees them, beside what the sliders say."""
    path = tmp_path_factory.mktemp("measured") / "poses.csv"
    judged, random = Judged(with_backlash(QUICK)), np.random.default_rng(3)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(calibrate.COLUMNS)
        for pose in reachable(GRID):
            judged.go(*pose)
            seen = judged.pose() + random.normal(0.0, NOISE)
            table.writerow([*seen.tolist(), *judged.told_sliders().tolist()])
    judged.rig.bus.shutdown()
    return path


@pytest.fixture(scope="module")
def robot_file(measured: Path) -> Path:
    """A configuration with the tool's map, and the backlash."""
    folder = measured.parent
    assert calibrate.main([str(measured), "--map", "--output", str(folder / "as_built.toml")]) == 0
    told = f'\n[correction]\nmap = "as_built.toml"\nbacklash = [{OFF}, {OFF}, {OFF}]\n'
    path = folder / "robot.toml"
    path.write_text(SIM.read_text(encoding="utf-8") + told, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def corrected(robot_file: Path) -> Config:
    config = load(robot_file)
    return msgspec.structs.replace(QUICK, correction=config.correction)


def goals(number: int, seed: int = 9) -> list[tuple[float, float, float]]:
    random = np.random.default_rng(seed)
    found = [tuple(random.uniform((-0.14, -0.14, -0.9), (0.14, 0.14, 0.8)).tolist()) for _ in range(3 * number)]
    return list(reachable(found))[:number]


def errors(config: Config, number: int) -> list[float]:
    judged, found = Judged(config), []
    for goal in goals(number):
        judged.go(*goal)
        found.append(error(judged.pose(), goal))
    judged.rig.bus.shutdown()
    return found


@pytest.mark.long
def test_errors_of_fifty_micrometres_become_five(corrected: Config) -> None:
    found = errors(corrected, 40)
    assert max(found) <= GOOD


def test_without_a_correction_they_are_there() -> None:
    assert max(errors(QUICK, 15)) >= 2 * OFF
    assert max(errors(with_backlash(QUICK), 15)) >= OFF


@pytest.mark.long
def test_the_pose_that_is_told_is_the_real_one(corrected: Config) -> None:
    """In motion too, where no slider has turned back for a while."""
    judged = Judged(corrected)
    judged.go(-0.05, -0.03, -0.2)
    judged.rig.goal("far", 0.06, 0.05, 0.3, speed=0.3)
    judged.rig.until(lambda: judged.rig.mode is Mode.MOVING)
    judged.rig.cycles(100)
    seen = []
    while judged.rig.mode is Mode.MOVING:
        seen.append(error(judged.pose(), judged.rig.control.measured.pose))
        judged.rig.cycle()
    assert len(seen) > 100
    # The carriages are read a SYNC later than the drives told their positions.
    fastest = float(np.abs(np.diff([row[0] for row in judged.rig.rows], axis=0)).max())
    assert max(seen) <= GOOD + 2.0 * fastest
    assert error(judged.pose(), judged.rig.control.measured.pose) <= GOOD


def test_a_correction_of_nothing_changes_no_bit() -> None:
    """Setpoints of a whole session, with a map of zeros and without [correction]."""
    zeros = np.zeros((5, 5, 5, 3)).tolist()
    low, high = (-0.15, -0.15, -1.2), (0.15, 0.15, 0.85)
    from trirail.config.as_built import AsBuilt, geometry_of

    nothing = AsBuilt(made="today", geometry=geometry_of(PLAIN), low=low, high=high, nodes=zeros)
    told = msgspec.structs.replace(QUICK.correction, as_built=nothing)
    rows = []
    for config in (QUICK, msgspec.structs.replace(QUICK, correction=told)):
        rig = Rig(config)
        rig.enable()
        for number, goal in enumerate(goals(5)):
            rig.goal(f"g{number}", *goal)
            rig.until(rig.holds)
        rows.append(rig.setpoints())
        rig.bus.shutdown()
    assert corrected_geometry(QUICK).correction is None
    assert rows[0].tolist() == rows[1].tolist()
