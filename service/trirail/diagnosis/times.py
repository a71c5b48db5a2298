"""Times and counts that cannot be meant: each may be written, and none of these does what it is there for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from trirail_drivers.interface import NAMES

from trirail.config import Config
from trirail.diagnosis.check import Check, Judgement


class _Bounds(NamedTuple):
    """Between which a time is meant."""

    key: str
    value: float
    """As the file has it."""
    time: float
    """What it comes to [s]."""
    low: float
    high: float
    """[s]."""
    shorter: str
    """What would be so where it is shorter."""
    longer: str


def _bounds(config: Config) -> Iterator[_Bounds]:
    dogs, drives, period, settling = config.watchdogs, config.drives, config.period, config.limits.in_position
    beats = 3.0 * drives.heartbeat
    up, over = "a drive does not power up in that", "a drive that does not power up would not be noticed"
    yield _Bounds("watchdogs.enable_timeout", dogs.enable_timeout, dogs.enable_timeout, max(0.1, beats), 60.0, up, over)
    late = dogs.max_overruns * period
    yield _Bounds("watchdogs.max_overruns", dogs.max_overruns, late, 0.0, 1.0, "", "so long the robot would not be led")
    gone = dogs.gateway_timeout
    yield _Bounds("watchdogs.gateway_timeout", gone, gone, 0.0, 3.0, "", "so long nobody could stop the robot")
    blind = drives.missed_positions * period
    unseen = "so long a drive may be silent in motion"
    yield _Bounds("drives.missed_positions", drives.missed_positions, blind, 0.0, 0.1, "", unseen)
    yield _Bounds("drives.heartbeat", drives.heartbeat, drives.heartbeat, 0.005, 1.0, "it would fill the bus",
                  "three of them until a drive without a service stops")  # fmt: skip
    yield _Bounds("drives.stop_timeout", drives.stop_timeout, drives.stop_timeout, 0.02, 30.0,
                  "no drive loses its power in that", "a drive that keeps its power would not be noticed")  # fmt: skip
    yield _Bounds("drives.sdo_timeout", drives.sdo_timeout, drives.sdo_timeout, 0.05, 20.0,
                  "drives answer later", "a drive that is not there would not be noticed")  # fmt: skip
    yield _Bounds("limits.in_position.dwell", settling.dwell, settling.dwell, 2.0 * period, 2.0,
                  "one measurement alone would decide", "every goal would wait for it")  # fmt: skip
    rotate = config.telemetry.rotate_minutes
    yield _Bounds("telemetry.rotate_minutes", rotate, 60.0 * rotate, 60.0, math.inf, "a recording a minute", "")


def _times(config: Config) -> Iterator[Check]:
    number, wrong = 0, False
    for key, given, time, low, high, shorter, longer in _bounds(config):
        number += 1
        if low <= time <= high:
            continue
        wrong = True
        said = f"{key} = {given:g}" + ("" if given == time else f", {time:.3g} s")
        if time < low:
            yield Check("times", "warning", f"{said}: {shorter}", f"wanted {low * given / time:.3g} at least", key)
        else:
            yield Check("times", "warning", f"{said}: {longer}", f"wanted {high * given / time:.3g} at most", key)
    if not wrong:
        yield Check("times", "ok", f"{number} times and counts are such as can be meant")


def _sizes(config: Config) -> Iterator[Check]:
    """A file of a recording that is larger than what may be kept, or so small that there are thousands."""
    rotate, keep = config.telemetry.rotate_mb, config.telemetry.keep_mb
    if rotate > keep:
        said = f"telemetry.rotate_mb = {rotate:g}, and of all recordings telemetry.keep_mb = {keep:g} are kept"
        yield Check("recordings", "warning", said, "rotate_mb a tenth of keep_mb or less", "telemetry.rotate_mb")
    if rotate < 10.0:
        said = f"telemetry.rotate_mb = {rotate:g}: at 1 kHz a file every {rotate * 3.6:.2g} s at most"
        yield Check("recordings", "warning", said, "wanted 10 at least", "telemetry.rotate_mb")


def _homing(config: Config) -> Iterator[Check]:
    """A slider has to reach its switch in the time, and to stop behind it."""
    slider = config.limits.slider
    for name, drive, (low, high), most in zip(
        NAMES, config.drives.each, slider.positions, slider.velocities, strict=True
    ):
        travel = high - low
        homing, key = drive.homing, f"drives.{name}.homing"
        if homing is None:
            continue
        fast = f"{key}.speed_switch = {homing.speed_switch:g} m/s"
        if homing.speed_switch > most:
            said = f"{fast} is beyond limits.slider.velocity = {most:g}"
            yield Check("homing", "warning", said, "slower", f"{key}.speed_switch")
        if homing.speed_zero > homing.speed_switch:
            said = f"{key}.speed_zero = {homing.speed_zero:g} m/s is faster than speed_switch"
            yield Check("homing", "warning", said, "the edge is searched slowly", f"{key}.speed_zero")
        if homing.speed_switch * homing.timeout < travel:
            said = f"{fast} goes {homing.speed_switch * homing.timeout:.3g} m in {homing.timeout:g} s, the travel is "
            yield Check("homing", "warning", f"{said}{travel:.3g} m", "faster, or a longer timeout", f"{key}.timeout")
        way = homing.speed_switch**2 / (2.0 * homing.acceleration)
        if way > travel / 20.0 or homing.speed_switch / homing.acceleration < 1e-3:
            said = f"{key}.acceleration = {homing.acceleration:g} m/s²: it stops {way * 1e3:.2g} mm behind its switch"
            yield Check("homing", "warning", said, "is it in another unit?", f"{key}.acceleration")


JUDGEMENTS = (
    Judgement(
        (
            "watchdogs", "drives.missed_positions", "drives.heartbeat", "drives.stop_timeout", "drives.sdo_timeout",
            "limits.in_position.dwell", "telemetry.rotate_minutes", "loop.rate_hz",
        ),
        _times,
    ),
    Judgement(("telemetry.rotate_mb", "telemetry.keep_mb"), _sizes),
    Judgement(
        ("limits.slider", "drives.A.homing", "drives.B.homing", "drives.C.homing"),
        _homing,
    ),
)  # fmt: skip
