"""Checks for limits that contradict each other or the robot.

The results are warnings, because each limit alone may be intended.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from trirail_drivers.interface import Triple

from trirail.config import Config, SliderLimits, geometry, room
from trirail.diagnosis.check import Check, ConfigCheck, format_value, is_simulated
from trirail.diagnosis.drive_checks import plan_traffic
from trirail.kinematics.geometry import gains, travels
from trirail.quantities import FAMILIAR_UNITS

RAMP_TIMES_S = 1e-3, 10.0
"""Shortest and longest plausible time to reach a velocity or acceleration limit [s]."""
MAX_ASYMMETRY = 300.0
"""Greatest plausible ratio between the two sides of a range."""
MAX_RATE_MISMATCH = 30.0
"""Greatest plausible ratio between a slider's limit and the rate that the platform's limits require, or vice versa."""
MAX_RATE_EXCESS = 5.0
"""Greatest plausible ratio between a platform limit and the rate that the sliders reach.

The ratio is 0.7 for the shipped robots."""
MIN_REACHED_SHARE = 0.1
"""Smallest plausible fraction of the platform's limits that the sliders reach."""
MAX_WINDOW_SHARE = 0.02
"""Greatest plausible in-position window, as a fraction of the axis' range."""
_SAMPLES = 15
"""Number of samples of the platform's limits along each axis."""
_ORDERS = (("velocity", "acceleration", "", "/s"), ("acceleration", "jerk", "/s²", "/s³"))
_AXES = (("x", "m"), ("y", "m"), ("phi", "rad"))


def _each(slider: SliderLimits, quantity: str) -> Triple:
    """Return the velocity, acceleration or jerk limit of each slider."""
    return {"velocity": slider.velocities, "acceleration": slider.accelerations, "jerk": slider.jerks}[quantity]


def _ramps(config: Config) -> Iterator[Check]:
    """Check the times in which velocity and acceleration reach their limits."""
    slider, platform = config.limits.slider, config.limits.platform
    for rate, by, _, _ in _ORDERS:
        sliders = list(zip(_each(slider, rate), _each(slider, by), strict=True))
        alike = len(set(sliders)) == 1
        tables: list[tuple[str, float, float]] = [
            *dict.fromkeys(
                ("limits.slider" if alike else f"limits.slider {label}", *each)
                for label, each in zip(config.geometry.labels, sliders, strict=True)
            ),
            *(
                (f"limits.platform {axis}", getattr(platform, rate)[k], getattr(platform, by)[k])
                for k, (axis, _) in enumerate(_AXES)
            ),
        ]
        for name, limit, slope in tables:
            time = limit / slope
            if not RAMP_TIMES_S[0] <= time <= RAMP_TIMES_S[1]:
                finding = f"{name}: {rate} {limit:g} is reached in {time:.2g} s by {by} {slope:g}"
                table = name.partition(" ")[0]
                remedy = f"one of the two is in another unit or off by a power of ten; use SI units in {table}"
                yield Check("limits", "warning", finding, remedy, f"{table}.{rate}")


def _ranges(config: Config) -> Iterator[Check]:
    """Check that each range contains 0, and that its two sides have a plausible ratio."""
    platform, slider = config.limits.platform, config.limits.slider
    ranges = {f"limits.platform.{axis}": getattr(platform, axis) for axis, _ in _AXES}
    ranges |= dict(zip(slider.keys("position"), slider.positions, strict=True))
    ranges["limits.slider.passive"] = slider.passive
    for key, (low, high) in ranges.items():
        small, large = sorted((abs(low), abs(high)))
        name = f"{key} = [{low:g}, {high:g}]"
        if small and large > MAX_ASYMMETRY * small:
            finding = f"{name}: one side is {large / small:.3g} times the other"
            yield Check("limits", "warning", finding, "use metres and radians: is one of them in mm?", key)
        if config.geometry.l0 is not None and not low <= 0.0 <= high:
            finding = f"{name} excludes 0, the platform's position with all sliders at 0"
            yield Check("limits", "warning", finding, "is a sign wrong? the robot starts outside its limits", key)


def _reached(config: Config) -> Iterator[Check]:
    """Check that the sliders and passive joints can reach a sufficient part of the platform's limits."""
    platform = config.limits.platform
    axes = [np.linspace(*each, _SAMPLES) for each in (platform.x, platform.y, platform.phi)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    share = float(room(config.limits).holds(travels(geometry(config.geometry), poses)).mean())
    if share < MIN_REACHED_SHARE:
        finding = f"the sliders reach {share:.1%} of limits.platform"
        remedy = "correct limits.platform, limits.slider or geometry; trirail workspace shows the reach"
        yield Check("reach", "warning", finding, remedy, "limits.platform")
    else:
        yield Check("reach", "ok", f"the sliders reach {share:.0%} of limits.platform")


def _rates(config: Config) -> Iterator[Check]:
    """Compare the sliders' velocity, acceleration and jerk limits with the rates that the platform's limits require."""
    platform, slider = config.limits.platform, config.limits.slider
    middle = [sum(each) / 2.0 for each in (platform.x, platform.y, platform.phi)]
    try:
        per_pose = np.abs(np.linalg.inv(gains(geometry(config.geometry), (middle[0], middle[1], middle[2]))))
    except np.linalg.LinAlgError:
        return
    for quantity in ("velocity", "acceleration", "jerk"):
        yield from _too_fast(config, per_pose, quantity)
        every = (per_pose @ np.array(getattr(platform, quantity))).tolist()
        limits, keys = _each(slider, quantity), slider.keys(quantity)
        needed = every if len(set(keys)) > 1 else [max(every)] * 3
        for key, limit, need in dict.fromkeys(zip(keys, limits, needed, strict=True)):
            if not 1.0 / MAX_RATE_MISMATCH < limit / need < MAX_RATE_MISMATCH:
                finding = f"{format_value(key, limit)}, but limits.platform.{quantity} needs {need:.3g}"
                yield Check("limits", "warning", finding, "correct the one in another unit", key)


def _too_fast(config: Config, per_pose: NDArray[np.float64], quantity: str) -> Iterator[Check]:
    """Find platform limits that greatly exceed the rates that the sliders reach.

    Such limits may have been written in mm or degrees.
    """
    limits = getattr(config.limits.platform, quantity)
    shares = (per_pose * limits / np.array(_each(config.limits.slider, quantity))[:, None]).max(axis=0).tolist()
    per = dict(zip(("velocity", "acceleration", "jerk"), ("/s", "/s²", "/s³"), strict=True))[quantity]
    for k, ((axis, unit), limit, share) in enumerate(zip(_AXES, limits, shares, strict=True)):
        if share > MAX_RATE_EXCESS:
            key = f"limits.platform.{quantity}[{k}]"
            finding = f"{format_value(key, limit, unit + per)}: {share:.3g} times what the sliders reach along {axis}"
            size = FAMILIAR_UNITS[unit][0]
            yield Check("limits", "warning", finding, f"did you mean {limit * size:.3g} {unit}{per}?", key)


def _windows(config: Config) -> Iterator[Check]:
    """Check the following-error and in-position windows.

    A following-error window must exceed the motion in a cycle, and all windows must be much smaller than the travel.
    """
    slider, drives, settling = config.limits.slider, config.drives, config.limits.in_position
    step, travel = slider.fastest * config.period, min(high - low for low, high in slider.positions)
    for key, window in (
        ("limits.slider.following_error", slider.following_error),
        ("drives.following_error", drives.following_error),
    ):
        if window < step:
            finding = (
                f"{format_value(key, window, 'm')}: a slider moves {step:.3g} m per cycle at limits.slider.velocity"
            )
            yield Check("limits", "warning", finding, f"set more than {step:.3g}: normal motion would be a fault", key)
        if window > travel / 10.0:
            finding = f"{format_value(key, window, 'm')}: over a tenth of the travel, {travel:.3g} m"
            yield Check("limits", "warning", finding, "set less: it would hardly detect a stuck slider", key)
    corners = list(itertools.product(*(getattr(config.limits.platform, axis) for axis, _ in _AXES)))
    pose_gains = np.abs([gains(geometry(config.geometry), corner) for corner in corners]).max(axis=0).sum(axis=1)
    ranges = [*slider.positions] + [getattr(config.limits.platform, axis) for axis, _ in _AXES]
    errors = [slider.following_error] * 3 + (pose_gains * slider.following_error).tolist()
    widest = [min(error, MAX_WINDOW_SHARE * (high - low)) for error, (low, high) in zip(errors, ranges, strict=True)]
    for i, (window, wide) in enumerate(zip((*settling.sliders, *settling.pose), widest, strict=True)):
        key = f"limits.in_position.{('sliders', 'pose')[i // 3]}[{i % 3}]"
        if window > wide:
            finding = f"{format_value(key, window)}: too wide, every goal would be done before it has settled"
            yield Check("limits", "warning", finding, f"at most {wide:.2g}", key)


def _simulated(config: Config) -> Iterator[Check]:
    """Check that simulated servos can follow the setpoints.

    The lag of a servo is the motion during its time constant that feed-forward does not compensate, plus the motion in
    a cycle. Without velocity offset, there is no feed-forward.
    """
    if not is_simulated(config.can):
        return
    slider, servo = config.limits.slider, config.can.simulated
    offset = plan_traffic(config).velocity_offset
    gain = servo.feed_forward_gain if offset else 0.0
    lag = slider.fastest * (abs(1.0 - gain) * servo.time_constant + config.period)
    if lag > slider.following_error:
        finding = f"simulated servos lag {lag * 1e3:.3g} mm at limits.slider.velocity, beyond its following_error"
        remedy = "set a shorter time_constant, or a feed_forward_gain nearer to 1"
        if not offset:
            remedy = 'set a shorter time_constant, or drives.velocity_offset = "always"'
        yield Check("simulated", "warning", finding, remedy, "can.simulated.time_constant")
    for key, maximum, limit in (
        ("max_velocity", servo.max_velocity, slider.fastest),
        ("max_acceleration", servo.max_acceleration, max(slider.accelerations)),
    ):
        if maximum < limit:
            finding = f"{format_value(f'can.simulated.{key}', maximum)} is less than the sliders' limit, {limit:g}"
            yield Check("simulated", "warning", finding, "set more: the servos cannot follow", f"can.simulated.{key}")


_RATES = tuple(f"limits.{of}.{rate}" for of in ("slider", "platform") for rate in ("velocity", "acceleration", "jerk"))
_POSES = "limits.platform.x", "limits.platform.y", "limits.platform.phi", "limits.singularity_margin", "geometry"
_TRAVEL = "limits.slider.position", "limits.slider.passive"
_WINDOWS = "limits.slider.following_error", "drives.following_error", "limits.in_position"
CONFIG_CHECKS = (
    ConfigCheck(_RATES, _ramps),
    ConfigCheck((*_POSES, *_TRAVEL), _ranges),
    ConfigCheck((*_POSES, *_TRAVEL), _reached),
    ConfigCheck((*_RATES, *_POSES), _rates),
    ConfigCheck((*_POSES, *_WINDOWS, "limits.slider.velocity", "limits.slider.position", "loop.rate_hz"), _windows),
    ConfigCheck(("limits.slider", "can", "loop.rate_hz", "drives"), _simulated),
)
