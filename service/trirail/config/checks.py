"""What is well-formed in a configuration, but impossible."""

from __future__ import annotations

import ipaddress
import itertools
import math

import numpy as np
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES

from trirail.config import as_built
from trirail.config.as_built import AsBuilt
from trirail.config.tables import BASE, PLATFORM, Config, Limits, Zenoh, corrected_geometry, geometry, room
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry, gains, singular_angles, travels
from trirail.wire.endpoints import ReachableBy, fault_of, reach, same_port, tcp_address
from trirail.wire.text import QUANTITY_RULE, is_quantity


def check_as_built(found: AsBuilt, robot: Geometry, limits: Limits) -> None:
    """Refuse a map that is not this robot's, or that could break a limit anywhere. Raises ConfigError."""
    platform, slider = limits.platform, limits.slider
    rates = platform.velocity, platform.acceleration, platform.jerk
    as_built.check(found, robot, room(limits), rates, (slider.velocity, slider.acceleration, slider.jerk))


_WINDOWS = (
    *((f"sliders[{i}]", "m") for i in range(3)),
    *((f"pose[{i}]", unit) for i, unit in enumerate(("m", "m", "rad"))),
)
"""The windows of [limits.in_position], each with its unit."""


def check(config: Config) -> None:
    """Refuse what is well-formed but impossible."""
    from trirail_drivers.connection import checks
    from trirail_drivers.driver.requirements import Requirements, Window

    robot = geometry(config.geometry)
    platform, slider = config.limits.platform, config.limits.slider
    ranges = {
        "limits.platform.x": platform.x,
        "limits.platform.y": platform.y,
        "limits.platform.phi": platform.phi,
        "limits.slider.position": slider.position,
        "limits.slider.passive": slider.passive,
    }
    for key, (low, high) in ranges.items():
        if low >= high:
            raise ConfigError(f"{key} = [{low:g}, {high:g}]: the lower limit must be below the upper one")
    _check_correction(config, robot)
    corrected = corrected_geometry(config)
    off = corrected.correction
    x, y, phi = np.zeros(3) if off is None else off.bound  # the legs are told places that far beyond
    (low, high), margin = (platform.phi[0] - phi, platform.phi[1] + phi), config.limits.singularity_margin
    # On a robot as built the singular angles move with the centre: linearly in x and y, so the corners bound them.
    beside = [(low - more, high + more) for (low, high), more in ((platform.x, x), (platform.y, y))]
    centres = [(0.0, 0.0), *itertools.product(*beside)]
    for angle in {angle for centre in centres for angle in singular_angles(robot, centre)}:
        if low - margin < angle < high + margin:
            raise ConfigError(
                f"limits.platform.phi = [{low:g}, {high:g}] comes nearer than limits.singularity_margin = {margin:g} "
                f"to the singular angle {angle:.4f}: keep {'below ' if angle > 0 else 'above '}"
                f"{angle - math.copysign(margin, angle):.4f}"
            )
    check_reach(config.zenoh)
    _check_metrics(config)
    _check_ports(config)
    settling = config.limits.in_position
    if settling.timeout <= settling.dwell:
        raise ConfigError(
            f"limits.in_position.timeout = {settling.timeout:g}: it must be longer than the dwell, {settling.dwell:g} s"
        )
    for name in config.frames.work:
        if name in (BASE, PLATFORM):
            raise ConfigError(f"frames.work.{name}: every robot has a frame of that name; give this one another")
    _check_poses(config, corrected)
    nodes = [config.drives.master_node, *(drive.node for drive in config.drives.each)]
    if len(set(nodes)) < len(nodes):
        raise ConfigError(
            f"drives: the node ids of master_node, A, B and C must differ, but are {', '.join(map(str, nodes))}"
        )
    # The drives take the period as an integer times a power of ten of a second, object 60C2h.
    if 1_000_000 % config.loop.rate_hz:
        raise ConfigError(
            f"loop.rate_hz = {config.loop.rate_hz}: a cycle must be a whole number of microseconds, "
            "as with 100, 200, 250, 400, 500, 800, 1000"
        )
    places = (*slider.position, *(config.can.simulated.start if config.can.interface == "simulated" else ()))
    corners = list(itertools.product(platform.x, platform.y, platform.phi))
    most = np.abs([gains(robot, corner) for corner in corners]).max(axis=0).tolist()
    widths = zip((*np.eye(3).tolist(), *most), (*settling.sliders, *settling.pose), strict=True)
    windows = tuple(
        Window(f"limits.in_position.{key}", width, unit, (a, b, c))
        for (key, unit), ((a, b, c), width) in zip(_WINDOWS, widths, strict=True)
    )
    required = Requirements(config.period, min(places), max(places), slider.velocity, slider.following_error, windows)
    try:
        checks.check_bus(config.can)
        checks.check(config.drives, required)
    except DriveError as error:
        raise ConfigError(str(error)) from error


def _check_correction(config: Config, robot: Geometry) -> None:
    """Refuse a map that is not this robot's, or that the limits have no room for."""
    told = config.correction
    if told.as_built is None:
        if told.map is not None:
            raise ConfigError(f"correction.map = {told.map!r}: a file, which only a configuration in a file can name")
        return
    try:
        check_as_built(told.as_built, robot, config.limits)
    except ConfigError as error:
        raise ConfigError(f"correction.map: {told.map or 'as_built'}: {error}") from error


def _check_poses(config: Config, robot: Geometry) -> None:
    """Refuse named poses at which the robot cannot be."""
    platform, slider = config.limits.platform, config.limits.slider
    for name, pose in config.poses.items():
        if is_quantity(name):
            raise ConfigError(f"poses.{name}: {name} {QUANTITY_RULE}")
        places = [
            (key, at, key, getattr(platform, key), "platform") for key, at in zip(("x", "y", "phi"), pose, strict=True)
        ]
        position, passive = travels(robot, pose).tolist()
        places += [
            (f"slider {leg}", at, "position", slider.position, "slider")
            for leg, at in zip(NAMES, position, strict=True)
        ]
        places += [
            (f"lambda_32 of {leg}", at, "passive", slider.passive, "slider")
            for leg, at in zip(NAMES, passive, strict=True)
        ]
        for what, at, key, (low, high), section in places:
            if not low <= at <= high:
                numbers = ", ".join(f"{value:g}" for value in pose)
                raise ConfigError(
                    f"poses.{name} = [{numbers}]: {what} would be {at:.6g}, outside of "
                    f"limits.{section}.{key} = [{low:g}, {high:g}]"
                )


def _check_metrics(config: Config) -> None:
    """Refuse an address of the metrics that is none, or that lets a network read them by accident."""
    address, zenoh = config.telemetry.metrics_address, config.zenoh
    key = f"telemetry.metrics_address = {address!r}"
    try:
        loopback = ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise ConfigError(f"{key}: it must be an IP address, as 127.0.0.1 or ::1") from error
    if config.telemetry.metrics_port and not loopback and zenoh.tls is None and not zenoh.insecure:
        raise ConfigError(
            f"{key}: whoever reaches it could read them: use an address of the loopback, [zenoh.tls] "
            "(trirail keys init), or write zenoh.insecure = true if that is what you want"
        )


def _check_ports(config: Config) -> None:
    """Refuse a port that two would listen on."""
    telemetry = config.telemetry
    addresses = [(f"zenoh.listen[{index}]", tcp_address(at)) for index, at in enumerate(config.zenoh.listen)]
    addresses += [
        ("telemetry.live_port", ("127.0.0.1", telemetry.live_port)),
        ("telemetry.metrics_port", (telemetry.metrics_address, telemetry.metrics_port)),
    ]
    listening = [(key, address) for key, address in addresses if address is not None and address[1]]
    for (key, address), (other, taken) in itertools.combinations(listening, 2):
        if same_port(address, taken):
            raise ConfigError(f"{other}: port {taken[1]} is that of {key} too: give each a port of its own")


def check_reach(zenoh: Zenoh) -> None:
    """Refuse a door that is open by accident, and certificates or users that would not be looked at."""
    if zenoh.tls is not None and zenoh.connect and zenoh.router is None:
        raise ConfigError("zenoh.connect: with [zenoh.tls] give zenoh.router, the name in the router's certificate")
    if zenoh.router is not None and not (zenoh.tls and zenoh.connect):
        raise ConfigError("zenoh.router: it is looked at only with [zenoh.tls] and zenoh.connect")
    if zenoh.router in zenoh.users:
        raise ConfigError(f"zenoh.router: {zenoh.router} is a user: give the router a name of its own")
    if zenoh.users and zenoh.tls is None:
        raise ConfigError("zenoh.users: without [zenoh.tls] nobody's name is known: add it, or leave users out")
    named = [(f"listen[{index}]", endpoint) for index, endpoint in enumerate(zenoh.listen)]
    named += [(f"connect[{index}]", endpoint) for index, endpoint in enumerate(zenoh.connect)]
    for name, endpoint in named:
        key, by = f"zenoh.{name} = {endpoint!r}", reach(endpoint)
        if fault := fault_of(endpoint):
            raise ConfigError(f"{key}: {fault}")
        if zenoh.tls is not None and by is not ReachableBy.CERTIFICATE:
            raise ConfigError(f"{key}: with [zenoh.tls] every endpoint is tls/ADDRESS:PORT, or it would go round it")
        if zenoh.tls is not None and "#" in endpoint:
            raise ConfigError(f"{key}: settings after # would go round [zenoh.tls]")
        if zenoh.tls is None and by is ReachableBy.CERTIFICATE:
            raise ConfigError(f"{key}: it needs [zenoh.tls], with the certificates that `trirail keys init` makes")
        if by is ReachableBy.NETWORK and not zenoh.insecure:
            raise ConfigError(
                f"{key}: whoever reaches it can move the robot: use tls/ with [zenoh.tls] (trirail keys init), "
                "an address of the loopback, or write insecure = true if that is what you want"
            )
