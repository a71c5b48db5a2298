"""What everyone is told of goals, modes and faults, before it is numbered as an event."""

from __future__ import annotations

from typing import NamedTuple

from trirail_drivers.interface import Triple

from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import FaultDetail, Level, Outcome, Residual

REMEMBERED_IDS = 10_000
"""Goals whose ids may not be used again; older ones are forgotten."""


class Notice(NamedTuple):
    """Something to tell everyone, in the order in which it happened."""

    kind: str
    level: Level
    message: str
    mode: str | None = None
    id: str | None = None
    outcome: Outcome | None = None
    reason: str | None = None
    goal: str | None = None
    user: str | None = None
    settle: float | None = None
    residual: Residual | None = None
    overshoot: Triple | None = None
    fault: FaultDetail | None = None
    alignment: AlignmentLook | None = None
