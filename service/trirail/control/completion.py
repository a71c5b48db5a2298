"""Whether a command has been carried out, by what the robot does and what its drives say."""

from __future__ import annotations

from trirail_drivers.interface import NAMES, PowerState

from trirail.control.feedback import CAN_MOVE, Measured
from trirail.wire.vocabulary import Mode

_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)


def verdict(name: str, mode: Mode, latched: str | None, measured: Measured, *, settled: bool) -> str | None:
    """Return "" when a command is carried out, None while it is not, else why it never will be.

    `latched` is the reason of the fault, if there is one. `settled` tells whether the drives have had the time that
    they may take to leave their fault state.
    """
    fault = measured.feedback.fault
    if name in ("disable", "quick_stop") and fault is not None and fault.cause == "timeout":
        return fault.message
    match name:
        case "enable":
            if mode is Mode.ENABLING:
                return None
            return "" if mode not in (Mode.FAULT, Mode.DISABLED) else latched or "disabled while powering up"
        case "disable":
            return None if mode is Mode.STOPPING or measured.powered else ""
        case "stop" | "pause":
            return None if mode is Mode.STOPPING else ""
        case "home":
            if mode in (Mode.HOMING, Mode.STOPPING):
                return None
            return "" if measured.homed else latched or "stopped before every drive was homed"
        case "resume" | "override":
            return ""
        case "reset":
            if mode is Mode.FAULT:
                return f"the cause is still there: {latched}"
            return "" if settled and not any(state in _FAULTY for state in measured.feedback.state) else None
        case _:
            return None if measured.powered else ""


def still_powered(measured: Measured, latched: str | None) -> str:
    """Tell which drives, by what they said last, can still move."""
    states = zip(NAMES, measured.feedback.state, strict=True)
    said = ", ".join(f"drive {name} is {state}" for name, state in states if state in CAN_MOVE)
    return f"{said} by what it said last: send reset again when the drives stand (fault: {latched})"
