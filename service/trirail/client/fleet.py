"""Fleet: all robots that a user can see at a locator, usually that of a router, with their newest summaries."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

import zenoh

from trirail.errors import RefusedError
from trirail.wire import boundary, zenoh_session
from trirail.wire.credentials import credentials_for
from trirail.wire.state import RobotSummary
from trirail.wire.vocabulary import Mode

MAX_SILENCE_S: Final = 3.0
"""Age of a robot's newest data above which the robot counts as silent [s]; each robot sends a summary once a second.

Zenoh's liveliness tokens are not used, since they outlive a killed process."""


class Attention(IntEnum):
    """Reason why a robot needs attention, with the most urgent reason first."""

    SILENT = 0
    FAULT = 1
    UNREADABLE = 2
    NOTHING = 3


class Member(NamedTuple):
    """Robot of the fleet with its newest summary."""

    robot: str
    summary: RobotSummary | None
    """None if it cannot be read, since the robot has another version."""
    heard: float
    """Arrival time of the summary, on this machine's monotonic clock [s]."""

    def age(self, now: float) -> float:
        """Return the age of the newest data of the robot's loop [s]."""
        return now - self.heard + (0.0 if self.summary is None else self.summary.age)

    def need(self, now: float) -> Attention:
        """Return the reason why the robot needs attention."""
        if self.age(now) > MAX_SILENCE_S:
            return Attention.SILENT
        if self.summary is None:
            return Attention.UNREADABLE
        return Attention.FAULT if self.summary.mode == Mode.FAULT else Attention.NOTHING


class Fleet:
    """Subscription to the summaries of all robots. Raises ServiceError if the locator cannot be reached."""

    def __init__(
        self,
        connect: str,
        robot: str,
        tls: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._members: dict[str, Member] = {}
        self._lock = threading.Lock()
        self._session = zenoh_session.open_client(connect, credentials_for(robot, connect, tls))
        callback = zenoh.handlers.Callback(self._on_summary, indirect=False)
        self._subscriber = self._session.declare_subscriber(zenoh_session.key("*", "summary"), callback)

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        zenoh_session.close(self._session)

    def members(self) -> list[Member]:
        """Return the robots that have sent a summary, sorted by the urgency of attention, then by name."""
        now = self._clock()
        with self._lock:
            return sorted(self._members.values(), key=lambda member: (member.need(now), member.robot))

    def _on_summary(self, sample: zenoh.Sample) -> None:
        _, robot, *_ = str(sample.key_expr).split("/")
        summary = None
        with contextlib.suppress(RefusedError):
            summary = boundary.decode(sample.payload.to_bytes(), RobotSummary, "not a summary", str(sample.encoding))
        with self._lock:
            self._members[robot] = Member(robot, summary, self._clock())
