"""The shipped examples of makes, each started on simulated drives of its dictionary: power, 1 mm, and power off."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import rigs
from edsfiles import make_eds
from trirail.config import SIM, Config, load
from trirail_drivers.bus.load import HIGH_LOAD
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import DriveGroup, Feedback, PowerState
from trirail_drivers.protocols import PROTOCOLS

FOLDER = SIM.parent / "drives"
DICTIONARIES = {
    "elmo_gold": "elmo_gold",
    "maxon_epos4": "maxon_epos4_compact50_5",
    "nanotec_pd4": "nanotec_pd4n",
    "odrive_s1": None,
    "technosoft_ipos": "technosoft_ipos",
}
"""Of which facts each example's drives are; an ODrive has no dictionary."""
DISTANCE = 1e-3
VELOCITY = 0.01


def example(name: str, folder: Path) -> Config:
    """The shipped file, with drives of its make's dictionary in the place of real ones."""
    config = load(FOLDER / f"{name}.toml")
    make = DICTIONARIES[name]
    drives = config.drives
    if make is not None:
        path = str(make_eds(folder, make))
        axes = {axis: msgspec.structs.replace(getattr(drives, axis), eds=path) for axis in "ABC"}
        drives = msgspec.structs.replace(drives, **axes)
    return msgspec.structs.replace(config, drives=drives)


class Run:
    """The three drives of a configuration, their driver, and its cycles."""

    def __init__(self, config: Config) -> None:
        protocol = PROTOCOLS[config.drives.protocol]
        self.period = config.period
        self.clock = rigs.Clock()
        starts = zip(config.drives.each, rigs.START, strict=True)
        devices = [protocol.simulated_drive(config.can.simulated, config.drives, axis, start) for axis, start in starts]
        self.bus = rigs.Bus(devices, self.clock, protocol.fault_frames)
        self.drives: DriveGroup = protocol.driver(self.bus, config.can.timing, config.drives, self.clock)
        self.drives.configure(config.period)

    def cycle(self, ahead: float = 0.0, velocity: float = 0.0, start: tuple[float, ...] | None = None) -> Feedback:
        self.clock.now += self.period
        self.drives.sync()
        feedback = self.drives.read()
        a, b, c = (place + ahead for place in start or feedback.position)
        self.drives.write((a, b, c), (velocity,) * 3)
        assert feedback.fault is None, feedback.fault
        return feedback

    def until(self, state: PowerState) -> Feedback:
        for _ in range(3000):
            feedback = self.cycle()
            if set(feedback.state) == {state}:
                return feedback
        raise AssertionError(feedback)


def test_there_is_an_example_of_each_make() -> None:
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(DICTIONARIES)


@pytest.mark.parametrize("name", DICTIONARIES)
@pytest.mark.parametrize("alone", [False, True], ids=["with its EDS", "as it is copied"])
def test_an_example_starts_moves_and_stops(name: str, alone: bool, tmp_path: Path) -> None:
    config = load(FOLDER / f"{name}.toml") if alone else example(name, tmp_path)
    run = Run(config)
    try:
        run.cycle()
        run.drives.enable()
        start = run.until(PowerState.OPERATION_ENABLED).position
        steps = round(DISTANCE / VELOCITY / run.period)
        for step in range(1, steps + 1):
            feedback = run.cycle(step * DISTANCE / steps, VELOCITY, start)
            error = max(abs(step * DISTANCE / steps + a - b) for a, b in zip(start, feedback.position, strict=True))
            assert error < config.limits.slider.following_error
        for _ in range(round(0.5 / run.period)):
            feedback = run.cycle(DISTANCE, 0.0, start)
        moved = [there - here for here, there in zip(start, feedback.position, strict=True)]
        assert moved == pytest.approx([DISTANCE] * 3, abs=1e-5)
        run.drives.quick_stop()
        run.until(PowerState.SWITCH_ON_DISABLED)
    finally:
        run.drives.close()


@pytest.mark.parametrize("name", [name for name in DICTIONARIES if name != "odrive_s1"])
def test_what_an_example_says_of_its_drives_it_needs_to_say(name: str, tmp_path: Path) -> None:
    """Without its units and what it accepts to be lacking, such drives are refused by name; Elmo's need no word."""
    config = example(name, tmp_path)
    bare = {
        axis: msgspec.structs.replace(
            getattr(config.drives, axis), velocity_unit=None, acceleration_unit=None, accept_without=()
        )
        for axis in "ABC"
    }
    plain = msgspec.structs.replace(config, drives=msgspec.structs.replace(config.drives, **bare))
    if name == "elmo_gold":
        Run(plain).drives.close()
    else:
        with pytest.raises(DriveError, match=r"drive A|drives\.A"):
            Run(plain)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_an_example_leaves_room_on_its_bus_and_names_what_its_drives_can_answer(path: Path) -> None:
    config = load(path)
    protocol = PROTOCOLS[config.drives.protocol]
    assert protocol.traffic.bus_load(config.loop.rate_hz, config.can.timing, config.drives.heartbeat) <= HIGH_LOAD
    assert ("trirail drives FILE" in path.read_text(encoding="utf-8")) == (protocol.inspect is not None)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_what_never_ran_on_hardware_says_so_in_its_first_line(path: Path) -> None:
    assert path.read_text(encoding="utf-8").splitlines()[0].endswith("never run on hardware")
