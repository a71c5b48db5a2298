"""What goes over Zenoh: goals, replies, state, events. JSON by default; SI units and radians."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

MAX_MESSAGE = 4096
"""A goal or command longer than this is refused before it is decoded [bytes]."""

Identifier = Annotated[str, Meta(min_length=1, max_length=64)]
Level = Literal["info", "warning", "error"]
Outcome = Literal["done", "rejected", "preempted", "stopped", "expired", "faulted"]
Triple = tuple[float, float, float]


class PoseGoal(Struct, frozen=True, forbid_unknown_fields=True, tag_field="kind", tag="pose"):
    """Move the platform to a pose, straight in pose space where the start allows."""

    x: float
    y: float
    phi: float
    id: Identifier | None = None
    speed: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    """Fraction of full speed: 0.5 takes twice as long over the same path."""
    valid_for: Annotated[float, Meta(gt=0.0)] | None = None
    """The goal expires unless it starts within so many seconds."""

    def __post_init__(self) -> None:
        for name in ("x", "y", "phi", "speed", "valid_for"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} is {value}: it must be a finite number")


class GoalReply(Struct, frozen=True):
    """A goal was accepted; it ends in exactly one event."""

    id: str
    duration: float
    """Expected time from now to arrival [s]."""
    accepted: Literal[True] = True


class CommandReply(Struct, frozen=True):
    """A command was carried out."""

    command: str
    mode: str
    ok: Literal[True] = True


class ErrorReply(Struct, frozen=True, omit_defaults=True):
    """A goal or command was refused; nothing moved because of it."""

    code: str
    message: str
    slider: str | None = None
    value: float | None = None
    limit: float | None = None


class Event(Struct, frozen=True, omit_defaults=True):
    """Something that happened, in order, numbered without gaps by the loop."""

    seq: int
    t: float
    """Nominal time since the loop's start [s]; the same as in records."""
    cycle: int
    time: float
    """Wall clock [s since 1970]."""
    kind: Literal["goal", "mode", "fault", "refused", "service"]
    level: Level
    message: str
    """One line for people."""
    mode: str | None = None
    """The mode entered, with kind mode."""
    id: str | None = None
    """The goal's id, with kind goal."""
    outcome: Outcome | None = None
    """How the goal ended, with kind goal."""
    user: str | None = None


class Commanded(Struct, frozen=True):
    """What the robot was told: platform, then sliders."""

    pose: Triple
    pose_velocity: Triple
    pose_acceleration: Triple
    position: Triple
    velocity: Triple
    acceleration: Triple


class Sliders(Struct, frozen=True):
    """What the drives say."""

    position: Triple
    velocity: Triple
    following_error: Triple
    following_error_max: Triple
    """Greatest since the service started, while enabled."""
    status: tuple[str, str, str]


class GoalState(Struct, frozen=True):
    """The goal under way."""

    id: str
    progress: float
    remaining: float


class Percentiles(Struct, frozen=True):
    """Over the service's last 60 s [µs]."""

    p50: float
    p99: float
    p999: float
    max: float


class LoopState(Struct, frozen=True):
    """How well the loop keeps its time."""

    rate_hz: int
    cycles: int
    overruns: int
    lateness_us: Percentiles
    cycle_us: Percentiles
    bus_load: float
    lacking: tuple[str, ...]
    """What the loop runs without: real-time rights and the like, each with its remedy."""


class State(Struct, frozen=True):
    """The newest state, published at state_hz."""

    seq: int
    t: float
    mode: str
    pose: Triple
    velocity: Triple
    acceleration: Triple
    commanded: Commanded
    sliders: Sliders
    goal: GoalState | None
    override: float
    lease: str | None
    faults: tuple[str, ...]
    loop: LoopState


class Info(Struct, frozen=True):
    """What a client needs to know the robot: answered on …/info."""

    robot: str
    version: str
    geometry: tuple[dict[str, object], ...]
    limits: object
    rate_hz: int
    state_hz: int
    recordings: str
    """The folder of the service's recordings, on its machine."""
    live: str
    """Where a Rerun viewer on the service's machine finds the live view; "" for nowhere."""
    versions: dict[str, str] = msgspec.field(default_factory=dict)
