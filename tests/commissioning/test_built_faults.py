"""Faults of a simulated machine are what it is: a file that was corrected once is right, and needs nothing more."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from commissioning.test_guide import Beside, Run
from generated import thinned
from msgspec import structs
from trirail.config import SIM, Config, load
from trirail_drivers.interface import NAMES

SIMULATED = [SIM.parent / name for name in ("sim.toml", "uvw.toml", "uvw-ppr.toml", "xxy.toml")]
TURNED = ("B reversed", "C scale 0.5", "all reversed", "A swapped B|B swapped A", "A counts -2e7", "A node 3|C node 1")
"""Faults that a configuration can correct; | stands between those of one machine."""
OF_PARTS = ("B against", "A loose", "C slips 0.3", "B play 0.0003")
"""Faults that none can."""


@pytest.mark.generated(0, 1)
@pytest.mark.parametrize("path", thinned(SIMULATED, every=3), ids=lambda path: path.stem)
@pytest.mark.long
def test_one_pass_corrects_the_file_and_the_next_finds_nothing(path: Path, seed: int, tmp_path: Path) -> None:
    chance = random.Random(f"{path.stem}{seed}")
    faults = chance.choice(TURNED).split("|")
    part = chance.choice(OF_PARTS)
    by_hand = Beside(["Power", "Switches"])
    (tmp_path / "one").mkdir()
    first = Run(tmp_path / "one", slowed(path), faults, by_hand, path)
    assert first.written is not None, faults
    (tmp_path / "two").mkdir()
    second = Run(tmp_path / "two", slowed(first.written), faults, Beside(["Power", "Switches"]), first.written)
    assert second.written is None, (faults, second.keeper.report.changes)
    assert second.keeper.report.ok, second.person.lines
    (tmp_path / "three").mkdir()
    third = Run(
        tmp_path / "three", slowed(first.written), [*faults, part], Beside(["Power", "Switches"]), first.written
    )
    assert third.written is None, (faults, part, third.keeper.report.changes)


@pytest.mark.parametrize("part", OF_PARTS)
def test_no_direction_is_written_for_what_is_wrong_in_the_drive_or_its_shaft(part: str, tmp_path: Path) -> None:
    name = part[0]
    others = "".join(set(NAMES) - {name})
    run = Run(tmp_path, slowed(SIM), [part], Beside([f"(drive|Drive|slider|Slider) [{others}]", "Switches"]))
    assert run.keeper.report.changes == {}


def slowed(path: Path) -> Config:
    robot = load(path)
    return structs.replace(robot, loop=structs.replace(robot.loop, rate_hz=500))
