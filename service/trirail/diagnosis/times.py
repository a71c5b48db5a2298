"""Checks for times and counts that are valid, but too small or too large for their purpose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from trirail_drivers.interface import NAMES

from trirail.config import Config
from trirail.diagnosis.check import Check, ConfigCheck
from trirail.motion.backlash_reserve import reserve_for_backlash
from trirail.quantities import rounded_inwards

POSITION_DELAY_CYCLES = 3
"""Number of cycles after which the positions of perfect drives are those of the last setpoint."""
WHOLE_TOLERANCE = 1e-9
"""Rounding error of a whole number of cycles."""


class _Bounds(NamedTuple):
    """Value of a configuration key, and the plausible range of the time that it represents."""

    key: str
    value: float
    """Value in the configuration."""
    time: float
    """Time that the value represents [s]."""
    low: float
    """Shortest plausible time [s]."""
    high: float
    """Longest plausible time [s]."""
    shorter: str
    """Consequence of a shorter time."""
    longer: str
    """Consequence of a longer time."""


def _bounds(config: Config) -> Iterator[_Bounds]:
    dogs, drives, period, settling = config.watchdogs, config.drives, config.period, config.limits.in_position
    beats = 3.0 * drives.heartbeat
    up, over = "no drive enables that fast", "a drive that does not enable would go unnoticed"
    yield _Bounds("watchdogs.enable_timeout", dogs.enable_timeout, dogs.enable_timeout, max(0.1, beats), 60.0, up, over)
    late = dogs.max_overruns * period
    yield _Bounds(
        "watchdogs.max_overruns", dogs.max_overruns, late, 0.0, 1.0, "", "the robot would move without setpoints"
    )
    unreachable = dogs.gateway_timeout
    yield _Bounds(
        "watchdogs.gateway_timeout",
        unreachable,
        unreachable,
        0.0,
        3.0,
        "",
        "the robot could not be stopped for that time",
    )
    blind = drives.missed_positions * period
    unseen = "a drive could be silent in motion for that time"
    yield _Bounds("drives.missed_positions", drives.missed_positions, blind, 0.0, 0.1, "", unseen)
    yield _Bounds("drives.heartbeat", drives.heartbeat, drives.heartbeat, 0.005, 1.0, "it would fill the bus",
                  "a drive that lost the service stops after three")  # fmt: skip
    yield _Bounds("drives.stop_timeout", drives.stop_timeout, drives.stop_timeout, 0.02, 30.0,
                  "no drive disables that fast", "a drive that keeps its power would go unnoticed")  # fmt: skip
    yield _Bounds("drives.sdo_timeout", drives.sdo_timeout, drives.sdo_timeout, 0.05, 20.0,
                  "drives answer later", "a missing drive would go unnoticed")  # fmt: skip
    yield _Bounds("limits.in_position.dwell", settling.dwell, settling.dwell, 2.0 * period, 2.0,
                  "a single measurement would decide", "every goal would wait for it")  # fmt: skip
    rotate = config.telemetry.rotate_minutes
    yield _Bounds(
        "telemetry.rotate_minutes", rotate, 60.0 * rotate, 60.0, math.inf, "more than a recording per minute", ""
    )


def _times(config: Config) -> Iterator[Check]:
    count, wrong = 0, False
    for key, number, time, low, high, shorter, longer in _bounds(config):
        count += 1
        if low <= time <= high:
            continue
        wrong = True
        setting = f"{key} = {number:g}" + ("" if number == time else f", {time:.3g} s")
        if time < low:
            remedy = f"set at least {rounded_inwards(low * number / time, 3, low=True):g}"
            yield Check("times", "warning", f"{setting}: {shorter}", remedy, key)
            continue
        most = rounded_inwards(high * number / time, 3, low=False)
        if isinstance(number, int):  # a number of cycles
            most = math.floor(most + WHOLE_TOLERANCE)
        remedy = f"set at most {most:g}" if most else "set a higher loop.rate_hz: 1 cycle is too long"
        yield Check("times", "warning", f"{setting}: {longer}", remedy, key)
    if not wrong:
        yield Check("times", "ok", f"{count} times and counts are plausible")


def _settling(config: Config) -> Iterator[Check]:
    """Check that a goal can be in position before the time-out, also after a reversal of sliders with backlash."""
    settling, period, backlash = config.limits.in_position, config.period, config.correction.backlash
    take_up = reserve_for_backlash(backlash, config.limits.slider).duration
    least = take_up + (math.ceil(settling.dwell / period) + POSITION_DELAY_CYCLES) * period
    if settling.timeout >= least:
        return
    setting = f"limits.in_position.timeout = {settling.timeout:g} s"
    after = f"the dwell and {POSITION_DELAY_CYCLES} cycles of {period:g} s"
    remedy = f"set at least {rounded_inwards(least, 3, low=True):g}"
    if take_up == 0.0:
        finding = f"{setting}: shorter than {after}: goals may end as unsettled"
    else:
        finding = f"{setting}: shorter than {take_up:.3g} s, in which a slider crosses correction.backlash, {after}: "
        finding += "goals that reverse a slider may end as unsettled"
        remedy += ", or raise velocity, acceleration and jerk in limits.slider"
    yield Check("times", "warning", finding, remedy, "limits.in_position.timeout")


def _sizes(config: Config) -> Iterator[Check]:
    """Check that a recording's files are smaller than the maximum for all recordings, but not too small."""
    rotate, keep = config.telemetry.rotate_mb, config.telemetry.keep_mb
    if rotate > keep / 2.0:  # above this, a file that is being written does not count, see telemetry.retention.tidy
        finding = f"telemetry.rotate_mb = {rotate:g} exceeds half of telemetry.keep_mb = {keep:g}, the total of all"
        yield Check(
            "recordings", "warning", finding, "set rotate_mb to a tenth of keep_mb or less", "telemetry.rotate_mb"
        )
    if rotate < 10.0:
        finding = f"telemetry.rotate_mb = {rotate:g}: a file every {rotate * 3.6:.2g} s at 1 kHz"
        yield Check("recordings", "warning", finding, "set at least 10", "telemetry.rotate_mb")


def _homing(config: Config) -> Iterator[Check]:
    """Check that homing reaches the switch within the time-out, and stops soon after it has reached the switch."""
    slider = config.limits.slider
    for name, drive, (low, high), limit in zip(
        NAMES, config.drives.each, slider.positions, slider.velocities, strict=True
    ):
        travel = high - low
        homing, key = drive.homing, f"drives.{name}.homing"
        if homing is None:
            continue
        fast = f"{key}.speed_switch = {homing.speed_switch:g} m/s"
        if homing.speed_switch > limit:
            finding = f"{fast} exceeds limits.slider.velocity = {limit:g}"
            yield Check("homing", "warning", finding, "set a lower speed", f"{key}.speed_switch")
        if homing.speed_zero > homing.speed_switch:
            finding = f"{key}.speed_zero = {homing.speed_zero:g} m/s is faster than speed_switch"
            yield Check(
                "homing",
                "warning",
                finding,
                "set a lower speed: the switch's edge is searched slowly",
                f"{key}.speed_zero",
            )
        if homing.speed_switch * homing.timeout < travel:
            finding = (
                f"{fast} covers {homing.speed_switch * homing.timeout:.3g} m in {homing.timeout:g} s, the travel is "
            )
            yield Check(
                "homing",
                "warning",
                f"{finding}{travel:.3g} m",
                "set a higher speed or a longer timeout",
                f"{key}.timeout",
            )
        distance = homing.speed_switch**2 / (2.0 * homing.acceleration)
        if distance > travel / 20.0 or homing.speed_switch / homing.acceleration < 1e-3:
            finding = (
                f"{key}.acceleration = {homing.acceleration:g} m/s²: it stops {distance * 1e3:.2g} mm past its switch"
            )
            yield Check("homing", "warning", finding, "check its unit", f"{key}.acceleration")


CONFIG_CHECKS = (
    ConfigCheck(
        (
            "watchdogs", "drives.missed_positions", "drives.heartbeat", "drives.stop_timeout", "drives.sdo_timeout",
            "limits.in_position.dwell", "telemetry.rotate_minutes", "loop.rate_hz",
        ),
        _times,
    ),
    ConfigCheck(("limits.in_position", "limits.slider", "correction.backlash", "loop.rate_hz"), _settling),
    ConfigCheck(("telemetry.rotate_mb", "telemetry.keep_mb"), _sizes),
    ConfigCheck(
        ("limits.slider", "drives.A.homing", "drives.B.homing", "drives.C.homing"),
        _homing,
    ),
)  # fmt: skip
