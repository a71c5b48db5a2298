"""Checks for values of a configuration that are well-formed but impossible."""

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
from trirail.config.digital import digital_rules, named_io
from trirail.config.explained import Mistake, overlap
from trirail.config.network_checks import network_rules
from trirail.config.tables import BASE, PLATFORM, Config, Limits, Range, corrected_geometry, geometry, room
from trirail.errors import ConfigError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import Geometry, det_j2, gains, singular_angles, travels
from trirail.kinematics.slices import clip, joint_rows
from trirail.naming import BLACK_BOX
from trirail.quantities import FAMILIAR_UNITS, as_familiar_unit
from trirail.wire.text import QUANTITY_RULE, is_quantity


def check_as_built(errors: AsBuilt, robot: Geometry, limits: Limits) -> None:
    """Raise ConfigError if a map belongs to another robot or could cause a limit to be exceeded anywhere."""
    platform, slider = limits.platform, limits.slider
    rates = platform.velocity, platform.acceleration, platform.jerk
    as_built.check(errors, robot, room(limits), rates, (slider.velocities, slider.accelerations, slider.jerks))


MAX_RANGE_SIZES = 10.0
"""Largest plausible value of a range, in multiples of the robot's size."""
MM = FAMILIAR_UNITS["m"][0]
ROUNDING = 1e-9
"""Distance by which a pose may exceed a limit because of rounding [m, rad], as in plans (motion.paths.ROUNDING)."""
PHI_INTERVALS = 64
"""Number of intervals of phi in which a permitted pose is searched. Each of them is bisected if necessary."""
MIN_PHI_INTERVAL = 1e-6
"""Width at which an interval of phi is no longer bisected [rad]."""
_WINDOWS = (
    *((f"sliders[{i}]", "m") for i in range(3)),
    *((f"pose[{i}]", unit) for i, unit in enumerate(("m", "m", "rad"))),
)
"""Keys of the windows in [limits.in_position], each with its unit."""


def check(config: Config) -> None:
    """Raise ConfigError for the first impossible value."""
    for rule in rules(config):
        try:
            rule.check()
        except DriveError as error:
            raise ConfigError(str(error)) from error


def mistakes(config: Config, impossible: Sequence[str] = ()) -> tuple[list[Mistake], list[str]]:
    """Return all mistakes, and the keys that were not checked because their checks depend on an `impossible` key.

    The checks read the files that the configuration names.
    """
    from trirail_drivers.connection import settings_checks

    by_text: dict[str, Mistake] = {}
    unchecked: dict[str, None] = {}
    wrong = list(impossible)
    for rule in itertools.chain(rules(config), settings_checks.files(config.drives)):
        if overlap((rule.key, *rule.reads), wrong):
            unchecked[rule.key] = None
            continue
        try:
            rule.check()
        except TrirailError as error:
            by_text.setdefault(str(error), Mistake(rule.key, str(error)))
            if not rule.reads:  # wrong regardless of the other keys
                wrong.append(rule.key)
    return list(by_text.values()), list(unchecked)


def rules(config: Config) -> Iterator[Rule]:
    """Yield all checks in order; each check assumes that the previous ones have passed."""
    from trirail_drivers.connection import settings_checks

    platform, slider = config.limits.platform, config.limits.slider
    ranges = {
        "limits.platform.x": platform.x,
        "limits.platform.y": platform.y,
        "limits.platform.phi": platform.phi,
        **dict(zip(slider.keys("position"), slider.positions, strict=True)),
        "limits.slider.passive": slider.passive,
    }
    yield Rule("robot.name", (), partial(_check_name, config))
    for key, both in ranges.items():
        yield Rule(key, (), partial(_check_range, key, *both))
    yield Rule("geometry", (), partial(geometry, config.geometry))
    for key, both in ranges.items():
        if key != "limits.platform.phi":
            yield Rule(key, ("geometry",), partial(_check_metres, config, key, *both))
    yield Rule("correction.map", ("geometry", "limits", "correction.as_built"), partial(_check_correction, config))
    yield Rule("correction.backlash", ("limits.slider.position",), partial(_check_backlash, config))
    reads = "limits.platform.x", "limits.platform.y", "limits.singularity_margin", "geometry", "correction"
    yield Rule("limits.platform.phi", reads, partial(_check_singular_angles, config))
    yield Rule("limits", ("geometry", "correction"), partial(_check_some_pose, config))
    yield from network_rules(config)
    settling = "limits.in_position.timeout", ("limits.in_position.dwell",)
    yield Rule(*settling, partial(_check_settling, config))
    for name in config.frames.work:
        yield Rule(f"frames.work.{name}", (), partial(_check_frame, name))
    for name in config.poses:
        yield Rule(f"poses.{name}", ("geometry", "correction", *ranges), partial(_check_pose, config, name))
    yield from settings_checks.io_rules(config.drives.protocol, named_io(config.outputs, config.inputs))
    yield from digital_rules(config.outputs, config.inputs)
    yield Rule("loop.rate_hz", (), partial(_check_rate, config))
    yield from settings_checks.bus_rules(config.can, config.drives.protocol)
    yield from settings_checks.rules(config.drives, _required(config))


def _check_name(config: Config) -> None:
    if config.robot.name == BLACK_BOX:
        raise ConfigError(f'robot.name = "{BLACK_BOX}": recordings of a fault have this name; choose another')


def _check_range(key: str, low: float, high: float) -> None:
    if low >= high:
        raise ConfigError(f"{key} = [{low:g}, {high:g}]: the lower limit must be below the upper one")


def _check_metres(config: Config, key: str, low: float, high: float) -> None:
    """Refuse a range that is far larger than the robot but would be plausible in millimetres."""
    size = _size(config)
    widest = max(low, high, key=abs)
    if abs(widest) > MAX_RANGE_SIZES * size and as_familiar_unit(widest, MAX_RANGE_SIZES * size, "m") is not None:
        raise ConfigError(
            f"{key} = [{low:g}, {high:g}]: {abs(widest):g} m on a robot of {size:g} m; "
            f"did you mean [{low * MM:g}, {high * MM:g}]? Lengths are in metres"
        )


def _size(config: Config) -> float:
    """Return the greatest distance of any part of the robot from the origin of its frame [m]."""
    legs = config.geometry.leg or ()
    points = [point for leg in legs for point in (leg.anchor, leg.edge_point, leg.pivot) if point is not None]
    homes = [leg.home for leg in legs]
    return max([config.geometry.l0 or 0.0, *map(abs, itertools.chain(*points, homes))])


def _check_singular_angles(config: Config) -> None:
    """Refuse a range of phi that is not between the nearest singular angles below and above zero, for any centre.

    For each position of the sliders there are two poses, with a singular angle between them. The measured pose is the
    one on the same side as the pose (0, 0, 0). If the platform stood on the other side, it would be wrong.

    At a fixed phi, det J2 is linear in x and y. If its sign at every corner of their ranges is the sign at (0, 0, 0),
    at phi = 0 and without a singular angle up to the limits of phi, it is the same at every permitted pose.
    """
    platform = config.limits.platform
    corrected = corrected_geometry(config)
    errors = corrected.correction
    x, y, phi = np.zeros(3) if errors is None else errors.bound  # the legs receive poses this far beyond the limits
    margin = config.limits.singularity_margin
    low, high = platform.phi[0] - phi - margin, platform.phi[1] + phi + margin
    beside = [(low - more, high + more) for (low, high), more in ((platform.x, x), (platform.y, y))]
    centres = [(0.0, 0.0), *itertools.product(*beside)]
    robot = geometry(config.geometry)
    determinants = [float(det_j2(robot, centre, np.zeros(1))[0]) for centre in centres]
    for corner, determinant in zip(centres, determinants, strict=True):
        if determinant * determinants[0] <= 0.0:
            raise ConfigError(
                f"limits.platform.x = [{platform.x[0]:g}, {platform.x[1]:g}] and "
                f"limits.platform.y = [{platform.y[0]:g}, {platform.y[1]:g}] extend beyond a singular pose at phi = 0, "
                f"between (0, 0) and ({corner[0]:g}, {corner[1]:g}); narrow them, or correct the geometry"
            )
    singular = {
        angle + turn
        for centre in centres
        for angle in singular_angles(robot, centre)
        for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi)
    }
    below = max((angle for angle in singular if angle <= 0.0), default=-math.inf)
    above = min((angle for angle in singular if angle > 0.0), default=math.inf)
    if below <= low and high <= above:
        return
    # Both ends, over all corners, and rounded inwards: the range in the message is itself accepted.
    lowest, highest = max(below, -math.pi) + margin + phi, min(above, math.pi) - margin - phi
    first, last = math.ceil(lowest * 1e4 + 1e-6) * 1e-4, math.floor(highest * 1e4 - 1e-6) * 1e-4
    remedy = f"keep it within [{first:.4f}, {last:.4f}]"
    key = f"limits.platform.phi = [{platform.phi[0]:g}, {platform.phi[1]:g}]"
    for angle in (below, above):
        if low < angle < high:
            raise ConfigError(
                f"{key} is closer than limits.singularity_margin = {margin:g} to the singular angle {angle:.4f}; "
                f"{remedy}"
            )
    beyond_angle = above if low >= above else below
    raise ConfigError(
        f"{key} is beyond the singular angle {beyond_angle:.4f}, where the pose cannot be computed from the sliders; "
        f"{remedy}"
    )


def _check_some_pose(config: Config) -> None:
    """Refuse limits within which there is no pose.

    The pose (0, 0, 0) need not be permitted. The pose nearest to it within limits.platform is tried first.
    """
    robot, box = corrected_geometry(config), room(config.limits)
    low, high = np.array(box.low), np.array(box.high)
    nearest = np.clip(0.0, low, high).tolist()
    joints = _joints(config, nearest)
    excess, joint, key, ends = max(
        (max(ends[0] - at, at - ends[1]), joint, key, ends) for joint, at, key, ends in joints
    )
    if excess <= ROUNDING:
        return
    _check_singular_angles(config)  # beyond a singular angle, the positions of the joints need not be finite
    if robot.correction is not None:
        low, high = low - robot.correction.bound, high + robot.correction.bound
    (left, bottom, first), (right, top, last) = low.tolist(), high.tolist()
    centres = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    angles = np.linspace(first, last, PHI_INTERVALS + 1).tolist()
    if any(_has_pose(config, centres, *both) for both in itertools.pairwise(angles)):
        return
    (x, y, phi), (least, most) = nearest, ends
    raise ConfigError(
        f"limits: no pose is within all of them; at x = {x:g}, y = {y:g}, phi = {phi:g}, "
        f"{joint} is outside {key} = [{least:g}, {most:g}] by {excess:.3g} m; correct [geometry] or [limits]"
    )


def _has_pose(config: Config, centres: Array, low: float, high: float) -> bool:
    """Return whether a pose with its centre in a polygon (V, 2) [m] and phi between two angles is within the travels.

    The interval is bisected, except if its middle has such a pose, or if it has none even with travels that are longer
    by the distance by which each joint moves between the middle and an end of the interval. An interval that is still
    undecided when it is narrower than MIN_PHI_INTERVAL counts as one with a pose.
    """
    robot, slider, middle = geometry(config.geometry), config.limits.slider, (low + high) / 2.0
    rows = joint_rows(robot, middle)
    joints = np.concatenate(
        travels(robot, [[(*centre, phi) for centre in centres] for phi in (middle, low, high)]), axis=-1
    )
    moved = np.abs(joints[1:] - joints[0]).max(axis=(0, 1))
    least, most = np.transpose([*slider.positions, *[slider.passive] * 3])
    unit = np.array([1.0, 0.0, 0.0])

    def slice_at_middle(longer: Array) -> Array:
        inside = rows - np.outer(least - longer, unit), np.outer(most + longer, unit) - rows
        return clip(centres, np.concatenate(inside))

    if not len(slice_at_middle(moved + ROUNDING)):
        return False
    return (
        high - low < MIN_PHI_INTERVAL
        or len(slice_at_middle(np.full(6, ROUNDING))) > 0
        or _has_pose(config, centres, low, middle)
        or _has_pose(config, centres, middle, high)
    )


def _check_settling(config: Config) -> None:
    settling = config.limits.in_position
    if settling.timeout <= settling.dwell:
        raise ConfigError(
            f"limits.in_position.timeout = {settling.timeout:g}: it must be longer than the dwell, {settling.dwell:g} s"
        )


def _check_frame(name: str) -> None:
    if name in (BASE, PLATFORM):
        raise ConfigError(f"frames.work.{name}: the name is reserved for the robot's own frame; use another name")


def _check_rate(config: Config) -> None:
    # The drives take the period as an integer times a power of ten of a second, object 60C2h.
    if 1_000_000 % config.loop.rate_hz:
        raise ConfigError(
            f"loop.rate_hz = {config.loop.rate_hz}: a cycle must be a whole number of microseconds, "
            "for example 100, 200, 250, 400, 500, 800 or 1000"
        )


def _required(config: Config) -> Requirements:
    """Return what the robot requires of its drives, without in-position windows if its geometry is singular."""
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
    largest = np.abs([gains(robot, corner) for corner in corners]).max(axis=0).tolist()
    widths = zip((*np.eye(3).tolist(), *largest), (*settling.sliders, *settling.pose), strict=True)
    for (key, unit), ((a, b, c), width) in zip(_WINDOWS, widths, strict=True):
        yield Window(f"limits.in_position.{key}", width, unit, (a, b, c))


def _check_correction(config: Config) -> None:
    """Refuse a map that belongs to another robot or could cause a limit to be exceeded."""
    table = config.correction
    if table.as_built is None:
        if table.map is not None:
            raise ConfigError(
                f"correction.map = {table.map!r}: only a configuration that is read from a file can name a map"
            )
        return
    try:
        check_as_built(table.as_built, geometry(config.geometry), config.limits)
    except ConfigError as error:
        raise ConfigError(f"correction.map: {table.map or 'as_built'}: {error}") from error


def _check_backlash(config: Config) -> None:
    """Refuse backlash that leaves no travel. Plans keep half of the widest backlash free at each end of the travel."""
    slider, widest = config.limits.slider, max(config.correction.backlash)
    for key, (low, high) in zip(slider.keys("position"), slider.positions, strict=True):
        if widest >= high - low:
            raise ConfigError(
                f"correction.backlash = {[*config.correction.backlash]}: {widest:g} m leaves no travel of {key} = "
                f"[{low:g}, {high:g}]; measure the backlash again, or widen the travel"
            )


def _check_pose(config: Config, name: str) -> None:
    """Refuse a named pose that is outside the limits, or closer to the end of a slider's travel than a plan may be."""
    platform, pose = config.limits.platform, config.poses[name]
    reserve = max(config.correction.backlash) / 2.0
    if is_quantity(name):
        raise ConfigError(f"poses.{name}: {name} {QUANTITY_RULE}")
    places = [
        (key, at, f"limits.platform.{key}", getattr(platform, key))
        for key, at in zip(("x", "y", "phi"), pose, strict=True)
    ]
    for coordinate, at, key, (low, high) in places + _joints(config, pose):
        numbers = ", ".join(f"{value:g}" for value in pose)
        if not low - ROUNDING <= at <= high + ROUNDING:
            raise ConfigError(
                f"poses.{name} = [{numbers}]: {coordinate} would be {at:.6g}, outside {key} = [{low:g}, {high:g}]"
            )
        less = reserve if coordinate.startswith("slider") else 0.0
        if not low + less - ROUNDING <= at <= high - less + ROUNDING:
            raise ConfigError(
                f"poses.{name} = [{numbers}]: {coordinate} would be {at:.6g}, closer than {less:g} m to an end of "
                f"{key} = [{low:g}, {high:g}]; half of the widest correction.backlash is kept free there"
            )


def _joints(config: Config, pose: Sequence[float]) -> list[tuple[str, float, str, Range]]:
    """Return the name of each slider and cross slide, its position at a pose, and key and ends of its travel [m]."""
    robot, slider = corrected_geometry(config), config.limits.slider
    position, passive = travels(robot, pose).tolist()
    keys = zip(robot.labels, position, slider.keys("position"), slider.positions, strict=True)
    return [
        *((f"slider {label}", at, key, ends) for label, at, key, ends in keys),
        *(
            (f"cross slide {label}", at, "limits.slider.passive", slider.passive)
            for label, at in zip(robot.labels, passive, strict=True)
        ),
    ]
