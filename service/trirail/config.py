"""The configuration file: typed, strict, refused with file, key, value and what is allowed."""

from __future__ import annotations

import dataclasses
import difflib
import ipaddress
import itertools
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
import numpy as np
from msgspec import Meta, Struct
from trirail_drivers import files
from trirail_drivers.config import Acceleration, Can, Coordinate, Distance, Drives, Name, Timeout, Velocity
from trirail_drivers.errors import DriveError, FileError
from trirail_drivers.interface import NAMES

from trirail import as_built
from trirail.as_built import AsBuilt
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry, Leg, Room, gains, singular_angles, travels
from trirail.wire.endpoints import ReachableBy, endpoint_of, fault_of, is_local, reach, same_port, tcp_address
from trirail.wire.text import QUANTITY_RULE, is_quantity
from trirail.wire.vocabulary import LeasePolicy, Role

_PACKAGED = Path(__file__).parent / "configs"
SIM = (_PACKAGED if _PACKAGED.exists() else Path(__file__).parents[2] / "configs") / "sim.toml"
"""The configuration that needs nothing: no hardware, no rights, no other program."""

Angle = Annotated[float, Meta(ge=-2.0 * math.pi, le=2.0 * math.pi)]
"""[rad]."""
Jerk = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""[m/s³] or [rad/s³]."""
BASE, PLATFORM = "base", "platform"
"""Frames that every robot has."""
FrameName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
UserName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
"""The <user> of Zenoh keys."""
PoseName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
Point = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]


class RobotTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [robot]."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    """The <robot> of every Zenoh key; letters, digits, - and _."""


class LegTable(Struct, frozen=True, forbid_unknown_fields=True):
    """One leg of a robot as built: [[geometry.leg]], metres and radians, as trirail.kinematics.geometry.Leg."""

    anchor: Point
    """A point of the rail, x and y in the base frame [m]."""
    rail_angle: Angle
    """Direction of the rail, in which the slider position rises, from the base's x axis [rad]."""
    home: Coordinate
    """Where on the rail the slider reads zero, from the anchor along the rail [m]."""
    edge_point: Point
    """The platform's point that is at the slider's pin when lambda_32 is zero, in the platform's frame [m]."""
    edge_angle: Angle
    """Direction of the platform's edge that slides in the pin, in the platform's frame [rad]."""


class GeometryTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [geometry]: the paper's symmetric robot by `l0`, or three measured legs."""

    l0: Annotated[float, Meta(ge=0.001, le=100.0)] | None = None
    """From the centre to each summit of the fixed triangle [m]; instead of three legs."""
    leg: tuple[LegTable, LegTable, LegTable] | None = None


class PlatformLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.platform]: for x, y [m] and phi [rad]."""

    velocity: tuple[Velocity, Velocity, Velocity]
    """Greatest rates of x, y [m/s] and phi [rad/s]."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration]
    """Greatest accelerations of x, y [m/s²] and phi [rad/s²]."""
    jerk: tuple[Jerk, Jerk, Jerk]
    """Greatest jerks of x, y [m/s³] and phi [rad/s³]."""
    x: Range
    """Least and greatest x of the platform's centre [m]."""
    y: Range
    """Least and greatest y of the platform's centre [m]."""
    phi: tuple[Angle, Angle]
    """Least and greatest angle of the platform [rad], singularity_margin away from every singular one."""


class SliderLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.slider]: the same for all three."""

    position: Range
    """Travel of lambda_10 [m]."""
    passive: Range
    """Travel of lambda_32 along the platform's edges [m]."""
    velocity: Velocity
    """Greatest rate of each slider [m/s]."""
    acceleration: Acceleration
    """Greatest acceleration of each slider [m/s²]."""
    jerk: Jerk
    """Greatest jerk of each slider [m/s³]."""
    following_error: Distance
    """Setpoint less measured position beyond which everything stops [m]."""


Window = Annotated[float, Meta(ge=1e-9, le=1.0)]
"""How far from where it is to be, to either side [m] or [rad]."""


class InPosition(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.in_position]: a goal is `done` when all that is measured has been in these for the dwell."""

    sliders: tuple[Window, Window, Window] = (1e-4, 1e-4, 1e-4)
    """How far the sliders A, B, C may be from where they are to be [m]; three steps of their drives at least."""
    pose: tuple[Window, Window, Window] = (1e-4, 1e-4, 1e-3)
    """How far the measured pose may be from the goal's, in x, y [m] and phi [rad]."""
    dwell: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.02
    """How long all of it must stay inside without leaving [s]."""
    timeout: Annotated[float, Meta(ge=0.01, le=60.0)] = 2.0
    """How long after the end of its path a goal may take for that, dwell and all [s]; then it ends `unsettled`."""


class Limits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits]."""

    platform: PlatformLimits
    slider: SliderLimits
    in_position: InPosition = InPosition()
    singularity_margin: Annotated[float, Meta(ge=0.001, le=1.5)] = 0.1
    """How near phi may come to a singular angle [rad]."""


class MotionTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [motion]."""

    queue: Annotated[int, Meta(ge=0, le=100)] = 8
    """How many goals may wait for the one under way, where that has a `blend`."""


class ControlTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [control]: who may move the robot, beside what his role allows."""

    lease: LeasePolicy = "optional"
    """Whether the robot moves while nobody holds the lease; while somebody does, it moves for him alone."""
    takeover: Role = Role.MAINTAINER
    """The least role that may take the lease over from who holds it."""


class FramesTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [frames]: points and frames that goals may name."""

    tool: dict[FrameName, Point] = msgspec.field(default_factory=dict)
    """Points of the platform by name, x and y in its own frame, whose origin is the centre [m]."""
    work: dict[FrameName, tuple[Coordinate, Coordinate, Angle]] = msgspec.field(default_factory=dict)
    """Frames by name: x, y [m] of the origin and the angle [rad], in the base frame."""


Play = Annotated[float, Meta(ge=0.0, le=0.001)]
"""[m]."""


class CorrectionTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [correction]: what the robot as built differs from [geometry] by; where it is absent, nothing."""

    map: Name | None = None
    """File of as-built errors, from `tools/calibrate.py --map`, relative to the configuration file."""
    backlash: tuple[Play, Play, Play] = (0.0, 0.0, 0.0)
    """Play between drive and slider, A, B, C [m]: taken up wherever a slider turns back."""
    as_built: AsBuilt | None = None


class LoopTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [loop]."""

    rate_hz: Annotated[int, Meta(ge=1, le=4000)]
    """Cycles a second: SYNCs, setpoints and records; a cycle is a whole number of microseconds."""
    realtime: Literal["off", "prefer", "enforce"] = "prefer"
    """Whether SCHED_FIFO, locked memory and a pinned processor are done without, wished for, or demanded."""
    priority: Annotated[int, Meta(ge=1, le=99)] = 80
    """The loop's priority among SCHED_FIFO threads."""
    cpu: Annotated[int, Meta(ge=0, le=8191)] | None = None
    """The processor to stay on; the last one that the process may use when absent."""


class Tls(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [zenoh.tls]: who has no certificate cannot open a session, who has no role cannot do anything."""

    directory: Name = "keys"
    """Folder with ca.pem, cert.pem and key.pem, as `trirail keys init` makes it, relative to the configuration file;
    who is in its file revoked.txt has no role."""


class Zenoh(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [zenoh]."""

    listen: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=64)] = ("tcp/127.0.0.1:7447",)
    """Zenoh locators at which clients find the service: tcp on the loopback for every user of this machine,
    unixsock-stream for those whom the socket's file lets, tls with [zenoh.tls] for the network."""
    connect: Annotated[tuple[Name, ...], Meta(max_length=8)] = ()
    """Zenoh locators of routers that the service dials, again and again while they are gone: users reach it there."""
    router: UserName | None = None
    """The common name of the routers' certificate: with [zenoh.tls] the robot obeys no other router, and this one in
    every user's name, since the users' roles stand at the router."""
    insecure: bool = False
    """Listen beyond this machine without certificates: whoever reaches the address can move the robot."""
    tls: Tls | None = None
    users: dict[UserName, Role] = {}
    """The role of each user, whose name is the common name of his certificate: a viewer sees all and may stop, an
    operator also moves the robot, a maintainer also resets and homes."""


class Telemetry(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [telemetry]."""

    log: Literal["text", "json"] = "text"
    """How the service writes what happens to its own output, a line each: for people, or JSON."""
    directory: Name = "recordings"
    """Where recordings go, relative to where the service was started."""
    state_hz: Annotated[int, Meta(ge=1, le=200)] = 50
    """How often a second the state is published."""
    live_port: Annotated[int, Meta(ge=0, le=65535)] = 9876
    """Loopback port of the live Rerun server; 0 for none."""
    live_mb: Annotated[float, Meta(ge=1.0, le=4096.0)] = 64.0
    """Memory for what viewers that connect late are shown of the past [1e6 bytes]; beyond that the oldest is let go."""
    metrics_port: Annotated[int, Meta(ge=0, le=65535)] = 0
    """Port of the metrics for Prometheus, /metrics, and of the processes' health, /healthz; 0 for none."""
    metrics_address: Name = "127.0.0.1"
    """The IP address of that port; beyond the loopback it takes [zenoh.tls], and a certificate with a role."""
    capture_can: bool = False
    """Write every CAN frame of the session beside the recording, in candump's log format."""
    rotate_minutes: Annotated[float, Meta(ge=0.01, le=100_000.0)] = 30.0
    """A recording goes on in another file after so long."""
    rotate_mb: Annotated[float, Meta(ge=1.0, le=1e6)] = 1000.0
    """A recording goes on in another file where this one is so large [1e6 bytes]."""
    keep_mb: Annotated[float, Meta(ge=1.0, le=1e9)] = 20_000.0
    """How much the recordings in the folder may take together [1e6 bytes]; beyond that the oldest are deleted."""


class Watchdogs(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [watchdogs]."""

    enable_timeout: Timeout = 2.0
    """How long the drives may take to power up [s]."""
    max_overruns: Annotated[int, Meta(ge=1, le=100_000)] = 10
    """So many missed ticks in a row are a controlled stop."""
    gateway_timeout: Annotated[float, Meta(ge=0.2, le=10.0)] = 0.3
    """So long without a sign of life from the gateway, which gives 20 a second, is a controlled stop [s]."""


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    """A whole configuration file."""

    robot: RobotTable
    geometry: GeometryTable
    limits: Limits
    loop: LoopTable
    can: Can
    drives: Drives
    zenoh: Zenoh
    telemetry: Telemetry
    watchdogs: Watchdogs
    motion: MotionTable = MotionTable()
    frames: FramesTable = FramesTable()
    correction: CorrectionTable = CorrectionTable()
    control: ControlTable = ControlTable()
    poses: dict[PoseName, tuple[Coordinate, Coordinate, Angle]] = {}
    """Poses by name: x, y [m] of the platform's centre and phi [rad], in the base frame. The others that goals may name
    are taught, and kept by the service."""

    @property
    def period(self) -> float:
        """The loop's period [s]."""
        return 1.0 / self.loop.rate_hz


def load(path: Path) -> Config:
    """Read a configuration file. Raises ConfigError with the file, the key, the value and what is allowed."""
    try:
        text = files.text(path)
    except FileError as error:
        raise ConfigError(f"{error}; `trirail config copy sim` gives one to start from") from error
    try:
        config = _beside(path, _parsed(text))
        _check(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def parse(text: str) -> Config:
    """Read a configuration from TOML. Raises ConfigError."""
    config = _parsed(text)
    _check(config)
    return config


def _parsed(text: str) -> Config:
    """Read a configuration whose values are each possible by itself."""
    try:
        raw = tomllib.loads(text)
        leaves = list(_leaves(raw))
    except RecursionError as error:
        raise ConfigError("not a configuration: its tables or arrays are nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and Python's own about an integer of thousands of digits
        raise ConfigError(f"not TOML: {error}") from error
    for key, value in leaves:
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{key} = {value}: it must be a finite number")
    try:
        return msgspec.convert(raw, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(_explain(str(error), raw)) from error


def _beside(path: Path, config: Config) -> Config:
    """The configuration with what lies relative to its file: EDS files, certificates, and what is in the map's file."""
    drives = config.drives
    for name, drive in zip(NAMES, drives.each, strict=True):
        if drive.eds is not None:
            found = msgspec.structs.replace(drive, eds=str(path.parent / drive.eds))
            drives = msgspec.structs.replace(drives, **{name: found})
    zenoh = config.zenoh
    if zenoh.tls is not None:
        tls = msgspec.structs.replace(zenoh.tls, directory=str(path.parent / zenoh.tls.directory))
        zenoh = msgspec.structs.replace(zenoh, tls=tls)
    correction = config.correction
    if correction.map is not None and correction.as_built is None:
        file = path.parent / correction.map
        try:
            read = as_built.read(file)
        except ConfigError as error:
            raise ConfigError(f"correction.map: {error}") from error
        correction = msgspec.structs.replace(correction, map=str(file), as_built=read)
    return msgspec.structs.replace(config, drives=drives, zenoh=zenoh, correction=correction)


def metrics_url(config: Config) -> str:
    """Return where the metrics are; "" where there are none. Beyond the loopback they are encrypted, if anything is."""
    telemetry = config.telemetry
    endpoint = endpoint_of(telemetry.metrics_address, telemetry.metrics_port)
    encrypted = config.zenoh.tls is not None and not is_local(endpoint)
    where = f"{'https' if encrypted else 'http'}://{endpoint.removeprefix('tcp/')}/metrics"
    return where if telemetry.metrics_port else ""


def geometry(table: GeometryTable) -> Geometry:
    """Build the robot's geometry from its section. Raises ConfigError."""
    if (table.l0 is None) == (table.leg is None):
        raise ConfigError("geometry: give either l0 (the symmetric robot) or three [[geometry.leg]] tables")
    try:
        if table.leg is None:
            return Geometry.symmetric(table.l0 or 0.0)
        first, second, third = (Leg(**msgspec.structs.asdict(leg)) for leg in table.leg)
        return Geometry(legs=(first, second, third))
    except ValueError as error:
        raise ConfigError(f"geometry: {error}") from error


def corrected_geometry(config: Config) -> Geometry:
    """Build the robot's geometry with the correction, where it has one. Raises ConfigError."""
    robot, found = geometry(config.geometry), config.correction.as_built
    return dataclasses.replace(robot, correction=as_built.correction(found)) if found is not None else robot


def room(limits: Limits) -> Room:
    """Return where the robot may be."""
    low, high = np.transpose([limits.platform.x, limits.platform.y, limits.platform.phi]).tolist()
    return Room(low, high, limits.slider.position, limits.slider.passive)


def check_as_built(found: AsBuilt, robot: Geometry, limits: Limits) -> None:
    """Refuse a map that is not this robot's, or that could break a limit anywhere. Raises ConfigError."""
    platform, slider = limits.platform, limits.slider
    rates = platform.velocity, platform.acceleration, platform.jerk
    as_built.check(found, robot, room(limits), rates, (slider.velocity, slider.acceleration, slider.jerk))


def _leaves(value: object, key: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{index}]")
    else:
        yield key, value


_AT = re.compile(r"^(?P<what>.*?)(?: - at (?P<key>`key` in )?`\$(?P<path>[^`]*)`)?$", re.DOTALL)
NAMED = "[...]"
"""What msgspec says in the place of a key of a table whose keys are names."""
_FIELD = re.compile(r"^Object (?P<how>contains unknown|missing required) field `(?P<name>[^`]*)`")


def _explain(error: str, raw: dict[str, Any]) -> str:
    """Turn msgspec's words into a key, the value found there, and what is allowed."""
    found = _AT.match(error)
    what, path = (found["what"], (found["path"] or "").lstrip(".")) if found else (error, "")
    if field := _FIELD.match(what):
        key = f"{path}.{field['name']}" if path else field["name"]
        if field["how"] == "missing required":
            return f"{key}: missing {'key' if path else 'section'}"
        allowed = _type_at(path).__struct_fields__
        close = difflib.get_close_matches(field["name"], allowed, n=1)
        hint = f"did you mean {close[0]}?" if close else f"allowed are {', '.join(allowed)}"
        return f"{key}: unknown {'key' if path else 'section'}; {hint}"
    keys = bool(found and found["key"])
    if keys or NAMED in path:
        table, _, rest = path.partition(NAMED)
        name = _culprit(_at(table, raw), get_args(_type_at(table))[0 if keys else 1], of_keys=keys)
        if keys:
            return f"{table}: {name!r} is no name here: {what[0].lower()}{what[1:].replace('`', '')}"
        path = f"{table}.{name}{rest}"
    value = _at(path, raw)
    if what.startswith("Invalid enum value"):
        kind = _type_at(path)
        values = [str(each) for each in kind] if kind is Role else get_args(kind)
        return f"{path} = {value!r}: allowed are {', '.join(map(repr, values))}"
    return f"{path} = {value!r}: {what[0].lower()}{what[1:].replace('`', '')}"


def _at(path: str, raw: dict[str, Any]) -> object:
    """The value that was given at a path."""
    value: object = raw
    for part in _parts(path):
        value = value[int(part) if isinstance(value, list) else part]  # type: ignore[index]
    return value


def _culprit(table: Any, kind: Any, *, of_keys: bool) -> str:
    """The first name in a table of names whose key, or value, is not of a type: msgspec does not say which."""
    for name, value in table.items():
        try:
            msgspec.convert(name if of_keys else value, kind)
        except msgspec.ValidationError:
            return str(name)
    return NAMED


def _parts(path: str) -> list[str]:
    return re.findall(r"[^.\[\]]+", path)


def _type_at(path: str) -> Any:
    """The type that the key or table at `path` must have."""
    kind: Any = Config
    for part in _parts(path):
        if part.isdigit():
            kind = get_args(kind)[0]
        elif get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            kind = next(field.type for field in msgspec.structs.fields(kind) if field.name == part)
        if isinstance(kind, UnionType):
            kind = get_args(kind)[0]
    return kind


_WINDOWS = (
    *((f"sliders[{i}]", "m") for i in range(3)),
    *((f"pose[{i}]", unit) for i, unit in enumerate(("m", "m", "rad"))),
)
"""The windows of [limits.in_position], each with its unit."""


def _check(config: Config) -> None:
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
