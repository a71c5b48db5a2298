"""ODrive's CANSimple messages as bytes: their identifiers, layouts, states and errors, and the bus traffic.

The layouts are those of firmware 0.6, from the ODrive manual, chapter "CAN Protocol": values are little-endian, floats
have 32 bits, and positions are in turns of the encoder that the axis uses for its load.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from struct import Struct
from typing import Final

from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.load import Traffic

# Commands: the lower five bits of an identifier; the node id forms the upper bits.
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

ADDRESS_FIRMWARE: Final = (0, 6, 9)
"""First firmware version with the message Address. In earlier versions, its command is Set_Axis_Node_ID."""

VERSION: Final = Struct("<BBBBBBBB")
"""Get_Version: protocol; hardware product line, version, variant; firmware major, minor, revision, unreleased."""
BEAT: Final = Struct("<IBBBx")
"""Heartbeat: axis error, axis state, procedure result, trajectory done flag."""
ERRORS: Final = Struct("<II")
"""Get_Error: active errors, disarm reason."""
SERIAL_AT: Final = slice(1, 7)
"""Bytes of the serial number in Address: node id, serial number of 48 bits and, in newer firmware, connection id."""
SDO: Final = Struct("<BHB")
"""RxSdo: opcode, endpoint, reserved; TxSdo: reserved, endpoint, reserved.

The value follows, in the type of its endpoint.
"""
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
"""Types of endpoints by their names in flat_endpoints.json. Eight-byte types are omitted, since their values do not fit
into a message.
"""
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
"""Default of the drive's input_vel_scale: number of units of the velocity feed-forward in 1 turn/s."""
VELOCITY_STEP: Final = 1.0 / VELOCITY_SCALE
"""Unit of the velocity feed-forward [turns/s]."""
MAX_FEED_FORWARD: Final = 32767 * VELOCITY_STEP
"""Largest velocity feed-forward that fits into 16 bits [turns/s]."""

POSITION_CONTROL: Final = 3
PASSTHROUGH: Final = 1
"""Input mode in which the drive follows each setpoint as soon as it arrives, without a filter or profile."""

NODES: Final = range(63)
"""Valid node ids, which have six bits. 3Fh is excluded, since it addresses all drives, or a drive without an id."""

ERROR_PERIOD: Final = 0.01
"""Interval between two error requests [s]. The three drives are asked in turn."""


class AxisState(IntEnum):
    """States of an ODrive axis that this driver distinguishes. All other states are procedures of the drive itself."""

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
"""Axis states in which the drive moves or tests its motor by itself."""


class ProcedureResult(IntEnum):
    """Result of the last procedure of an axis, or of its transition to closed-loop control."""

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
    REQUESTED_CURRENT_TOO_HIGH = 16


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
    REQUESTED_CURRENT_TOO_HIGH = 1 << 17
    WATCHDOG_TIMER_EXPIRED = 1 << 24
    ESTOP_REQUESTED = 1 << 25
    SPINOUT_DETECTED = 1 << 26
    BRAKE_RESISTOR_DISARMED = 1 << 27
    THERMISTOR_DISCONNECTED = 1 << 28
    CALIBRATION_ERROR = 1 << 30


def identifier(node: int, command: int) -> int:
    """Return the 11-bit identifier of a command to or from one node."""
    return node << 5 | command


def command(node: int, number: int, data: bytes) -> Frame:
    """Return a message with the command `number` to one node."""
    return Frame(identifier(node, number), data)


def request(node: int, number: int) -> Frame:
    """Return a remote frame that makes the node send the message with the command `number`.

    ODrives also accept an empty data frame as a request. However, if the drive sent the message by itself at the same
    moment, the empty frame and the message would collide, bit by bit. A remote frame gives way to the message (ISO
    11898-1).
    """
    return Frame(identifier(node, number), remote=True)


def serial_number(address: bytes) -> int | None:
    """Return the serial number in an Address message, or None if the message is too short to contain one."""
    data = address[SERIAL_AT]
    return int.from_bytes(data, "little") if len(data) == SERIAL_AT.stop - SERIAL_AT.start else None


def state_name(state: int) -> str:
    """Return the name of an axis state for people."""
    if state in PROCEDURES:
        return PROCEDURES[state]
    try:
        return AxisState(state).name.lower().replace("_", " ")
    except ValueError:
        return f"axis state {state}"


def error_names(errors: int) -> str:
    """Return the names of the errors whose bits are set, as ODrive's own tools spell them."""
    names = [error.name or "" for error in Error if errors & error]
    unknown = errors & ~sum(Error)
    return ", ".join([*names, *([f"unknown error {unknown:08X}"] if unknown else [])])


TRAFFIC: Final = Traffic(
    cycle=3 * (INPUT_POS.size, 0, ESTIMATES.size),
    periodic=((0, ERROR_PERIOD), (ERRORS.size, ERROR_PERIOD)),
    heartbeats=3 * (BEAT.size,),
    most_sent=10,
)
"""Traffic of one cycle: three setpoints, three requests, three encoder estimates.

In one cycle, the service sends at most three setpoints, three requests, a mode or a state for each drive, and one
error request.
"""
