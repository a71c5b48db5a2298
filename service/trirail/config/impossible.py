"""What is well-formed in a configuration, but impossible."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from trirail_drivers.driver.requirements import Requirements, Rule, Window
from trirail_drivers.errors import DriveError, TrirailError

from trirail.config import as_built
from trirail.config.as_built import AsBuilt
from trirail.config.explained import Mistake, overlap
from trirail.config.network_checks import network_rules
from trirail.config.tables import BASE, PLATFORM, Config, Limits, corrected_geometry, geometry, room
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry, gains, singular_angles, travels
from trirail.wire.text import QUANTITY_RULE, is_quantity


def check_as_built(found: AsBuilt, robot: Geometry, limits: Limits) -> None:
    """Refuse a map that is not this robot's, or that could break a limit anywhere. Raises ConfigError."""
    platform, slider = limits.platform, limits.slider
    rates = platform.velocity, platform.acceleration, platform.jerk
    as_built.check(found, robot, room(limits), rates, (slider.velocities, slider.accelerations, slider.jerks))


_WINDOWS = (
    *((f"sliders[{i}]", "m") for i in range(3)),
    *((f"pose[{i}]", unit) for i, unit in enumerate(("m", "m", "rad"))),
)
"""The windows of [limits.in_position], each with its unit."""


def check(config: Config) -> None:
    """Refuse what is well-formed but impossible, at the first that is. Raises ConfigError."""
    for rule in rules(config):
        try:
            rule.check()
        except DriveError as error:
            raise ConfigError(str(error)) from error


def mistakes(config: Config, impossible: Sequence[str] = ()) -> tuple[list[Mistake], list[str]]:
    """Return all that is well-formed but impossible, and what was not looked at: what reads an `impossible` key.

    Files that are named are read.
    """
    from trirail_drivers.connection import settings_checks

    found: dict[str, Mistake] = {}
    left: dict[str, None] = {}
    wrong = list(impossible)
    for rule in itertools.chain(rules(config), settings_checks.files(config.drives)):
        if overlap((rule.key, *rule.reads), wrong):
            left[rule.key] = None
            continue
        try:
            rule.check()
        except TrirailError as error:
            found.setdefault(str(error), Mistake(rule.key, str(error)))
            if not rule.reads:  # wrong by itself, whatever else there is
                wrong.append(rule.key)
    return list(found.values()), list(left)


def rules(config: Config) -> Iterator[Rule]:
    """Yield every check of what is well-formed; a later one takes for granted what the earlier ones refuse."""
    from trirail_drivers.connection import settings_checks

    platform, slider = config.limits.platform, config.limits.slider
    ranges = {
        "limits.platform.x": platform.x,
        "limits.platform.y": platform.y,
        "limits.platform.phi": platform.phi,
        **dict(zip(slider.keys("position"), slider.positions, strict=True)),
        "limits.slider.passive": slider.passive,
    }
    for key, both in ranges.items():
        yield Rule(key, (), partial(_check_range, key, *both))
    yield Rule("geometry", (), partial(geometry, config.geometry))
    yield Rule("correction.map", ("geometry", "limits"), partial(_check_correction, config))
    reads = "limits.platform.x", "limits.platform.y", "limits.singularity_margin", "geometry", "correction"
    yield Rule("limits.platform.phi", reads, partial(_check_singular_angles, config))
    yield from network_rules(config)
    settling = "limits.in_position.timeout", ("limits.in_position.dwell",)
    yield Rule(*settling, partial(_check_settling, config))
    for name in config.frames.work:
        yield Rule(f"frames.work.{name}", (), partial(_check_frame, name))
    for name in config.poses:
        yield Rule(f"poses.{name}", ("geometry", "correction", *ranges), partial(_check_pose, config, name))
    yield Rule("loop.rate_hz", (), partial(_check_rate, config))
    yield from settings_checks.bus_rules(config.can)
    yield from settings_checks.rules(config.drives, _required(config))


def _check_range(key: str, low: float, high: float) -> None:
    if low >= high:
        raise ConfigError(f"{key} = [{low:g}, {high:g}]: the lower limit must be below the upper one")


def _check_singular_angles(config: Config) -> None:
    platform = config.limits.platform
    corrected = corrected_geometry(config)
    off = corrected.correction
    x, y, phi = np.zeros(3) if off is None else off.bound  # the legs are told places that far beyond
    (low, high), margin = (platform.phi[0] - phi, platform.phi[1] + phi), config.limits.singularity_margin
    # On a robot as built the singular angles move with the centre: linearly in x and y, so the corners bound them.
    beside = [(low - more, high + more) for (low, high), more in ((platform.x, x), (platform.y, y))]
    centres = [(0.0, 0.0), *itertools.product(*beside)]
    robot = geometry(config.geometry)
    singular = {angle for centre in centres for angle in singular_angles(robot, centre)}
    for angle in singular:
        if low - margin < angle < high + margin:
            least = max(angle for angle in (-math.pi, *singular) if angle <= 0.0) + margin + phi
            most = min(angle for angle in (math.pi, *singular) if angle > 0.0) - margin - phi
            # Both ends, over all corners, and rounded inwards: what is said is accepted.
            raise ConfigError(
                f"limits.platform.phi = [{platform.phi[0]:g}, {platform.phi[1]:g}] comes nearer than "
                f"limits.singularity_margin = {margin:g} to the singular angle {angle:.4f}: keep it within "
                f"[{math.ceil(least * 1e4 + 1e-6) * 1e-4:.4f}, {math.floor(most * 1e4 - 1e-6) * 1e-4:.4f}]"
            )


def _check_settling(config: Config) -> None:
    settling = config.limits.in_position
    if settling.timeout <= settling.dwell:
        raise ConfigError(
            f"limits.in_position.timeout = {settling.timeout:g}: it must be longer than the dwell, {settling.dwell:g} s"
        )


def _check_frame(name: str) -> None:
    if name in (BASE, PLATFORM):
        raise ConfigError(f"frames.work.{name}: every robot has a frame of that name; give this one another")


def _check_rate(config: Config) -> None:
    # The drives take the period as an integer times a power of ten of a second, object 60C2h.
    if 1_000_000 % config.loop.rate_hz:
        raise ConfigError(
            f"loop.rate_hz = {config.loop.rate_hz}: a cycle must be a whole number of microseconds, "
            "as with 100, 200, 250, 400, 500, 800, 1000"
        )


def _required(config: Config) -> Requirements:
    """Return what the robot asks of its drives; without the windows of a robot that is singular, or none."""
    slider = config.limits.slider
    simulated, starts = config.can.interface == "simulated", config.can.simulated.start
    places = [(*ends, at) if simulated else ends for ends, at in zip(slider.positions, starts, strict=True)]
    try:
        _check_singular_angles(config)
        windows = tuple(_windows(config))
    except ConfigError:
        windows = ()
    low, high = [*map(min, places)], [*map(max, places)]
    return Requirements(config.period, low, high, slider.velocities, slider.following_error, windows)


def _windows(config: Config) -> Iterator[Window]:
    platform, settling = config.limits.platform, config.limits.in_position
    corners = itertools.product(platform.x, platform.y, platform.phi)
    robot = geometry(config.geometry)
    most = np.abs([gains(robot, corner) for corner in corners]).max(axis=0).tolist()
    widths = zip((*np.eye(3).tolist(), *most), (*settling.sliders, *settling.pose), strict=True)
    for (key, unit), ((a, b, c), width) in zip(_WINDOWS, widths, strict=True):
        yield Window(f"limits.in_position.{key}", width, unit, (a, b, c))


def _check_correction(config: Config) -> None:
    """Refuse a map that is not this robot's, or that the limits have no room for."""
    told = config.correction
    if told.as_built is None:
        if told.map is not None:
            raise ConfigError(f"correction.map = {told.map!r}: a file, which only a configuration in a file can name")
        return
    try:
        check_as_built(told.as_built, geometry(config.geometry), config.limits)
    except ConfigError as error:
        raise ConfigError(f"correction.map: {told.map or 'as_built'}: {error}") from error


def _check_pose(config: Config, name: str) -> None:
    """Refuse a named pose at which the robot cannot be."""
    platform, slider, pose = config.limits.platform, config.limits.slider, config.poses[name]
    if is_quantity(name):
        raise ConfigError(f"poses.{name}: {name} {QUANTITY_RULE}")
    places = [
        (key, at, f"limits.platform.{key}", getattr(platform, key))
        for key, at in zip(("x", "y", "phi"), pose, strict=True)
    ]
    robot = corrected_geometry(config)
    position, passive = travels(robot, pose).tolist()
    places += [
        (f"slider {label}", at, key, ends)
        for label, at, key, ends in zip(robot.labels, position, slider.keys("position"), slider.positions, strict=True)
    ]
    places += [
        (f"cross slide {label}", at, "limits.slider.passive", slider.passive)
        for label, at in zip(robot.labels, passive, strict=True)
    ]
    for what, at, key, (low, high) in places:
        if not low <= at <= high:
            numbers = ", ".join(f"{value:g}" for value in pose)
            raise ConfigError(
                f"poses.{name} = [{numbers}]: {what} would be {at:.6g}, outside of {key} = [{low:g}, {high:g}]"
            )
