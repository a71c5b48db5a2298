"""ODrive's CANSimple messages as bytes: identifiers, layouts, states, errors, bus traffic.

Layouts are those of firmware 0.6, from ODrive's manual, chapter "CAN Protocol": little-endian, floats of 32 bits,
positions in turns of the encoder that the axis loads.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from struct import Struct
from typing import Final

from trirail_drivers.bus.frames import Frame, frame_bits
from trirail_drivers.bus.load import Traffic

# Commands: the lower five bits of an identifier, under the node id.
GET_VERSION: Final = 0x00
HEARTBEAT: Final = 0x01
ESTOP: Final = 0x02
GET_ERROR: Final = 0x03
RX_SDO: Final = 0x04
TX_SDO: Final = 0x05
ADDRESS: Final = 0x06
SET_AXIS_STATE: Final = 0x07
GET_ENCODER_ESTIMATES: Final = 0x09
SET_CONTROLLER_MODE: Final = 0x0B
SET_INPUT_POS: Final = 0x0C
CLEAR_ERRORS: Final = 0x18

VERSION: Final = Struct("<BBBBBBBB")
"""Get_Version: protocol; hardware product line, version, variant; firmware major, minor, revision, unreleased."""
BEAT: Final = Struct("<IBBBx")
"""Heartbeat: axis error, axis state, procedure result, trajectory done flag."""
ERRORS: Final = Struct("<II")
"""Get_Error: active errors, disarm reason."""
SERIAL_AT: Final = slice(1, 7)
"""Address: node id, serial number of 48 bits; newer firmware has a connection id behind them."""
SDO: Final = Struct("<BHB")
"""RxSdo: opcode, endpoint, reserved; TxSdo: reserved, endpoint, reserved. The value follows, in its endpoint's type."""
READ: Final = 0
WRITE: Final = 1
"""Opcodes of RxSdo."""
TYPES: Final = {
    "bool": Struct("<?"),
    "uint8": Struct("<B"), "int8": Struct("<b"),
    "uint16": Struct("<H"), "int16": Struct("<h"),
    "uint32": Struct("<I"), "int32": Struct("<i"),
    "float": Struct("<f"),
}  # fmt: skip
"""Types of endpoints as flat_endpoints.json names them; those of eight bytes do not go into a message."""
AXIS_STATE: Final = Struct("<I4x")
"""Set_Axis_State: requested state."""
ESTIMATES: Final = Struct("<ff")
"""Get_Encoder_Estimates: position [turns], velocity [turns/s]."""
CONTROLLER_MODE: Final = Struct("<II")
"""Set_Controller_Mode: control mode, input mode."""
INPUT_POS: Final = Struct("<fhh")
"""Set_Input_Pos: position [turns], velocity feed-forward [0.001 turns/s], torque feed-forward [0.001 Nm]."""
CLEAR: Final = Struct("<B")
"""Clear_Errors: whether to blink for identification."""

VELOCITY_SCALE: Final = 1000
"""The drive's input_vel_scale, by default: units of the velocity feed-forward in a turn per second."""
VELOCITY_STEP: Final = 1.0 / VELOCITY_SCALE
"""Unit of the velocity feed-forward [turns/s]."""
MAX_FEED_FORWARD: Final = 32767 * VELOCITY_STEP
"""The fastest feed-forward that 16 bits hold [turns/s]."""

POSITION_CONTROL: Final = 3
PASSTHROUGH: Final = 1
"""Input mode in which a setpoint is followed from its arrival on, without a filter or profile of the drive's."""

NODES: Final = range(63)
"""Node ids of six bits, without 3Fh, which is that of all drives together or of one without an id yet."""

ERROR_PERIOD: Final = 0.01
"""One of the three drives is asked for its errors this often, each in its turn [s]."""


class AxisState(IntEnum):
    """States of an ODrive axis that this driver distinguishes; all others are procedures of the drive's own."""

    UNDEFINED = 0
    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


PROCEDURES: Final = {
    2: "startup sequence",
    3: "full calibration sequence",
    4: "motor calibration",
    6: "encoder index search",
    7: "encoder offset calibration",
    9: "lockin spin",
    10: "encoder dir find",
    11: "homing",
    12: "encoder hall polarity calibration",
    13: "encoder hall phase calibration",
    14: "anticogging calibration",
    15: "harmonic calibration",
    16: "harmonic calibration of the commutation encoder",
}
"""Axis states in which the drive moves or tries its motor by itself."""


class ProcedureResult(IntEnum):
    """Result of an axis' last procedure, or of its transition into closed loop control."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    POLE_PAIR_CPR_MISMATCH = 5
    PHASE_RESISTANCE_OUT_OF_RANGE = 6
    PHASE_INDUCTANCE_OUT_OF_RANGE = 7
    UNBALANCED_PHASES = 8
    INVALID_MOTOR_TYPE = 9
    ILLEGAL_HALL_STATE = 10
    TIMEOUT = 11
    HOMING_WITHOUT_ENDSTOP = 12
    INVALID_STATE = 13
    NOT_CALIBRATED = 14
    NOT_CONVERGING = 15


class Error(IntFlag):
    """Bits of axis error, active errors and disarm reason."""

    INITIALIZING = 1 << 0
    SYSTEM_LEVEL = 1 << 1
    TIMING_ERROR = 1 << 2
    MISSING_ESTIMATE = 1 << 3
    BAD_CONFIG = 1 << 4
    DRV_FAULT = 1 << 5
    MISSING_INPUT = 1 << 6
    DC_BUS_OVER_VOLTAGE = 1 << 8
    DC_BUS_UNDER_VOLTAGE = 1 << 9
    DC_BUS_OVER_CURRENT = 1 << 10
    DC_BUS_OVER_REGEN_CURRENT = 1 << 11
    CURRENT_LIMIT_VIOLATION = 1 << 12
    MOTOR_OVER_TEMP = 1 << 13
    INVERTER_OVER_TEMP = 1 << 14
    VELOCITY_LIMIT_VIOLATION = 1 << 15
    POSITION_LIMIT_VIOLATION = 1 << 16
    WATCHDOG_TIMER_EXPIRED = 1 << 24
    ESTOP_REQUESTED = 1 << 25
    SPINOUT_DETECTED = 1 << 26
    BRAKE_RESISTOR_DISARMED = 1 << 27
    THERMISTOR_DISCONNECTED = 1 << 28
    CALIBRATION_ERROR = 1 << 30


def identifier(node: int, command: int) -> int:
    """Return the 11-bit identifier of one node's command."""
    return node << 5 | command


def command(node: int, number: int, data: bytes) -> Frame:
    """Return a message to one node."""
    return Frame(identifier(node, number), data)


def request(node: int, number: int) -> Frame:
    """Return a remote frame, on which the node sends the message of that number.

    ODrives take an empty data frame for a request as well. But that would collide, bit by bit, with a message that
    the drive sends by itself at this moment; a remote frame lets that one go first (ISO 11898-1).
    """
    return Frame(identifier(node, number), remote=True)


def input_pos(position: float, velocity: float) -> bytes:
    """Return Set_Input_Pos of a position [turns], velocity [turns/s]; OverflowError or struct.error if out of range."""
    return INPUT_POS.pack(position, round(velocity / VELOCITY_STEP), 0)


def serial_number(address: bytes) -> int | None:
    """Return the serial number in an Address message; None where it is too short for one."""
    data = address[SERIAL_AT]
    return int.from_bytes(data, "little") if len(data) == SERIAL_AT.stop - SERIAL_AT.start else None


def is_starting(state: int, errors: int) -> bool:
    """Whether an axis state, or error bits, are those of a drive that boots."""
    return state == AxisState.UNDEFINED or bool(errors & Error.INITIALIZING)


def state_name(state: int) -> str:
    """Return an axis state in words."""
    if state in PROCEDURES:
        return PROCEDURES[state]
    try:
        return AxisState(state).name.lower().replace("_", " ")
    except ValueError:
        return f"axis state {state}"


def error_names(errors: int) -> str:
    """Return the names of the errors whose bits are set, as ODrive's own tools write them."""
    names = [error.name or "" for error in Error if errors & error]
    unknown = errors & ~sum(Error)
    return ", ".join([*names, *([f"unknown error {unknown:08X}"] if unknown else [])])


def _background(heartbeat: float) -> float:
    """Return the bits per second of error requests, their answers, and three heartbeats of this period [s]."""
    return (frame_bits(0) + frame_bits(ERRORS.size)) / ERROR_PERIOD + 3 * frame_bits(BEAT.size) / heartbeat


TRAFFIC: Final = Traffic(
    cycle_bits=3 * (frame_bits(INPUT_POS.size) + frame_bits(0) + frame_bits(ESTIMATES.size)),
    background=_background,
    most_sent=13,
)
"""One cycle: three setpoints, three requests, three encoder estimates.

At most the service sends those setpoints and requests, a mode and a state for each drive, and an error request.
"""
