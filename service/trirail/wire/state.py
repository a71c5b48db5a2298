"""What the service publishes of the robot, and what it answers on …/info and …/poses.

SI units and radians, if not said otherwise. Sliders are in the order A, B, C; poses are x, y [m] of the platform's
centre and its angle phi [rad], counterclockwise, in the base frame.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
from msgspec import Struct
from trirail_drivers.interface import MissingProtection, Triple

from trirail.wire.vocabulary import LeasePolicy, Role


class Pose(NamedTuple):
    """A pose of the platform; on the wire an array of three numbers."""

    x: float
    """[m]."""
    y: float
    """[m]."""
    phi: float
    """Counterclockwise [rad]."""


class Commanded(Struct, frozen=True):
    """Commanded motion of the platform and of the sliders."""

    pose: Pose
    """Pose of the platform's centre in the base frame."""
    pose_velocity: Triple
    """[m/s, m/s, rad/s]."""
    pose_acceleration: Triple
    """[m/s², m/s², rad/s²]."""
    position: Triple
    """lambda_10 of the sliders A, B, C [m], without what takes up backlash."""
    velocity: Triple
    """Of the drives, with what takes up backlash [m/s]."""
    acceleration: Triple
    """Of the drives, with what takes up backlash [m/s²]."""


class FrameCounts(Struct, frozen=True):
    """What of a drive's cyclic frames went wrong since the service started; none of it is a fault by itself."""

    feedback_late: int
    """Positions that came a cycle later than the one before did."""
    feedback_lost: int
    """SYNCs that were never answered, as far as later answers show."""
    setpoints_late: int
    """Setpoints written after the next SYNC was due."""
    setpoints_lost: int
    """Setpoints that the bus did not take."""


class Sliders(Struct, frozen=True):
    """What the drives say, of A, B, C."""

    position: Triple
    """lambda_10 [m]: what the drives say, without what takes up backlash."""
    velocity: Triple
    """[m/s]."""
    following_error: Triple
    """Setpoint less measured position [m]."""
    following_error_max: Triple
    """Greatest since the service started, while enabled [m]."""
    status: tuple[str, str, str]
    """The power state of each, by its name in CiA 402."""
    traffic: tuple[FrameCounts, FrameCounts, FrameCounts]
    """Frames of each that were late or lost."""


class GoalState(Struct, frozen=True):
    """The goal under way."""

    id: str
    """As it was sent, or as the service made it."""
    progress: float
    """Share of its path's time that is over, 0 to 1; 1 while it settles."""
    remaining: float
    """Time to the end of its path at the present override [s], were it not to wait, paused or at 0: there it is as at
    100 %. 0 while it settles."""
    target: Pose | None = None
    """The pose that it leads to, of a track that its target was last told to have; None for a jog."""
    lag: float | None = None
    """Of a track: how far a point of the platform was at most from where the target had it, when it was last renewed
    [m]."""


class Percentiles(Struct, frozen=True):
    """Over the service's last 60 s [µs]."""

    p50: float
    """The median."""
    p99: float
    """What one cycle in a hundred exceeds."""
    p999: float
    """What one cycle in a thousand exceeds."""
    max: float
    """The greatest."""


class LoopState(Struct, frozen=True):
    """How well the loop keeps its time."""

    rate_hz: int
    """Cycles a second, as configured."""
    cycles: int
    """SYNCs sent since the service started."""
    overruns: int
    """Ticks missed since the service started; none is caught up."""
    lateness_us: Percentiles
    """How much after its deadline a cycle began [µs]."""
    cycle_us: Percentiles
    """How long a cycle worked [µs]."""
    bus_load: float
    """Worst-case share of the bus that the cycle takes, as computed at the start."""
    bus_load_measured: float
    """Share of the bus that the frames sent and heard took in the last second, counted with worst-case stuffing.
    Frames of strangers count only where all is heard: with `capture_can`, or where no kernel filters them out."""
    lacking: tuple[str, ...]
    """What the loop runs without: real-time rights and the like, each with its remedy."""


class State(Struct, frozen=True):
    """The newest state, published at state_hz."""

    seq: int
    """The cycle of its record."""
    t: float
    """Nominal time since the loop's start [s]; the same as in records and events."""
    mode: str
    """A trirail.wire.vocabulary.Mode."""
    pose: Pose
    """Measured pose of the platform's centre in the base frame, by the forward kinematics of the measured sliders,
    with [correction] where there is one."""
    velocity: Triple
    """Measured, as a difference over a batch of records [m/s, m/s, rad/s]."""
    acceleration: Triple
    """Measured, as a difference over a batch of records [m/s², m/s², rad/s²]."""
    commanded: Commanded
    """What the drives were told in the same cycle."""
    sliders: Sliders
    """What the drives say."""
    goal: GoalState | None
    """The goal under way, or paused; None where there is none."""
    settled: bool
    """Whether the robot stands where it is commanded to, by what was measured for the dwell of [limits.in_position]."""
    override: float
    """The share of full speed at which motions are to run, 0 to 2."""
    faults: tuple[str, ...]
    """Why the robot is in fault, one line each; empty otherwise."""
    loop: LoopState
    """How well the loop keeps its time."""
    warnings: tuple[str, ...] = ()
    """What people should know of how the service is run, one line each: that it is open to a network, that its
    certificate expires soon, or that nothing is recorded, or no CAN frames, and why."""
    lease: str | None = None
    """The user who holds the lease: his goals and commands alone move the robot; None where nobody does."""


SUMMARY_BYTES = 300
"""A summary is shorter than that, as JSON."""
SUMMARY_TEXT = 80
"""What a text of a summary takes at most, as JSON [bytes]; longer ones end in …."""


class RobotSummary(Struct, frozen=True):
    """What a fleet reads of a robot, published once a second."""

    mode: str
    """A trirail.wire.vocabulary.Mode."""
    fault: str | None
    """Why the robot is in fault, shortened; None where it is not."""
    goal: str | None
    """The id of the goal under way, shortened."""
    lateness: float
    """99.9 % of the last minute's cycles began no later after their deadlines [µs]."""
    missed: int
    """Ticks missed since the service started."""
    age: float
    """How long ago the loop last said something, when this was sent [s]."""
    version: str
    """Of the service's software."""


def summary_of(state: State, age: float, version: str) -> RobotSummary:
    """Make the summary of a state that is so old [s]."""
    fault = _shortened("; ".join(state.faults)) if state.faults else None
    goal = _shortened(state.goal.id) if state.goal else None
    loop = state.loop
    return RobotSummary(state.mode, fault, goal, loop.lateness_us.p999, loop.overruns, round(age, 2), version)


def _shortened(text: str) -> str:
    if len(msgspec.json.encode(text)) <= SUMMARY_TEXT:
        return text
    while len(msgspec.json.encode(f"{text}…")) > SUMMARY_TEXT:
        text = text[:-1]
    return f"{text}…"


class CorrectionTold(Struct, frozen=True):
    """What the robot's as-built errors are corrected by."""

    file: str
    """The map's; "" for none."""
    made: str
    """When the robot was measured for it; "" for none."""
    greatest: Triple
    """The greatest correction in x, y [m] and phi [rad]."""
    backlash: Triple
    """Of the sliders A, B, C, as it is taken up [m]."""


class Info(Struct, frozen=True):
    """What a client needs to know the robot: answered on …/info."""

    robot: str
    """Its name, as in every key."""
    version: str
    """Of the service's software."""
    geometry: tuple[dict[str, object], ...]
    """The legs A, B, C: `name`, and the keys of [[geometry.leg]] of the configuration [m, rad]."""
    limits: object
    """Section [limits] of the configuration, whole: metres, radians, seconds."""
    frames: object
    """Section [frames] of the configuration: points of the platform and work frames that goals may name [m, rad]."""
    rate_hz: int
    """Cycles a second."""
    state_hz: int
    """How often a second the state is published."""
    recordings: str
    """The folder of the service's recordings, on its machine."""
    live: str
    """Where a Rerun viewer on the service's machine finds the live view; "" for nowhere."""
    lease: LeasePolicy = "optional"
    """Whether the robot can be moved while nobody holds the lease."""
    homes: tuple[str, ...] = ()
    """The sliders whose encoders are not absolute: they have no position until the command home."""
    versions: dict[str, str] = msgspec.field(default_factory=dict)
    """Of Python and the libraries that matter, by name."""
    missing_protections: tuple[MissingProtection, ...] = ()
    """What the drives do without; none where they have all."""
    correction: CorrectionTold | None = None
    """Of as-built errors; None where the robot is taken for its geometry."""
    mechanism: str = "3-PRP"
    """Key [geometry] kind of the configuration, which says what the keys of its legs are."""
    labels: tuple[str, str, str] = ("A", "B", "C")
    """What people call the sliders A, B, C: key [geometry] labels of the configuration."""
    takeover: str = Role.MAINTAINER.value
    """A trirail.wire.vocabulary.Role, the least that may take the lease over: key [control] takeover of the
    configuration."""


class NamedPose(Struct, frozen=True):
    """A pose of the platform's centre in the base frame that goals may name: the reply on …/teach and …/forget."""

    name: str
    """Letters, digits, - and _."""
    x: float
    """[m]."""
    y: float
    """[m]."""
    phi: float
    """Counterclockwise [rad]."""
    taught: bool
    """Whether it was taught, and can be taught anew or removed; else it is one of [poses] of the configuration."""
    other_geometry: bool = False
    """True if it was taught with another [geometry] than the service has: look at it, and teach it again."""


class NamedPoses(Struct, frozen=True):
    """All that there are, answered on …/poses."""

    poses: tuple[NamedPose, ...]
    """By name."""
