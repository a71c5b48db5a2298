"""Every key of a configuration: its section, its type, its range, its default, and what it means."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal, cast

import msgspec
import numpy as np
from msgspec import Meta, Struct, structs
from trirail_drivers.config import Acceleration, Can, Coordinate, Distance, Drives, Name, Timeout, Velocity
from trirail_drivers.interface import NAMES, Triple

from trirail.config import as_built
from trirail.config.as_built import AsBuilt
from trirail.errors import ConfigError
from trirail.kinematics.geometry import CrossLeg, Geometry, Leg, Room
from trirail.kinematics.leg import AnyLeg
from trirail.naming import Labels
from trirail.wire.endpoints import endpoint_of, is_local
from trirail.wire.vocabulary import LeasePolicy, Role

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
Label = Annotated[str, Meta(pattern=r"^[^\W\d_][^\W_]{0,3}\Z")]
"""One to four letters and digits of any script, a letter first."""
Point = tuple[Coordinate, Coordinate]
Range = tuple[Coordinate, Coordinate]


class RobotTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [robot]."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    """The <robot> of every Zenoh key; letters, digits, - and _."""


class LegTable(Struct, frozen=True, forbid_unknown_fields=True):
    """One leg of a robot as built: [[geometry.leg]], metres and radians, as the mechanism's own Leg."""

    anchor: Point
    """A point of the rail, x and y in the base frame [m]."""
    rail_angle: Angle
    """Direction of the rail, in which the slider position rises, from the base's x axis [rad]."""
    home: Coordinate
    """Where on the rail the slider reads zero, from the anchor along the rail [m]."""
    edge_point: Point | None = None
    """3-PRP: the platform's point that is at the slider's pin when the cross slide reads zero, in its frame [m]."""
    edge_angle: Angle | None = None
    """3-PRP: direction of the platform's edge that slides in the pin, in the platform's frame [rad]."""
    pivot: Point | None = None
    """3-PPR: where the platform turns on the cross slide, in the platform's frame [m]."""
    slide_angle: Angle | None = None
    """3-PPR: direction of the cross slide in the base frame [rad]; at right angles to the rail when absent."""


class GeometryTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [geometry]: the paper's symmetric robot by `l0`, or three measured legs."""

    kind: Literal["3-PRP", "3-PPR"] = "3-PRP"
    """Where the pivot is: on the driven carriage, below a cross slide that turns with the platform (3-PRP, alignment
    stages of kind 1), or on a cross slide that keeps its direction (3-PPR, kind 2)."""
    l0: Annotated[float, Meta(ge=0.001, le=100.0)] | None = None
    """From the centre to where each rail of the paper's symmetric robot begins [m]; instead of three legs."""
    leg: tuple[LegTable, LegTable, LegTable] | None = None
    labels: tuple[Label, Label, Label] = NAMES
    """What people call the sliders A, B, C, as U, V, W: in all that they read. One to four letters and digits."""


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


_THREE = Meta(min_length=3, max_length=3)
_EACH = Meta(description="one number for all sliders, or three: of A, B, C")
# msgspec 0.22 keeps bounds of a number and the length of a fixed array in one place: a union of both ends the
# interpreter. So these arrays are of any length by their type.
EachVelocity = Annotated[Velocity | Annotated[tuple[Velocity, ...], _THREE], _EACH]
EachAcceleration = Annotated[Acceleration | Annotated[tuple[Acceleration, ...], _THREE], _EACH]
EachJerk = Annotated[Jerk | Annotated[tuple[Jerk, ...], _THREE], _EACH]
EachRange = Annotated[
    tuple[Coordinate | Annotated[tuple[Coordinate, ...], Meta(min_length=2, max_length=2)], ...],
    Meta(description="a pair for all sliders, or three pairs: of A, B, C"),
]


class SliderLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [limits.slider]."""

    position: EachRange
    """Travel of lambda_10 [m]."""
    passive: Range
    """Travel of the cross slides, which have no drive [m]; of 3-PRP they are the platform's edges."""
    velocity: EachVelocity
    """Greatest rate of each slider [m/s]."""
    acceleration: EachAcceleration
    """Greatest acceleration of each slider [m/s²]."""
    jerk: EachJerk
    """Greatest jerk of each slider [m/s³]."""
    following_error: Distance
    """Setpoint less measured position beyond which everything stops [m]; less than `[drives] following_error`."""

    def __post_init__(self) -> None:
        pairs = sum(isinstance(each, tuple) for each in self.position)
        if (len(self.position), pairs) not in {(2, 0), (3, 3)}:
            raise ValueError("Field `position` has neither shape")

    def keys(self, limit: str) -> tuple[str, str, str]:
        """Where each slider's position, velocity, acceleration or jerk stands: its key, with [0] if there are three."""
        given = getattr(self, limit)
        own = isinstance(given, tuple) and len(given) == len(NAMES)
        a, b, c = (f"limits.slider.{limit}[{k}]" if own else f"limits.slider.{limit}" for k in range(3))
        return a, b, c

    @property
    def positions(self) -> tuple[Range, Range, Range]:
        """Travel of each slider [m]."""
        return cast("tuple[Range, Range, Range]", self.position if len(self.position) == 3 else (self.position,) * 3)

    @property
    def velocities(self) -> Triple:
        """Greatest rate of each slider [m/s]."""
        return _of_each(self.velocity)

    @property
    def accelerations(self) -> Triple:
        """Greatest acceleration of each slider [m/s²]."""
        return _of_each(self.acceleration)

    @property
    def jerks(self) -> Triple:
        """Greatest jerk of each slider [m/s³]."""
        return _of_each(self.jerk)

    @property
    def fastest(self) -> float:
        """The greatest rate of any slider [m/s]."""
        return max(self.velocities)


def _of_each(limit: float | tuple[float, ...]) -> Triple:
    a, b, c = limit if isinstance(limit, tuple) else (limit,) * 3
    return a, b, c


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
    unixsock-stream for those whom the socket's file lets, tls with [zenoh.tls] for the network. At a port
    1000 higher, or PATH.stop, the service takes stops alone."""
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

    def beside(self, folder: Path) -> Zenoh:
        """Return it with the certificates' folder as it is called from here, where the file is in `folder`."""
        if self.tls is None:
            return self
        return structs.replace(self, tls=structs.replace(self.tls, directory=str(folder / self.tls.directory)))


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
    if table.l0 is not None and table.kind != "3-PRP":
        raise ConfigError(
            f"geometry: l0 is the paper's 3-PRP robot: for {table.kind} give three [[geometry.leg]] tables"
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
    """Return what people call the sliders. Raises ConfigError where one could be taken for another, or an answer."""
    given = dict(zip(NAMES, table.labels, strict=True))
    for name, label in given.items():
        others = [word for other in NAMES if other != name for word in (other, given[other])]
        if label.casefold() in (word.casefold() for word in (*others, "n", "q")):
            raise ConfigError(
                f"geometry.labels: {label} for slider {name}: wanted is what is neither label nor letter of another, "
                "nor n or q, which are answers to trirail commission"
            )
    return table.labels


_OF_KIND = {"3-PRP": ("edge_point", "edge_angle"), "3-PPR": ("pivot", "slide_angle")}
"""The keys of a leg that are one mechanism's alone."""
_WORDS = {"3-PRP": "the platform's edge turns with it", "3-PPR": "the cross slide keeps its direction"}


def _leg(kind: str, name: str, table: LegTable) -> AnyLeg:
    """Build a leg, of what its mechanism has. Raises ConfigError."""
    for other, keys in _OF_KIND.items():
        for key in keys:
            if other != kind and getattr(table, key) is not None:
                raise ConfigError(
                    f"geometry: leg {name} has {key}, which is of kind {other} ({_WORDS[other]}); "
                    f"kind is {kind}, with {' and '.join(_OF_KIND[kind])}"
                )
    point, angle = (getattr(table, key) for key in _OF_KIND[kind])
    if point is None or (angle is None and kind == "3-PRP"):
        missing = _OF_KIND[kind][0 if point is None else 1]
        raise ConfigError(f"geometry: leg {name} has no {missing}, which kind {kind} needs")
    if kind == "3-PRP":
        return Leg(table.anchor, table.rail_angle, table.home, point, angle)
    return CrossLeg(table.anchor, table.rail_angle, table.home, point, angle)


def corrected_geometry(config: Config) -> Geometry:
    """Build the robot's geometry with the correction, where it has one. Raises ConfigError."""
    robot, found = geometry(config.geometry), config.correction.as_built
    return dataclasses.replace(robot, correction=as_built.correction(found)) if found is not None else robot


def room(limits: Limits) -> Room:
    """Return where the robot may be."""
    low, high = np.transpose([limits.platform.x, limits.platform.y, limits.platform.phi]).tolist()
    return Room(low, high, limits.slider.positions, limits.slider.passive)
