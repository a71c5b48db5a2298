"""Motions of drives that get setpoints of 4 bytes, without velocity feed-forward."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from conftest import Rig
from control_rig import CONFIG, ControlRig
from trirail.config import Config
from trirail.diagnosis import diagnose
from trirail.wire.packets import Request
from trirail_drivers.cia402 import canopen_frames

TARGET = (0.06, -0.04, 0.1)
RATE = 1250
"""Rate at which the setpoints are without velocity offset, since 8 bytes would use 94 % of the bus [Hz]."""


class FramesRig(Rig):
    """A robot that keeps the lengths of its setpoints and its following errors."""

    def __init__(self, config: Config) -> None:
        self.lengths: set[int] = set()
        self.errors: list[float] = []
        super().__init__(config)

    def cycle(self, request: Request | None = None) -> None:
        self.sent.clear()
        ControlRig.cycle(self, request)
        rpdo2 = canopen_frames.RPDO2 >> 7
        self.lengths |= {len(sent.data) for sent in self.sent if sent.arbitration_id >> 7 == rpdo2}
        self.errors.append(float(np.abs(self.control.measured.following_error).max()))


def robot(setting: str, velocity: float) -> Config:
    """The shipped robot at 1250 Hz, with a velocity limit of the sliders [m/s]."""
    slider = msgspec.structs.replace(CONFIG.limits.slider, velocity=velocity)
    limits = msgspec.structs.replace(CONFIG.limits, slider=slider)
    drives = msgspec.structs.replace(CONFIG.drives, velocity_offset=setting)
    loop = msgspec.structs.replace(CONFIG.loop, rate_hz=RATE)
    return msgspec.structs.replace(CONFIG, limits=limits, drives=drives, loop=loop)


def moved(config: Config) -> FramesRig:
    """Run a motion to its end."""
    rig = FramesRig(config)
    rig.enable()
    rig.errors.clear()
    rig.goal("g1", *TARGET)
    rig.until(lambda: any(said.kind == "goal" for said in rig.notices))
    rig.bus.shutdown()
    return rig


def test_a_motion_without_velocity_offset_stays_within_its_windows() -> None:
    """The servos lag by their time constant; the windows and the arrival are those of the robot."""
    config = robot("auto", velocity=0.5)
    assert [check for check in diagnose(config) if check.name == "simulated"] == []
    short, full = moved(config), moved(robot("always", velocity=0.5))
    assert (short.lengths, full.lengths) == ({4}, {8})
    for rig in (short, full):
        assert rig.outcomes() == [("g1", "done")]
        assert rig.control.measured.feedback.fault is None
        assert max(rig.errors) < config.limits.slider.following_error
        assert rig.control.measured.pose == pytest.approx(TARGET, abs=2e-5)
    assert max(short.errors) > 2.0 * max(full.errors)
