"""Keys of a configuration file, each with its section, type, range, default and meaning."""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import Annotated, Literal, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct, structs
from trirail_drivers import files
from trirail_drivers.config import Acceleration, Can, Coordinate, Distance, DriveIo, Drives, Name, Timeout, Velocity
from trirail_drivers.errors import FileError
from trirail_drivers.interface import NAMES, Triple

from trirail.config import as_built
from trirail.config.as_built import AsBuilt
from trirail.config.digital import Input, Output, OutputName, digital_io
from trirail.errors import ConfigError
from trirail.kinematics.geometry import CrossLeg, Geometry, Leg, Room
from trirail.kinematics.leg import AnyLeg
from trirail.naming import Labels
from trirail.wire.endpoints import endpoint_of, is_local
from trirail.wire.vocabulary import LeasePolicy, Role

Angle = Annotated[float, Meta(ge=-2.0 * math.pi, le=2.0 * math.pi)]
"""Angle [rad]."""
Jerk = Annotated[float, Meta(ge=1e-3, le=1e6)]
"""Jerk [m/s³] or [rad/s³]."""
BASE, PLATFORM = "base", "platform"
"""Names of the frames that every robot has."""
FrameName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$(?!\n)")]
UserName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$(?!\n)")]
"""Name of a user, the <user> in Zenoh keys."""
PoseName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$(?!\n)")]
Label = Annotated[str, Meta(pattern=r"^[^\W\d_][^\W_]{0,3}$(?!\n)")]
"""One to four letters and digits of any script, starting with a letter."""
Point = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]


class RobotTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [robot]."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$(?!\n)")]
    """Name of the robot, the <robot> in every Zenoh key: letters, digits, - and _; not "fault"."""


class LegTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [[geometry.leg]]: one leg of a measured robot, in metres and radians."""

    anchor: Point
    """Point on the rail: x and y in the base frame [m]."""
    rail_angle: Angle
    """Direction in which the slider position increases along the rail, measured from the base's x axis [rad]."""
    home: Coordinate
    """Distance along the rail from the anchor to the slider's zero [m]."""
    edge_point: Point | None = None
    """3-PRP: point of the platform that is at the slider's pin when the cross slide is at zero, in the platform's frame
    [m]."""
    edge_angle: Angle | None = None
    """3-PRP: direction of the platform's edge that slides through the pin, in the platform's frame [rad]."""
    pivot: Point | None = None
    """3-PPR: pivot of the platform on the cross slide, in the platform's frame [m]."""
    slide_angle: Angle | None = None
    """3-PPR: direction of the cross slide in the base frame [rad]. If absent, it is at right angles to the rail."""


class GeometryTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [geometry]: either `l0` for the paper's symmetric robot, or three measured legs."""

    kind: Literal["3-PRP", "3-PPR"] = "3-PRP"
    """Mechanism. In 3-PRP (alignment stages of kind 1), the pivot is on the driven carriage, below a cross slide that
    turns with the platform. In 3-PPR (kind 2), the pivot is on a cross slide that keeps its direction."""
    l0: Annotated[float, Meta(ge=0.001, le=100.0)] | None = None
    """Distance from the centre to the start of each rail of the symmetric robot [m]. It replaces the three legs."""
    leg: tuple[LegTable, LegTable, LegTable] | None = None
    labels: tuple[Label, Label, Label] = NAMES
    """Display names of the sliders A, B and C, for example U, V and W: one to four letters and digits each."""


class PlatformLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.platform]: limits for x, y [m] and phi [rad]."""

    velocity: tuple[Velocity, Velocity, Velocity]
    """Maximum velocities in x, y [m/s] and phi [rad/s]."""
    acceleration: tuple[Acceleration, Acceleration, Acceleration]
    """Maximum accelerations in x, y [m/s²] and phi [rad/s²]."""
    jerk: tuple[Jerk, Jerk, Jerk]
    """Maximum jerks in x, y [m/s³] and phi [rad/s³]."""
    x: Range
    """Minimum and maximum x of the platform's centre [m]."""
    y: Range
    """Minimum and maximum y of the platform's centre [m]."""
    phi: tuple[Angle, Angle]
    """Minimum and maximum angle of the platform [rad]. Both must be between the nearest singular angles below and above
    zero, at least singularity_margin away from each."""


_THREE = Meta(min_length=3, max_length=3)
_PER_SLIDER = Meta(description="one number for all sliders, or three: of A, B, C")
# msgspec 0.22 stores the bounds of a number and the length of a fixed array in the same place, so a union of the two
# crashes the interpreter. These types are therefore arrays of any length, and a constraint checks the length.
EachVelocity = Annotated[Velocity | Annotated[tuple[Velocity, ...], _THREE], _PER_SLIDER]
EachAcceleration = Annotated[Acceleration | Annotated[tuple[Acceleration, ...], _THREE], _PER_SLIDER]
EachJerk = Annotated[Jerk | Annotated[tuple[Jerk, ...], _THREE], _PER_SLIDER]
EachRange = Annotated[
    tuple[Coordinate | Annotated[tuple[Coordinate, ...], Meta(min_length=2, max_length=2)], ...],
    Meta(description="a pair for all sliders, or three pairs: of A, B, C"),
]


class ShapeError(ValueError):
    """An array has none of the shapes that its `field` accepts; the type of the field cannot express this."""

    def __init__(self, field: str) -> None:
        super().__init__(f"{field} has none of its shapes")
        self.field = field


class SliderLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.slider]."""

    position: EachRange
    """Minimum and maximum slider position lambda_10 [m]."""
    passive: Range
    """Travel of the cross slides, which have no drive [m]. In 3-PRP, the cross slides are the platform's edges."""
    velocity: EachVelocity
    """Maximum velocity of each slider [m/s]."""
    acceleration: EachAcceleration
    """Maximum acceleration of each slider [m/s²]."""
    jerk: EachJerk
    """Maximum jerk of each slider [m/s³]."""
    following_error: Distance
    """Following error above which all drives stop [m]. It should be less than `[drives] following_error`."""

    def __post_init__(self) -> None:
        pairs = sum(isinstance(each, tuple) for each in self.position)
        if (len(self.position), pairs) not in {(2, 0), (3, 3)}:
            raise ShapeError("position")

    def keys(self, limit: str) -> tuple[str, str, str]:
        """Return the key of each slider's limit, with an index if each slider has its own limit."""
        value = getattr(self, limit)
        own = isinstance(value, tuple) and len(value) == len(NAMES)
        a, b, c = (f"limits.slider.{limit}[{k}]" if own else f"limits.slider.{limit}" for k in range(3))
        return a, b, c

    @property
    def positions(self) -> tuple[Range, Range, Range]:
        """Travel of each slider [m]."""
        return cast("tuple[Range, Range, Range]", self.position if len(self.position) == 3 else (self.position,) * 3)

    @property
    def velocities(self) -> Triple:
        """Maximum velocity of each slider [m/s]."""
        return _expand(self.velocity)

    @property
    def accelerations(self) -> Triple:
        """Maximum acceleration of each slider [m/s²]."""
        return _expand(self.acceleration)

    @property
    def jerks(self) -> Triple:
        """Maximum jerk of each slider [m/s³]."""
        return _expand(self.jerk)

    @property
    def fastest(self) -> float:
        """Highest of the sliders' maximum velocities [m/s]."""
        return max(self.velocities)


def _expand(limit: float | tuple[float, ...]) -> Triple:
    a, b, c = limit if isinstance(limit, tuple) else (limit,) * 3
    return a, b, c


Window = Annotated[float, Meta(ge=1e-9, le=1.0)]
"""Half-width of an in-position window [m] or [rad]."""


class InPosition(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.in_position]: windows in which sliders and pose must stay for `dwell` before a goal is `done`."""

    sliders: tuple[Window, Window, Window] = (1e-4, 1e-4, 1e-4)
    """Maximum position errors of the sliders A, B and C [m]. Each must be at least three counts of its drive."""
    pose: tuple[Window, Window, Window] = (1e-4, 1e-4, 1e-3)
    """Maximum errors of the measured pose in x, y [m] and phi [rad]."""
    dwell: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.02
    """Time for which all errors must stay within their windows [s]."""
    timeout: Annotated[float, Meta(ge=0.01, le=60.0)] = 2.0
    """Time-out after the end of the path, including the dwell [s]. When it expires, the goal ends as `unsettled`."""


class Limits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits]."""

    platform: PlatformLimits
    slider: SliderLimits
    in_position: InPosition = InPosition()
    singularity_margin: Annotated[float, Meta(ge=0.001, le=1.5)] = 0.1
    """Minimum distance of phi from any singular angle [rad]."""


class MotionTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [motion]."""

    queue: Annotated[int, Meta(ge=0, le=100)] = 8
    """Maximum number of goals with a `blend` that can wait for the active goal."""


class ControlTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [control]: rules for the lease, which apply in addition to roles."""

    lease: LeasePolicy = "optional"
    """Whether moving the robot requires the lease. While a user holds the lease, the robot moves for that user only."""
    takeover: Role = Role.MAINTAINER
    """Lowest role that may take over the lease from its holder."""


class FramesTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [frames]: points and frames that goals may name."""

    tool: dict[FrameName, Point] = msgspec.field(default_factory=dict)
    """Named points of the platform: x and y in the platform's frame, whose origin is the centre [m]."""
    work: dict[FrameName, tuple[Coordinate, Coordinate, Angle]] = msgspec.field(default_factory=dict)
    """Named frames: x, y [m] of the origin and the angle [rad], in the base frame."""


Play = Annotated[float, Meta(ge=0.0, le=0.001)]
"""Backlash [m]."""


class CorrectionTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [correction]: differences between the robot and its [geometry]; none if the section is absent."""

    map: Name | None = None
    """File of as-built errors, written by `tools/calibrate.py --map`; its path is relative to the configuration
    file."""
    backlash: tuple[Play, Play, Play] = (0.0, 0.0, 0.0)
    """Play between drive and slider for A, B and C [m]. The service compensates it when a slider reverses."""
    as_built: AsBuilt | None = None


class LoopTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [loop]."""

    rate_hz: Annotated[int, Meta(ge=1, le=4000)]
    """Cycles per second. Each cycle has one SYNC, one set of setpoints and one record, and lasts a whole number of
    microseconds."""
    realtime: Literal["off", "prefer", "enforce"] = "prefer"
    """Whether SCHED_FIFO, locked memory and a pinned processor are not used, used if possible, or required."""
    priority: Annotated[int, Meta(ge=1, le=99)] = 80
    """Priority of the loop among SCHED_FIFO threads."""
    cpu: Annotated[int, Meta(ge=0, le=8191)] | None = None
    """Processor to which the loop is pinned. If absent, it is the last one that the process may use."""
    busy_wait: Annotated[float, Meta(ge=0.0, le=1e-4)] = 5e-5
    """Time before each tick at which the loop wakes up [s]. It reads the frames that have arrived, and then the clock
    until the tick is due, so that SYNC leaves within microseconds of its time. Not used with `realtime = "off"`."""

    @property
    def busy_wait_ns(self) -> int:
        """Time before each tick at which the loop wakes up [ns]."""
        return 0 if self.realtime == "off" else round(self.busy_wait * 1e9)


def resolved(path: str, folder: Path) -> str:
    """Return a path of a configuration file in `folder`, to which it is relative. A leading ~ is the home folder.

    Raises ConfigError if the home folder is unknown.
    """
    try:
        return str(folder / files.expand_home(path))
    except FileError as error:
        raise ConfigError(f"{error}, or write the path without ~") from error


class Tls(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [zenoh.tls]: users need a certificate to connect and a role to do anything."""

    directory: Name = "keys"
    """Folder with ca.pem, cert.pem and key.pem from `trirail keys init`; its path is relative to the configuration
    file. Users listed in the folder's file revoked.txt have no role."""


class Zenoh(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [zenoh]."""

    listen: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=64)] = ("tcp/127.0.0.1:7447",)
    """Zenoh locators at which the service listens: tcp on the loopback for all users of this machine, unixsock-stream
    for users with access to the socket file, and tls with [zenoh.tls] for the network. At the port number plus 1000, or
    at PATH.stop, the service accepts stops only."""
    connect: Annotated[tuple[Name, ...], Meta(max_length=8)] = ()
    """Zenoh locators of routers to which the service connects, retrying if necessary. Users reach the service through
    these routers."""
    router: UserName | None = None
    """Common name in the routers' certificates. With [zenoh.tls], the robot accepts no other router. It accepts this
    router on behalf of every user, because the router checks the users' roles."""
    insecure: bool = False
    """Allow the service to listen beyond this machine without certificates. Anyone on the network can then move the
    robot."""
    tls: Tls | None = None
    users: dict[UserName, Role] = {}
    """Role of each user, whose name is the common name of their certificate. A viewer sees everything and may stop the
    robot, an operator may also move it, and a maintainer may also reset and home it."""

    def beside(self, folder: Path) -> Zenoh:
        """Return the section with its certificate folder resolved relative to `folder`, the folder of the file."""
        if self.tls is None:
            return self
        return structs.replace(self, tls=structs.replace(self.tls, directory=resolved(self.tls.directory, folder)))


class Telemetry(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [telemetry]."""

    log: Literal["text", "json"] = "text"
    """Format of the service's log lines: text for people, or JSON."""
    directory: Name = "recordings"
    """Folder for recordings. Its path is relative to the configuration file or, for shipped files, to the working
    directory. If the clock is behind the newest recording in the folder, as on a computer whose clock was not set, a
    new one is named after the next second, so that names stay in order."""
    state_hz: Annotated[int, Meta(ge=1, le=200)] = 50
    """Rate at which the state is published [Hz]."""
    live_port: Annotated[int, Meta(ge=0, le=65535)] = 9876
    """Loopback port of the live Rerun server; 0 for none."""
    live_mb: Annotated[float, Meta(ge=1.0, le=4096.0)] = 64.0
    """Memory for the history that viewers receive when they connect late [1e6 bytes]. When it is full, the oldest data
    is dropped."""
    metrics_port: Annotated[int, Meta(ge=0, le=65535)] = 0
    """Port that serves the Prometheus metrics at /metrics and the health of the processes at /healthz; 0 for none."""
    metrics_address: Name = "127.0.0.1"
    """IP address on which the metrics port listens. An address beyond the loopback requires [zenoh.tls], and readers
    then need a certificate with a role."""
    capture_can: bool = False
    """Whether to write every CAN frame to a file beside each file of the recording, in candump's log format."""
    rotate_minutes: Annotated[float, Meta(ge=0.01, le=100_000.0)] = 30.0
    """Maximum duration of one recording file [min]. The recording then continues in another file."""
    rotate_mb: Annotated[float, Meta(ge=1.0, le=1e6)] = 1000.0
    """Maximum size of one recording file [1e6 bytes]."""
    keep_mb: Annotated[float, Meta(ge=1.0, le=1e9)] = 20_000.0
    """Maximum total size of the recordings in the folder [1e6 bytes]. The oldest recordings are deleted first, black
    boxes last. The files that are being written count for at most half, so that a large one does not take the place of
    every other. The oldest are also deleted, except black boxes, while less than 84 MB of the disk are free."""


class Watchdogs(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [watchdogs]."""

    enable_timeout: Timeout = 2.0
    """Time-out for enabling the drives [s]."""
    max_overruns: Annotated[int, Meta(ge=1, le=100_000)] = 10
    """Number of consecutive missed ticks that causes a controlled stop."""
    gateway_timeout: Annotated[float, Meta(ge=0.2, le=10.0)] = 0.3
    """Time without a heartbeat from the gateway after which a controlled stop begins [s]. The gateway sends 20
    heartbeats per second."""


class Config(Struct, frozen=True, forbid_unknown_fields=True):
    """The contents of a configuration file."""

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
    """Named poses: x, y [m] of the platform's centre and phi [rad], in the base frame. Taught poses are not listed
    here, because the service stores them itself."""
    outputs: dict[OutputName, Output] = {}
    """Named digital outputs."""
    inputs: dict[OutputName, Input] = {}
    """Named digital inputs. An input and an output cannot have the same name."""

    @property
    def drive_io(self) -> DriveIo:
        """Digital outputs and inputs of the drives A, B and C."""
        return digital_io(self.outputs, self.inputs)

    @property
    def period(self) -> float:
        """Period of the loop [s]."""
        return 1.0 / self.loop.rate_hz


def metrics_url(config: Config) -> str:
    """Return the URL of the metrics, or "" if metrics are off.

    With [zenoh.tls], the connection is encrypted if the address is beyond the loopback.
    """
    telemetry = config.telemetry
    endpoint = endpoint_of(telemetry.metrics_address, telemetry.metrics_port)
    encrypted = config.zenoh.tls is not None and not is_local(endpoint)
    url = f"{'https' if encrypted else 'http'}://{endpoint.removeprefix('tcp/')}/metrics"
    return url if telemetry.metrics_port else ""


@functools.lru_cache(maxsize=32)  # every check of a configuration needs it, and it takes milliseconds
def geometry(table: GeometryTable) -> Geometry:
    """Build the robot's geometry from its section. Raises ConfigError if the section is invalid."""
    if (table.l0 is None) == (table.leg is None):
        raise ConfigError("geometry: give either l0 (the symmetric robot) or three [[geometry.leg]] tables")
    if table.l0 is not None and table.kind != "3-PRP":
        raise ConfigError(
            f"geometry: l0 is only for the symmetric 3-PRP robot; for {table.kind} give three [[geometry.leg]] tables"
        )
    labels = _labels(table)
    try:
        if table.leg is None:
            return dataclasses.replace(Geometry.symmetric(table.l0 or 0.0), labels=labels)
        first, second, third = (_leg(table.kind, name, leg) for name, leg in zip(NAMES, table.leg, strict=True))
        return Geometry(legs=(first, second, third), labels=labels)
    except ValueError as error:
        raise ConfigError(f"geometry: {error}") from error


def _labels(table: GeometryTable) -> Labels:
    """Return the sliders' labels.

    Raises ConfigError if a label is ambiguous or is also an answer to a question of trirail commission.
    """
    labels = dict(zip(NAMES, table.labels, strict=True))
    for name, label in labels.items():
        others = [word for other in NAMES if other != name for word in (other, labels[other])]
        if label.casefold() in (word.casefold() for word in (*others, "n", "q")):
            raise ConfigError(
                f"geometry.labels: {label} for slider {name} is not allowed: choose a label that is not the label or "
                "letter "
                "of another slider, and not n or q, which are answers to trirail commission"
            )
    return table.labels


_LEG_KEYS = {"3-PRP": ("edge_point", "edge_angle"), "3-PPR": ("pivot", "slide_angle")}
"""Keys of a leg that only one mechanism has."""
_KIND_WORDS = {"3-PRP": "the edge turns with the platform", "3-PPR": "the cross slide keeps its direction"}


def _leg(kind: str, name: str, table: LegTable) -> AnyLeg:
    """Build a leg from the keys of its mechanism. Raises ConfigError if a key is missing or not allowed."""
    for other, keys in _LEG_KEYS.items():
        for key in keys:
            if other != kind and getattr(table, key) is not None:
                raise ConfigError(
                    f"geometry: leg {name}: {key} is allowed only with kind {other} ({_KIND_WORDS[other]}); "
                    f"with kind {kind}, use {' and '.join(_LEG_KEYS[kind])}"
                )
    point, angle = (getattr(table, key) for key in _LEG_KEYS[kind])
    if point is None or (angle is None and kind == "3-PRP"):
        missing = _LEG_KEYS[kind][0 if point is None else 1]
        raise ConfigError(f"geometry: leg {name} has no {missing}, which kind {kind} needs")
    if kind == "3-PRP":
        return Leg(table.anchor, table.rail_angle, table.home, point, angle)
    return CrossLeg(table.anchor, table.rail_angle, table.home, point, angle)


def corrected_geometry(config: Config) -> Geometry:
    """Build the robot's geometry, including its correction if it has one. Raises ConfigError if either is invalid."""
    robot, errors = geometry(config.geometry), config.correction.as_built
    return dataclasses.replace(robot, correction=as_built.correction(errors)) if errors is not None else robot


def room(limits: Limits) -> Room:
    """Return the limits of the platform and the travel of the sliders."""
    low, high = np.transpose([limits.platform.x, limits.platform.y, limits.platform.phi]).tolist()
    return Room(low, high, limits.slider.positions, limits.slider.passive)
