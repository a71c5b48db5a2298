"""Publications of the gateway: state, summary, records and events with their history; and the reply on …/info."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh
from numpy.typing import NDArray
from trirail_drivers.interface import NAMES, PowerState, Triple
from zenoh.ext import CacheConfig, MissDetectionConfig, RepliesConfig, declare_advanced_publisher

from trirail.config import Config, as_built, geometry
from trirail.processes.operating_system import machine
from trirail.telemetry.provenance import software, versions
from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import Event
from trirail.wire.packets import Status, Welcome
from trirail.wire.records import Part
from trirail.wire.state import (
    CommandedMotion,
    DigitalLine,
    FrameCounts,
    GoalState,
    Info,
    LoopState,
    Percentiles,
    Pose,
    RobotSummary,
    Sliders,
    State,
)
from trirail.wire.vocabulary import MODES, Mode

EVENTS_KEPT = 1000
"""Number of past events that a newly connected client can request."""
_HISTORY_REPLIES = RepliesConfig(
    priority=zenoh.Priority.BACKGROUND, congestion_control=zenoh.CongestionControl.BLOCK, express=False
)


class Publications:
    """Publishers on a robot's keys.

    States, summaries and records that a slow subscriber cannot receive are dropped. Events wait for the subscriber.
    `run` is the identity of this run of the service, which clients receive with each event.
    """

    def __init__(self, session: zenoh.Session, robot: str, run: str = "") -> None:
        self._run = run

        def dropping(name: str, encoding: str, priority: zenoh.Priority) -> zenoh.Publisher:
            return session.declare_publisher(
                zenoh_session.key(robot, name),
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
            )

        self._state = dropping("state", boundary.JSON, zenoh.Priority.DATA_HIGH)
        self._summary = dropping("summary", boundary.JSON, zenoh.Priority.DATA)
        self._records = dropping("records", boundary.BINARY, zenoh.Priority.DATA_LOW)
        self._event = declare_advanced_publisher(
            session,
            zenoh_session.key(robot, "event"),
            encoding=boundary.JSON,
            # The history is sent in a separate queue, so that a slow subscriber does not delay anything else.
            cache=CacheConfig(max_samples=EVENTS_KEPT, replies_config=_HISTORY_REPLIES),
            sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def state(self, state: State) -> None:
        """Publish the newest state."""
        self._state.put(msgspec.json.encode(state))

    def summary(self, summary: RobotSummary) -> None:
        """Publish the newest summary."""
        self._summary.put(msgspec.json.encode(summary))

    def records(self, batch: bytes) -> None:
        """Publish packed records in the format of wire.records."""
        self._records.put(batch)

    def event(self, event: Event) -> None:
        """Publish an event, and store it for clients that subscribe later."""
        self._event.put(msgspec.json.encode(msgspec.structs.replace(event, run=self._run)))


def _bits(named: Mapping[str, tuple[int, int]], words: NDArray[np.uint32]) -> dict[str, bool]:
    """Return the values of bits by name. `named` contains the index of the drive and the mask of each bit."""
    return {name: bool(int(words[axis]) & bit) for name, (axis, bit) in named.items()}


WINDOW = 60.0
"""Period over which the timing statistics are calculated [s]."""

_ENABLED = [MODES.index(mode) for mode in (Mode.HOLDING, Mode.MOVING, Mode.STOPPING)]
_NONE = Percentiles(0.0, 0.0, 0.0, 0.0)


def wall_offset_ns() -> int:
    """Return the present wall-clock time minus the monotonic time [ns]; it changes if the wall clock is set."""
    return time.time_ns() - time.monotonic_ns()


class StateMaker:
    """Builder of states from the newest record, from the loop's other messages, and from timing statistics.

    `offset_ns` is a function that returns wall-clock time minus monotonic time [ns].
    """

    def __init__(self, config: Config, offset_ns: Callable[[], int] = wall_offset_ns) -> None:
        self._period = config.period
        self._offset_ns = offset_ns
        self._outputs = {name: (NAMES.index(each.drive), 1 << each.bit) for name, each in config.outputs.items()}
        self._inputs = {name: (NAMES.index(each.drive), 1 << each.bit) for name, each in config.inputs.items()}
        self._rate_hz = config.loop.rate_hz
        self._lateness = _RecentValues(round(WINDOW / config.period))
        self._cycle = _RecentValues(round(WINDOW / config.period))
        self._setpoints = _RecentValues(round(WINDOW / config.period))
        self._statistics = [_NONE, _NONE, _NONE]
        self._statistics_due = 0
        self._newest: Any = None
        self._velocity: NDArray[np.float64] | None = None
        """Velocity between the last two records; None if there is none, because a position became known or unknown."""
        self._acceleration = np.zeros(3)
        self._error_max = np.zeros(3)
        self._welcome = Welcome((), 0.0)
        self._status = Status(None, 1.0, None)

    def update(self, news: Status | Welcome) -> None:
        """Store a status or a welcome from the loop for the following states."""
        if isinstance(news, Welcome):
            self._welcome = news
        else:
            self._status = news

    def records(self, rows: NDArray[np.void]) -> None:
        """Store the newest record of a batch, and update the velocities and the statistics."""
        newest, before = rows[-1], self._newest
        velocity, self._acceleration = None, np.zeros(3)
        if before is not None and np.array_equal(newest["homed"], before["homed"]):
            # Velocities are differences over a batch, not over a cycle: at 1 kHz, one encoder count per cycle would be
            # a large step in velocity.
            span = (int(newest["cycle"]) - int(before["cycle"])) * self._period
            velocity = (newest["pose"] - before["pose"]) / span
            if self._velocity is not None:
                self._acceleration = (velocity - self._velocity) / span
        self._velocity = velocity
        self._newest = newest.copy()
        enabled = rows["following_error"][np.isin(rows["mode"], _ENABLED)]
        if len(enabled):
            self._error_max = np.maximum(self._error_max, np.abs(enabled).max(axis=0))
        self._lateness.extend(rows["lateness_ns"])
        self._cycle.extend(rows["parts_ns"].sum(axis=1))
        self._setpoints.extend(rows["lateness_ns"] + rows["parts_ns"][:, : Part.WRITE + 1].sum(axis=1))
        if newest["cycle"] >= self._statistics_due:
            self._statistics_due = int(newest["cycle"]) + self._rate_hz
            each = self._lateness, self._cycle, self._setpoints
            self._statistics = [values.percentiles() for values in each]

    @property
    def lease(self) -> str | None:
        """User who holds the lease; None if the lease is free."""
        return self._status.lease

    @property
    def cycle(self) -> int:
        """Cycle of the newest record; 0 before the first record has arrived."""
        return 0 if self._newest is None else int(self._newest["cycle"])

    def newest(self, warnings: tuple[str, ...] = ()) -> State:
        """Return the state at the newest record, with the given warnings."""
        row = self._newest
        lateness, cycle, setpoints = self._statistics
        goal, target = self._status.goal, self._status.target
        a, b, c = self._status.counts
        offset = row["backlash"]  # contained in the positions of the drives, but not in those of the sliders
        return State(
            seq=int(row["cycle"]),
            t=round(int(row["cycle"]) * self._period, 9),
            time=round((int(row["deadline_ns"]) + self._offset_ns()) * 1e-9, 6),
            mode=MODES[row["mode"]],
            pose=Pose(*row["pose"].tolist()),
            velocity=_triple(np.zeros(3) if self._velocity is None else self._velocity),
            acceleration=_triple(self._acceleration),
            commanded=CommandedMotion(
                pose=Pose(*row["commanded_pose"].tolist()),
                pose_velocity=_triple(row["commanded_pose_velocity"]),
                pose_acceleration=_triple(row["commanded_pose_acceleration"]),
                position=_triple(row["commanded_position"] - offset),
                velocity=_triple(row["commanded_velocity"]),
                acceleration=_triple(row["commanded_acceleration"]),
            ),
            sliders=Sliders(
                position=_triple(row["position"] - offset),
                velocity=_triple(row["velocity"]),
                following_error=_triple(row["following_error"]),
                following_error_max=_triple(self._error_max),
                status=tuple(str(PowerState(state)) for state in row["drive_state"]),  # type: ignore[arg-type]
                traffic=(FrameCounts(*a), FrameCounts(*b), FrameCounts(*c)),
                homed=tuple((row["homed"] != 0).tolist()),
            ),
            goal=GoalState(
                goal, float(row["progress"]), float(row["remaining"]), target and Pose(*target), self._status.lag
            )
            if goal
            else None,
            settled=bool(row["settled"]),
            override=self._status.override,
            lease=self._status.lease,
            outputs=_bits(self._outputs, row["outputs"]),
            inputs=_bits(self._inputs, row["inputs"]),
            faults=tuple(dict.fromkeys(filter(None, (self._status.fault, *self._status.unready)))),
            warnings=(*warnings, self._status.unrecorded) if self._status.unrecorded else warnings,
            loop=LoopState(
                rate_hz=self._rate_hz,
                cycles=int(row["cycle"]),
                overruns=int(row["overruns"]),
                lateness_us=lateness,
                cycle_us=cycle,
                setpoints_us=setpoints,
                setpoint_budget_us=round(max(0.0, 1.0 - self._welcome.bus_load) * self._period * 1e6, 1),
                bus_load=self._welcome.bus_load,
                bus_load_measured=self._status.bus_load,
                lacking=self._welcome.lacking,
            ),
        )


class _RecentValues:
    """Ring buffer of the most recent values [ns]."""

    def __init__(self, size: int) -> None:
        self._values = np.zeros(size, dtype=np.int64)
        self._next = 0
        self._full = False

    def extend(self, values: NDArray[np.int64]) -> None:
        places = (self._next + np.arange(len(values))) % len(self._values)
        self._values[places] = values
        self._full = self._full or self._next + len(values) >= len(self._values)
        self._next = (self._next + len(values)) % len(self._values)

    def percentiles(self) -> Percentiles:
        values = self._values if self._full else self._values[: self._next]
        if not len(values):
            return _NONE
        p50, p99, p999, most = (np.percentile(values, (50.0, 99.0, 99.9, 100.0)) / 1000.0).tolist()
        return Percentiles(round(p50, 1), round(p99, 1), round(p999, 1), round(most, 1))


def _triple(values: NDArray[np.float64]) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def info(config: Config) -> Info:
    """Return the reply to queries on …/info for a configuration."""
    live = config.telemetry.live_port
    legs: list[dict[str, Any]] = []
    for name, leg in zip(NAMES, geometry(config.geometry).each, strict=True):
        legs.append({"name": name} | leg.keys())
    return Info(
        robot=config.robot.name,
        version=software().trirail,
        machine=machine(),
        geometry=tuple(legs),
        mechanism=config.geometry.kind,
        labels=config.geometry.labels,
        limits=msgspec.to_builtins(config.limits),
        frames=msgspec.to_builtins(config.frames),
        rate_hz=config.loop.rate_hz,
        state_hz=config.telemetry.state_hz,
        recordings=str(Path(config.telemetry.directory).resolve()),
        live=f"rerun+http://127.0.0.1:{live}/proxy" if live else "",
        lease=config.control.lease,
        takeover=config.control.takeover.value,
        outputs=tuple(config.outputs),
        inputs=tuple(config.inputs),
        output_lines={name: DigitalLine(each.drive, each.bit) for name, each in config.outputs.items()},
        input_lines={name: DigitalLine(each.drive, each.bit) for name, each in config.inputs.items()},
        homes=tuple(name for name, drive in zip(NAMES, config.drives.each, strict=True) if drive.homing is not None),
        versions=versions(),
        correction=as_built.summary(config.correction.map, config.correction.as_built, config.correction.backlash),
    )
