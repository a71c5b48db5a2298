"""Contents of a recording: robot, time span, users, goals and faults.

The recorder collects the contents while it records. They can also be read from a recording. They are stored as JSON in
a file next to the recording, called its sidecar, so that a search for sessions does not need to read the recordings.
"""

from __future__ import annotations

import stat
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from trirail_drivers import files

from trirail.errors import ConfigError, ServiceError
from trirail.naming import BLACK_BOX
from trirail.telemetry.retention import STAMP, is_black_box, robot_in, session_of, sidecar
from trirail.wire.decoding import INVALID, decoded, prepare
from trirail.wire.messages import Event, FaultDetail, Notice, Outcome
from trirail.wire.packets import Announcement, CheckRequest, CommandRequest, ControlInput, GoalRequest

WallTime = Annotated[float, Meta(ge=0.0, le=1e11)]
"""Time [s since 1970], before the year 5138."""


class FaultEntry(msgspec.Struct):
    """Fault in a recording."""

    time: WallTime
    """Time of the fault [s since 1970]."""
    fault: FaultDetail
    message: str

    @property
    def code(self) -> str:
        """Cause and code, such as "emcy 0x8700"."""
        return f"{self.fault.cause} 0x{self.fault.code:04X}"


class Contents(msgspec.Struct):
    """Contents of one recording file."""

    name: str
    """Name of the file."""
    robot: str
    began: WallTime | None = None
    """Time of the first record [s since 1970]; None if the file contains no records."""
    ended: WallTime | None = None
    """Time of the last record [s since 1970]; None if the file contains no records."""
    cycles: int = 0
    """Number of cycles in the file."""
    users: set[str] = msgspec.field(default_factory=set)
    """Users who sent goals or commands."""
    goals: dict[str, dict[Outcome, int]] = msgspec.field(default_factory=dict)
    """Number of finished goals, by user and then by outcome."""
    faults: list[FaultEntry] = msgspec.field(default_factory=list)
    reason: str | None = None
    """Message of the fault for which the black box was saved; None if the file is not a black box."""
    trouble: str | None = None
    """Reason why the file could not be read; None if it was read."""
    running: bool = False
    """True while the file is still being written. The contents are then not final."""
    version: Literal[1] = 1
    """Version of the format of the sidecar; sidecars of other versions are ignored."""
    lost_cycles: int = 0
    """Number of cycles that the recorder could not write; 0 if the contents were read from the recording."""
    rate_hz: int = 0
    """Cycles per second; 0 if unknown, as in sidecars of earlier versions."""

    @property
    def duration(self) -> float:
        """Time that was recorded [s], from the cycles, because the wall clock may have been set meanwhile."""
        if self.rate_hz > 0:
            return self.cycles / self.rate_hz
        return max(0.0, self.ended - self.began) if self.began is not None and self.ended is not None else 0.0

    @property
    def session(self) -> str:
        """Name of the session to which the file belongs: the name of the session's first file, without suffix."""
        return session_of(self.name)

    def add_cycles(self, began: float, ended: float, count: int) -> None:
        """Add `count` cycles, of which the first was at `began` and the last at `ended` [s since 1970]."""
        self.began = began if self.began is None else self.began
        self.ended = ended
        self.cycles += count

    def event(self, event: Event) -> None:
        """Add the finished goal or the fault that an event reports."""
        if event.outcome is not None:
            ended = self.goals.setdefault(event.user or "", {})
            ended[event.outcome] = ended.get(event.outcome, 0) + 1
        if event.kind == "fault":
            self.faults.append(FaultEntry(event.time, event.fault or FaultDetail(""), event.message))

    def control_input(self, item: ControlInput) -> None:
        """Add the user who sent an input to the control loop."""
        match item.given:
            case GoalRequest(user=user) | CheckRequest(user=user) | CommandRequest(user=user) if user:
                self.users.add(user)
            case Announcement(notice=Notice(kind="refused" | "alignment", user=str(user))) if user:
                self.users.add(user)


prepare(Contents)


def save(recording: Path, contents: Contents) -> None:
    """Save contents in the sidecar of a recording, with the same permissions as the recording. Raises OSError."""
    mode = stat.S_IMODE(recording.stat().st_mode)
    files.replace(sidecar(recording), msgspec.json.encode(contents), mode)


def load(recording: Path) -> Contents | None:
    """Return the contents saved next to a recording; None if the sidecar is missing, damaged or of another version."""
    try:
        contents = decoded(sidecar(recording).read_bytes(), Contents)
    except (OSError, *INVALID):
        return None
    contents.name = recording.name  # the recording and its sidecar may have been renamed
    return contents


def read_contents(path: Path) -> Contents:
    """Read the contents of a recording.

    If the recording cannot be read, `trouble` contains the reason. The robot is then that in the name of the file.
    """
    from trirail.telemetry import provenance  # imported late, because importing Rerun takes most of the start-up time
    from trirail.telemetry.reading import read_part

    contents = Contents(path.name, robot_in(path.name))
    try:
        recording = read_part(path)
        config = provenance.configuration(recording.texts)
    except (ServiceError, ConfigError, OSError) as error:
        contents.trouble = str(error)
        return contents
    if config is not None:
        contents.robot, contents.rate_hz = config.robot.name, config.loop.rate_hz
    if len(recording.records):
        began, ended = (float(wall.astype("datetime64[ns]").astype(int)) * 1e-9 for wall in recording.wall[[0, -1]])
        contents.add_cycles(began, ended, len(recording.records))
    for line in recording.events:
        if line.event is not None:
            contents.event(line.event)
    for item in recording.requests:
        contents.control_input(item)
    if is_black_box(path.name):
        contents.reason = _reason(contents)
    return contents


def _reason(contents: Contents) -> str | None:
    """Return the message of the fault whose time is in the name of a black box, or else of the last fault."""
    for entry in (entry for entry in contents.faults if box_name(entry.time) in contents.name):
        return entry.message
    return contents.faults[-1].message if contents.faults else None


def box_name(fault_time: float) -> str:
    """Return the name, without suffix, of the black box for a fault at `fault_time` [s since 1970]."""
    return f"{BLACK_BOX}-{datetime.fromtimestamp(fault_time).astimezone():{STAMP}}"
