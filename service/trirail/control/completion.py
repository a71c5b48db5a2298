"""Whether a command has been carried out, by what the robot does and what its drives say."""

from __future__ import annotations

from typing import assert_never

from trirail_drivers.interface import NAMES, PowerState

from trirail.control.feedback import CAN_MOVE, Measured
from trirail.wire.vocabulary import Command, Mode

_FAULTY = (PowerState.FAULT_REACTION_ACTIVE, PowerState.FAULT)


def verdict(name: Command, mode: Mode, latched: str | None, measured: Measured, *, settled: bool) -> str | None:
    """Return "" when a command is carried out, None while it is not, else why it never will be.

    `latched` is the reason of the fault, if there is one. `settled` tells whether the drives have had the time that
    they may take to leave their fault state.
    """
    fault = measured.feedback.fault
    if name in (Command.DISABLE, Command.QUICK_STOP) and fault is not None and fault.cause == "timeout":
        return fault.message
    match name:
        case Command.ENABLE:
            if mode is Mode.ENABLING:
                return None
            return "" if mode not in (Mode.FAULT, Mode.DISABLED) else latched or "disabled while powering up"
        case Command.DISABLE:
            return None if mode is Mode.STOPPING or measured.powered else ""
        case Command.STOP | Command.PAUSE | Command.RELEASE:
            return None if mode is Mode.STOPPING else ""
        case Command.HOME:
            if mode in (Mode.HOMING, Mode.STOPPING):
                return None
            return "" if measured.homed else latched or "stopped before every drive was homed"
        case Command.RESUME | Command.OVERRIDE | Command.ACQUIRE:
            return ""
        case Command.RESET:
            if mode is Mode.FAULT:
                return f"the cause is still there: {latched}"
            return "" if settled and not any(state in _FAULTY for state in measured.feedback.state) else None
        case Command.QUICK_STOP:
            return None if measured.powered else ""
    assert_never(name)


def still_powered(measured: Measured, latched: str | None) -> str:
    """Tell which drives, by what they said last, can still move."""
    states = zip(NAMES, measured.feedback.state, strict=True)
    said = ", ".join(f"drive {name} is {state}" for name, state in states if state in CAN_MOVE)
    return f"{said} by what it said last: send reset again when the drives stand (fault: {latched})"
