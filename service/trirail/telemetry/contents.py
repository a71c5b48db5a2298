"""What is in a recording, for the index of sessions: robot, time, users, goals, faults; counted, or read from it."""

from __future__ import annotations

import re
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import msgspec

from trirail.errors import ConfigError, EmptyRecordingError, ServiceError
from trirail.telemetry import provenance
from trirail.telemetry.reading import read
from trirail.telemetry.retention import BLACK_BOX
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest, Looked, RefusedRequest
from trirail.wire.records import DTYPE, unpack

_PART = re.compile(r"-part\d+(-\d+)?$")
STAMP = "%Y%m%d-%H%M%S"
"""In the names of recordings: the local time at which they began; of a black box that of its fault."""


class FaultEntry(NamedTuple):
    """A fault."""

    time: float
    """[s since 1970]."""
    fault: FaultDetail
    message: str


class Contents(msgspec.Struct):
    """What is in one file; users, goals and faults come in the order of their first."""

    name: str
    """The file's."""
    robot: str
    began: float | None = None
    """Of its first record [s since 1970]; None where there is none."""
    ended: float | None = None
    """Of its last record."""
    cycles: int = 0
    users: dict[str, None] = msgspec.field(default_factory=dict)
    """Who sent goals or commands."""
    goals: Counter[tuple[str, str]] = msgspec.field(default_factory=Counter)
    """How many of whose goals ended how: user, outcome."""
    faults: list[FaultEntry] = msgspec.field(default_factory=list)
    reason: str | None = None
    """Of a black box: the fault for which it was kept."""
    trouble: str | None = None
    """Why it could not be read."""
    running: bool = False
    """Whether it is still being written, and this is what has been so far."""

    @property
    def session(self) -> str:
        """The session's name: that of its first file, without suffix."""
        return _PART.sub("", Path(self.name).stem)

    def records(self, batch: bytes, wall_offset_ns: int) -> None:
        """Take packed records; the offset is of the wall clock from the monotonic one."""
        rows = unpack(batch)
        first, last = ((int(row["deadline_ns"]) + wall_offset_ns) * 1e-9 for row in (rows[0], rows[-1]))
        self.began = first if self.began is None else self.began
        self.ended = last
        self.cycles += len(batch) // DTYPE.itemsize

    def event(self, event: Event) -> None:
        """Take an event."""
        if event.outcome is not None:
            self.goals[event.user or "", event.outcome] += 1
        if event.kind == "fault":
            self.faults.append(FaultEntry(event.time, event.fault or FaultDetail(""), event.message))

    def control_input(self, what: ControlInput) -> None:
        """Take what the control was given."""
        match what.given:
            case GoalRequest(user=user) | CommandRequest(user=user) | RefusedRequest(user=user) | Looked(user=user) if (
                user
            ):
                self.users[user] = None


def of_file(path: Path) -> Contents:
    """Read what is in a recording; of one that cannot be read, why."""
    found = Contents(path.name, "")
    try:
        recording = read(path)
        config = provenance.configuration(recording.texts)
    except EmptyRecordingError:
        return found
    except (ServiceError, ConfigError, OSError) as error:
        found.trouble = str(error)
        return found
    found.robot = config.robot.name if config is not None else ""
    found.cycles = len(recording.records)
    found.began, found.ended = (
        float(wall.astype("datetime64[ns]").astype(int)) * 1e-9 for wall in recording.wall[[0, -1]]
    )
    for line in recording.events:
        if line.event is not None:
            found.event(line.event)
    for what in recording.requests:
        found.control_input(what)
    if path.name.startswith(BLACK_BOX):
        found.reason = _reason(found)
    return found


def _reason(found: Contents) -> str | None:
    """The fault whose time is in the name of a black box; without one, its last."""
    for _, _, message in (fault for fault in found.faults if box_name(fault.time) in found.name):
        return message
    return found.faults[-1].message if found.faults else None


def box_name(fault_time: float) -> str:
    """Return the name of the black box of a fault at a time [s since 1970], without suffix."""
    return f"{BLACK_BOX}{datetime.fromtimestamp(fault_time).astimezone():{STAMP}}"
