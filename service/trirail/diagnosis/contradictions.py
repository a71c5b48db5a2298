"""Limits that contradict each other, or the robot: none is refused, for each alone might be meant."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from trirail_drivers.interface import Triple

from trirail.config import Config, SliderLimits, geometry, room
from trirail.diagnosis.check import Check, Judgement, is_simulated, value
from trirail.kinematics.geometry import gains, travels

RAMP = 1e-3, 10.0
"""Between these is what any slider takes to its limit of velocity, or of acceleration [s]."""
LOPSIDED = 300.0
"""The two sides of a range differ by less, if both are meant."""
OUT_OF_STEP = 30.0
"""The sliders' rates differ by less from those that the platform's limits ask of them, if both are meant."""
REACHED = 0.1
"""Least share of the platform's limits that the sliders reach."""
COARSE = 0.02
"""Greatest share of a range that is a window to settle in."""
_PLACES = 15
"""Where that is looked at, along each axis."""
_ORDERS = (("velocity", "acceleration", "", "/s"), ("acceleration", "jerk", "/s²", "/s³"))
_AXES = (("x", "m"), ("y", "m"), ("phi", "rad"))


def _each(slider: SliderLimits, quantity: str) -> Triple:
    """Return a limit of each slider by its key for all."""
    return {"velocity": slider.velocities, "acceleration": slider.accelerations, "jerk": slider.jerks}[quantity]


def _ramps(config: Config) -> Iterator[Check]:
    """Nothing reaches its velocity within a millisecond, or takes ten seconds; so for acceleration."""
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
        for name, reached, slope in tables:
            time = reached / slope
            if not RAMP[0] <= time <= RAMP[1]:
                said = f"{name}: {rate} {reached:g} is reached in {time:.2g} s by {by} {slope:g}"
                table = name.partition(" ")[0]
                remedy = f"one of the two is another unit's, or has a factor of ten too many: SI units, {table}"
                yield Check("limits", "warning", said, remedy, f"{table}.{rate}")


def _ranges(config: Config) -> Iterator[Check]:
    platform, slider = config.limits.platform, config.limits.slider
    ranges = {f"limits.platform.{axis}": getattr(platform, axis) for axis, _ in _AXES}
    ranges |= dict(zip(slider.keys("position"), slider.positions, strict=True))
    ranges["limits.slider.passive"] = slider.passive
    for key, (low, high) in ranges.items():
        small, large = sorted((abs(low), abs(high)))
        said = f"{key} = [{low:g}, {high:g}]"
        if small and large > LOPSIDED * small:
            found = f"{said}: one side is {large / small:.3g} times the other"
            yield Check("limits", "warning", found, "metres and radians: is one of them in mm?", key)
        if config.geometry.l0 is not None and not low <= 0.0 <= high:
            found = f"{said} leaves out 0, where all sliders at 0 have the platform"
            yield Check("limits", "warning", found, "is a sign wrong? enable the robot within its limits", key)


def _reached(config: Config) -> Iterator[Check]:
    """Of the platform's limits sliders and passive joints reach a good part, or one of them is wrong."""
    platform = config.limits.platform
    axes = [np.linspace(*each, _PLACES) for each in (platform.x, platform.y, platform.phi)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    share = float(room(config.limits).holds(travels(geometry(config.geometry), poses)).mean())
    if share < REACHED:
        found = f"the sliders reach {share:.1%} of limits.platform"
        remedy = "trirail workspace shows where: limits.platform, limits.slider or geometry is wrong"
        yield Check("reach", "warning", found, remedy, "limits.platform")
    else:
        yield Check("reach", "ok", f"the sliders reach {share:.0%} of limits.platform")


def _rates(config: Config) -> Iterator[Check]:
    """The sliders' limits of velocity, acceleration and jerk are of the size that the platform's ask of them."""
    platform, slider = config.limits.platform, config.limits.slider
    middle = [sum(each) / 2.0 for each in (platform.x, platform.y, platform.phi)]
    try:
        per_pose = np.abs(np.linalg.inv(gains(geometry(config.geometry), (middle[0], middle[1], middle[2]))))
    except np.linalg.LinAlgError:
        return
    for quantity in ("velocity", "acceleration", "jerk"):
        every = (per_pose @ np.array(getattr(platform, quantity))).tolist()
        limits, keys = _each(slider, quantity), slider.keys(quantity)
        asked = every if len(set(keys)) > 1 else [max(every)] * 3
        for key, limit, most in dict.fromkeys(zip(keys, limits, asked, strict=True)):
            if not 1.0 / OUT_OF_STEP < limit / most < OUT_OF_STEP:
                found = f"{value(key, limit)}, and limits.platform.{quantity} asks for {most:.3g}"
                yield Check("limits", "warning", found, "one of them cannot be used", key)


def _windows(config: Config) -> Iterator[Check]:
    """A robot that is in position, or in error, is so by windows that lie between a cycle's way and the travel."""
    slider, drives, settling = config.limits.slider, config.drives, config.limits.in_position
    way, travel = slider.fastest * config.period, min(high - low for low, high in slider.positions)
    for key, window in (
        ("limits.slider.following_error", slider.following_error),
        ("drives.following_error", drives.following_error),
    ):
        if window < way:
            found = f"{value(key, window, 'm')}, and a slider goes {way:.3g} m in a cycle at limits.slider.velocity"
            yield Check("limits", "warning", found, f"motion alone would be a fault: beyond {way:.3g}", key)
        if window > travel / 10.0:
            found = f"{value(key, window, 'm')}, of a travel of {travel:.3g} m"
            yield Check("limits", "warning", found, "a slider that is stuck would hardly be noticed", key)
    corners = list(itertools.product(*(getattr(config.limits.platform, axis) for axis, _ in _AXES)))
    most = np.abs([gains(geometry(config.geometry), corner) for corner in corners]).max(axis=0).sum(axis=1)
    ranges = [*slider.positions] + [getattr(config.limits.platform, axis) for axis, _ in _AXES]
    errors = [slider.following_error] * 3 + (most * slider.following_error).tolist()
    widest = [min(error, COARSE * (high - low)) for error, (low, high) in zip(errors, ranges, strict=True)]
    for i, (window, wide) in enumerate(zip((*settling.sliders, *settling.pose), widest, strict=True)):
        key = f"limits.in_position.{('sliders', 'pose')[i // 3]}[{i % 3}]"
        if window > wide:
            found = f"{value(key, window)} is no window to settle in: every goal would be done at once"
            yield Check("limits", "warning", found, f"at most {wide:.2g}", key)


def _simulated(config: Config) -> Iterator[Check]:
    """Simulated servos that cannot follow: their lag is what feed-forward leaves, for a time constant."""
    if not is_simulated(config.can):
        return
    slider, servo = config.limits.slider, config.can.simulated
    lag = slider.fastest * (abs(1.0 - servo.feed_forward_gain) * servo.time_constant + config.period)
    if lag > slider.following_error:
        found = f"simulated servos lag {lag * 1e3:.3g} mm behind at limits.slider.velocity, beyond its following_error"
        remedy = "a shorter time_constant, or a feed_forward_gain nearer to 1"
        yield Check("simulated", "warning", found, remedy, "can.simulated.time_constant")
    for key, most, limit in (
        ("max_velocity", servo.max_velocity, slider.fastest),
        ("max_acceleration", servo.max_acceleration, max(slider.accelerations)),
    ):
        if most < limit:
            found = f"{value(f'can.simulated.{key}', most)} is less than the sliders' limit, {limit:g}"
            yield Check("simulated", "warning", found, "they cannot follow", f"can.simulated.{key}")


_RATES = tuple(f"limits.{of}.{rate}" for of in ("slider", "platform") for rate in ("velocity", "acceleration", "jerk"))
_POSES = "limits.platform.x", "limits.platform.y", "limits.platform.phi", "limits.singularity_margin", "geometry"
_TRAVEL = "limits.slider.position", "limits.slider.passive"
_WINDOWS = "limits.slider.following_error", "drives.following_error", "limits.in_position"
JUDGEMENTS = (
    Judgement(_RATES, _ramps),
    Judgement((*_POSES, *_TRAVEL), _ranges),
    Judgement((*_POSES, *_TRAVEL), _reached),
    Judgement((*_RATES, *_POSES), _rates),
    Judgement((*_POSES, *_WINDOWS, "limits.slider.velocity", "limits.slider.position", "loop.rate_hz"), _windows),
    Judgement(("limits.slider", "can", "loop.rate_hz"), _simulated),
)
