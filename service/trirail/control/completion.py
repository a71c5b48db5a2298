"""Whether a command has been carried out, by what the robot does and what its drives say."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from trirail_drivers.interface import NAMES, PowerState

from trirail.control.feedback import CAN_MOVE, Measured
from trirail.wire.vocabulary import Mode

_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)


class CommandProgress(NamedTuple):
    """What there is to judge a command by."""

    mode: Mode
    latched: str | None
    """The reason of the fault, if there is one."""
    measured: Measured
    settled: bool
    """Whether the drives have had the time that they may take to leave their fault state."""


Rule = Callable[[CommandProgress], str | None]
"""Returns "" when a command is carried out, None while it is not, else why it never will be."""


def at_once(_: CommandProgress) -> str:
    """It is carried out when it has come."""
    return ""


def standing(now: CommandProgress) -> str | None:
    """The robot has come to rest."""
    return None if now.mode is Mode.STOPPING else ""


def powered_up(now: CommandProgress) -> str | None:
    """The drives have power, and the robot holds."""
    if now.mode is Mode.ENABLING:
        return None
    return "" if now.mode not in (Mode.FAULT, Mode.DISABLED) else now.latched or "disabled while powering up"


def powered_down(now: CommandProgress) -> str | None:
    """The robot has come to rest, and no drive has power."""
    return _timed_out(now) or (None if now.mode is Mode.STOPPING or now.measured.powered else "")


def unpowered(now: CommandProgress) -> str | None:
    """No drive has power."""
    return _timed_out(now) or (None if now.measured.powered else "")


def homed(now: CommandProgress) -> str | None:
    """It is known where every slider is."""
    if now.mode in (Mode.HOMING, Mode.STOPPING):
        return None
    return "" if now.measured.homed else now.latched or "stopped before every drive was homed"


def cleared(now: CommandProgress) -> str | None:
    """Neither the robot nor a drive is in fault."""
    if now.mode is Mode.FAULT:
        return f"the cause is still there: {now.latched}"
    return "" if now.settled and not any(state in _FAULTY for state in now.measured.feedback.state) else None


def _timed_out(now: CommandProgress) -> str:
    """Return what a drive says that does not do as it was told in time."""
    fault = now.measured.feedback.fault
    return fault.message if fault is not None and fault.cause == "timeout" else ""


def still_powered(measured: Measured, latched: str | None) -> str:
    """Tell which drives, by what they said last, can still move."""
    states = zip(NAMES, measured.feedback.state, strict=True)
    said = ", ".join(f"drive {name} is {state}" for name, state in states if state in CAN_MOVE)
    return f"{said} by what it said last: send reset again when the drives stand (fault: {latched})"
