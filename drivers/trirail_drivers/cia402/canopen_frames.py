"""CANopen frames as bytes: their identifiers and layouts, the coding of CiA 402 states, and the bus traffic."""

from __future__ import annotations

from struct import Struct
from typing import Final, Literal

from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.load import Traffic
from trirail_drivers.interface import PowerState

# Identifiers of the predefined connection set (CiA 301); all but the first two are added to a node id.
NMT: Final = 0x000
SYNC: Final = 0x080
EMCY: Final = 0x080
TPDO1: Final = 0x180
RPDO1: Final = 0x200
TPDO2: Final = 0x280
RPDO2: Final = 0x300
TPDO3: Final = 0x380
RPDO3: Final = 0x400
SDO_ANSWER: Final = 0x580
SDO_REQUEST: Final = 0x600
HEARTBEAT: Final = 0x700

NMT_COMMAND: Final = Struct("<BB")
"""NMT command: command specifier and node id."""
SETPOINT: Final = Struct("<ii")
"""RPDO2: target position 607Ah [counts] and velocity offset 60B1h [counts/s]."""
POSITION: Final = Struct("<i")
"""TPDO2: actual position 6064h [counts]."""
CONTROLWORD: Final = Struct("<H")
"""RPDO1: controlword 6040h."""
STATUSWORD: Final = Struct("<H")
"""TPDO1: statusword 6041h."""
OUTPUTS: Final = Struct("<I")
"""RPDO3: digital outputs 60FEh:01."""
INPUTS: Final = Struct("<I")
"""Digital inputs 60FDh: in TPDO1 after the statusword, or in TPDO3."""
EMERGENCY: Final = Struct("<HB5s")
"""EMCY: error code, error register 1001h, manufacturer-specific bytes."""
NMT_STATE: Final = Struct("<B")
"""Heartbeat and boot-up message: the sender's NMT state."""

STATUSWORD_UPLOAD: Final = b"\x40\x41\x60\x00" + bytes(4)
"""SDO request for the statusword 6041h."""
ERROR_REGISTER_UPLOAD: Final = b"\x40\x01\x10\x00" + bytes(4)
"""SDO request for the error register 1001h."""
ERROR_REGISTER_UPLOADED: Final = b"\x4f\x01\x10\x00"
"""First bytes of the answer to ERROR_REGISTER_UPLOAD; the register's byte follows."""
MODE_DISPLAY_UPLOAD: Final = b"\x40\x61\x60\x00" + bytes(4)
"""SDO request for the modes of operation display 6061h."""
CONTROLWORD_DOWNLOAD: Final = b"\x2b\x40\x60\x00"
"""First bytes of the SDO request that writes the controlword 6040h; its two bytes and two padding bytes follow."""
OUTPUTS_DOWNLOAD: Final = b"\x23\xfe\x60\x01"
"""First bytes of the SDO request that writes the digital outputs 60FEh:01; their four bytes follow."""
OUTPUTS_REFUSED: Final = b"\x80\xfe\x60\x01"
"""First bytes of the SDO answer that refuses the digital outputs; the abort code follows."""
MODE_DISPLAY_UPLOADED: Final = b"\x4f\x61\x60\x00"
"""First bytes of the SDO answer with the mode display; the mode's byte follows."""
STATUSWORD_UPLOADED: Final = b"\x4b\x41\x60\x00"
"""First bytes of the SDO answer with the statusword; its two bytes follow."""
INPUTS_UPLOAD: Final = b"\x40\xfd\x60\x00" + bytes(4)
"""SDO request for the digital inputs 60FDh."""
INPUTS_UPLOADED: Final = b"\x43\xfd\x60\x00"
"""First bytes of the SDO answer with the digital inputs; their four bytes follow."""
_UPLOAD_BITS: Final = 0xE2
"""Bits of the first byte of an SDO answer that contain the command specifier, and whether the upload is expedited."""

NMT_START: Final = 0x01
NMT_PRE_OPERATIONAL: Final = 0x80

BOOT_UP: Final = 0x00
STOPPED: Final = 0x04
OPERATIONAL: Final = 0x05
PRE_OPERATIONAL: Final = 0x7F
NMT_STATE_BITS: Final = 0x7F
"""State bits in an answer to node guarding; bit 7 toggles."""

DISABLE_VOLTAGE: Final = 0x00
QUICK_STOP: Final = 0x02
SHUTDOWN: Final = 0x06
SWITCH_ON: Final = 0x07
ENABLE_OPERATION: Final = 0x0F
FAULT_RESET: Final = 0x80
HOMING_START: Final = 0x10
"""Controlword bit 4, which starts homing in homing mode; sent together with ENABLE_OPERATION."""
HALT: Final = 0x100
"""Controlword bit 8: the drive stops and holds its position, with power."""

STATUS_PERIOD: Final = 0.1
"""Period in which a drive repeats an unchanged statusword: event timer 1800h:05 [s]."""

POLL_PERIOD: Final = 0.02
"""Period of the SDO requests for a statusword or inputs that no PDO repeats [s]."""
INTERPOLATE: Final = 0x10
"""Controlword bit 4, which enables interpolated position mode; sent together with ENABLE_OPERATION."""
REMOTE: Final = 1 << 9
"""Statusword bit that shows that a drive follows the controlword."""
FOLLOWS_SETPOINTS: Final = 1 << 12
"""Statusword bit that shows that a drive follows setpoints, in modes 8 and 7."""

# CiA 402-2, statusword coding: mask 4Fh (bit 5 is free) for the first four states, 6Fh for the others.
_STATES: Final = {
    0x00: PowerState.NOT_READY_TO_SWITCH_ON,
    0x20: PowerState.NOT_READY_TO_SWITCH_ON,
    0x40: PowerState.SWITCH_ON_DISABLED,
    0x60: PowerState.SWITCH_ON_DISABLED,
    0x0F: PowerState.FAULT_REACTION_ACTIVE,
    0x2F: PowerState.FAULT_REACTION_ACTIVE,
    0x08: PowerState.FAULT,
    0x28: PowerState.FAULT,
    0x21: PowerState.READY_TO_SWITCH_ON,
    0x23: PowerState.SWITCHED_ON,
    0x27: PowerState.OPERATION_ENABLED,
    0x07: PowerState.QUICK_STOP_ACTIVE,
}

# A quick stop is not interrupted. With 605Ah = 2 it ends by itself in switch on disabled; else see Cia402Axis.word.
_TOWARDS_OPERATION: Final = {
    PowerState.SWITCH_ON_DISABLED: SHUTDOWN,
    PowerState.READY_TO_SWITCH_ON: SWITCH_ON,
    PowerState.SWITCHED_ON: ENABLE_OPERATION,
    PowerState.OPERATION_ENABLED: ENABLE_OPERATION,
    PowerState.QUICK_STOP_ACTIVE: QUICK_STOP,
}

TargetState = Literal[PowerState.SWITCH_ON_DISABLED, PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE]
"""States that the driver can command. The drive passes through the other states, or enters them by itself."""


def nmt(command: int, node: int) -> Frame:
    """Return an NMT command to one node."""
    return Frame(NMT, NMT_COMMAND.pack(command, node))


def is_upload(data: bytes | bytearray, answer: bytes) -> bool:
    """Whether an SDO answer contains the value of the same object as `answer`, the first bytes of an expedited upload.

    The size may differ or be missing, since some drives pad each value to four bytes.
    """
    return data[0] & _UPLOAD_BITS == answer[0] & _UPLOAD_BITS and data[1:4] == answer[1:4]


def power_state(statusword: int) -> PowerState | None:
    """Decode statusword 6041h; return None if its bits encode no CiA 402 state."""
    return _STATES.get(statusword & 0x6F)


def controlword(state: PowerState, wanted: TargetState) -> int:
    """Return controlword 6040h for the next transition from `state` towards `wanted`."""
    if wanted is PowerState.OPERATION_ENABLED:
        return _TOWARDS_OPERATION.get(state, DISABLE_VOLTAGE)
    if wanted is PowerState.QUICK_STOP_ACTIVE:
        return QUICK_STOP
    return DISABLE_VOLTAGE


TRAFFIC: Final = Traffic(
    cycle=(0, *(3 * (SETPOINT.size, POSITION.size))),
    periodic=3 * ((STATUSWORD.size, STATUS_PERIOD),),
    heartbeats=4 * (NMT_STATE.size,),
    most_sent=11,
    output=OUTPUTS.size,
)
"""Traffic of one cycle: SYNC, three setpoints, three positions.

In one cycle, the service sends at most SYNC, a heartbeat, three setpoints, and three controlwords both before and after
the setpoints.
"""
