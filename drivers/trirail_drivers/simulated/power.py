"""Tables of the CiA 402 power state machine: commands, transitions and the statusword of each state."""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from trirail_drivers.interface import PowerState

SWITCH_ON_DISABLED = PowerState.SWITCH_ON_DISABLED
READY_TO_SWITCH_ON = PowerState.READY_TO_SWITCH_ON
SWITCHED_ON = PowerState.SWITCHED_ON
OPERATION_ENABLED = PowerState.OPERATION_ENABLED
QUICK_STOP_ACTIVE = PowerState.QUICK_STOP_ACTIVE
FAULT_REACTION_ACTIVE = PowerState.FAULT_REACTION_ACTIVE
FAULT = PowerState.FAULT

FAULT_RESET = 0x80
"""Bit 7 of the controlword. A change from 0 to 1 is the command."""

STATUS: Final = {
    PowerState.NOT_READY_TO_SWITCH_ON: 0x0000,
    SWITCH_ON_DISABLED: 0x0040,
    READY_TO_SWITCH_ON: 0x0021,
    SWITCHED_ON: 0x0023,
    OPERATION_ENABLED: 0x0027,
    QUICK_STOP_ACTIVE: 0x0007,
    FAULT_REACTION_ACTIVE: 0x000F,
    FAULT: 0x0008,
}
"""Bits 0 to 3, 5 and 6 of the statusword (CiA 402-2, 6041h, state coding)."""


class ControlwordCommand(Enum):
    """Command of a controlword (CiA 402-2, 6040h, command coding)."""

    SHUTDOWN = auto()
    SWITCH_ON = auto()
    """Command "switch on". In OPERATION ENABLED, the same bits mean "disable operation"."""
    ENABLE_OPERATION = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()


_CODING: Final = (
    (0x82, 0x00, ControlwordCommand.DISABLE_VOLTAGE),
    (0x86, 0x02, ControlwordCommand.QUICK_STOP),
    (0x87, 0x06, ControlwordCommand.SHUTDOWN),
    (0x8F, 0x07, ControlwordCommand.SWITCH_ON),
    (0x8F, 0x0F, ControlwordCommand.ENABLE_OPERATION),
)
"""Mask, value of the masked bits, and command. Bits outside the mask are ignored."""

_TRANSITIONS: Final = {
    (SWITCH_ON_DISABLED, ControlwordCommand.SHUTDOWN): READY_TO_SWITCH_ON,  # 2
    (READY_TO_SWITCH_ON, ControlwordCommand.SWITCH_ON): SWITCHED_ON,  # 3
    (READY_TO_SWITCH_ON, ControlwordCommand.ENABLE_OPERATION): OPERATION_ENABLED,  # 3, followed by 4
    (SWITCHED_ON, ControlwordCommand.ENABLE_OPERATION): OPERATION_ENABLED,  # 4
    (OPERATION_ENABLED, ControlwordCommand.SWITCH_ON): SWITCHED_ON,  # 5
    (SWITCHED_ON, ControlwordCommand.SHUTDOWN): READY_TO_SWITCH_ON,  # 6
    (READY_TO_SWITCH_ON, ControlwordCommand.QUICK_STOP): SWITCH_ON_DISABLED,  # 7
    (READY_TO_SWITCH_ON, ControlwordCommand.DISABLE_VOLTAGE): SWITCH_ON_DISABLED,  # 7
    (OPERATION_ENABLED, ControlwordCommand.SHUTDOWN): READY_TO_SWITCH_ON,  # 8
    (OPERATION_ENABLED, ControlwordCommand.DISABLE_VOLTAGE): SWITCH_ON_DISABLED,  # 9
    (SWITCHED_ON, ControlwordCommand.QUICK_STOP): SWITCH_ON_DISABLED,  # 10
    (SWITCHED_ON, ControlwordCommand.DISABLE_VOLTAGE): SWITCH_ON_DISABLED,  # 10
    (OPERATION_ENABLED, ControlwordCommand.QUICK_STOP): QUICK_STOP_ACTIVE,  # 11
    (QUICK_STOP_ACTIVE, ControlwordCommand.DISABLE_VOLTAGE): SWITCH_ON_DISABLED,  # 12
    (QUICK_STOP_ACTIVE, ControlwordCommand.ENABLE_OPERATION): OPERATION_ENABLED,  # 16
}
"""New state by state and command. The drive makes the transitions 0, 1, 13 and 14 by itself; 15 is the fault reset."""


def command(controlword: int) -> ControlwordCommand | None:
    """Return the command in `controlword`; None if its bits are not a command."""
    for mask, value, meaning in _CODING:
        if controlword & mask == value:
            return meaning
    return None


def commanded(state: PowerState, controlword: int, resumes: bool) -> PowerState:
    """Return the state after `controlword`. `resumes`: 605Ah allows a return from a quick stop (transition 16)."""
    order = command(controlword)
    if order is None or (state, order, resumes) == (QUICK_STOP_ACTIVE, ControlwordCommand.ENABLE_OPERATION, False):
        return state
    return _TRANSITIONS.get((state, order), state)
