"""Descriptions of CAN bus errors: error frames, and frames that cannot be sent.

Error frames are decoded as in SocketCAN (linux/can/error.h): the identifier contains the error classes, and the eight
data bytes contain the details. Other interfaces use their own codings.
"""

from __future__ import annotations

import errno
from enum import IntEnum
from typing import Final, NamedTuple

import can

CONTROLLER: Final = 0x004
BUS_OFF: Final = 0x040
RESTARTED: Final = 0x100
PASSIVE: Final = 0x30
"""Bits of data[1] in class CONTROLLER: error-passive because of receive errors or of transmit errors."""
ACTIVE: Final = 0x40
"""Bit of data[1] in class CONTROLLER: error-active again."""

_LOST_ARBITRATION, _PROTOCOL, _TRANSCEIVER = 0x002, 0x008, 0x010
_LENGTH = 8
"""Number of data bytes in every SocketCAN error frame (CAN_ERR_DLC)."""

_CLASSES = {
    0x001: "a frame was not sent in time",
    0x020: "no acknowledgement from any other node; check that the drives are powered and have the same bitrate",
    BUS_OFF: (
        "bus-off: 256 transmit errors, the controller has left the bus; check cable, termination and bitrate, then "
        "restart the interface: ip link set {interface} down, ip link set {interface} up"
    ),
    0x080: "bus error",
    RESTARTED: "the controller was restarted after bus-off",
}
_CONTROLLER = {
    0x01: "receive buffer overflow, frames were lost",
    0x02: "transmit buffer overflow, frames were lost",
    0x04: "error-warning: 96 receive errors; check cable and termination",
    0x08: "error-warning: 96 transmit errors; check cable and termination",
    0x10: "error-passive: 128 receive errors; check cable, termination and bitrate",
    0x20: "error-passive: 128 transmit errors; check cable, termination and bitrate",
    ACTIVE: "error-active again",
}
_VIOLATIONS = {
    0x01: "single bit error",
    0x02: "frame format error",
    0x04: "bit stuffing error",
    0x08: "dominant bit not sent",
    0x10: "recessive bit not sent",
    0x20: "bus overload",
    0x40: "active error announcement",
}
_LOCATIONS = {
    0x02: "identifier",
    0x03: "start of frame",
    0x04: "RTR bit",
    0x05: "IDE bit",
    0x06: "identifier",
    0x07: "identifier",
    0x08: "CRC sequence",
    0x09: "reserved bit 0",
    0x0A: "data",
    0x0B: "data length code",
    0x0C: "RTR bit",
    0x0D: "reserved bit 1",
    0x0E: "identifier",
    0x0F: "identifier",
    0x12: "intermission",
    0x18: "CRC delimiter",
    0x19: "acknowledgement slot",
    0x1A: "end of frame",
    0x1B: "acknowledgement delimiter",
}
_WIRES = {
    0x04: "no wire at CANH",
    0x05: "CANH shorted to battery",
    0x06: "CANH shorted to supply",
    0x07: "CANH shorted to ground",
    0x40: "no wire at CANL",
    0x50: "CANL shorted to battery",
    0x60: "CANL shorted to supply",
    0x70: "CANL shorted to ground",
    0x80: "CANL shorted to CANH",
}


class Severity(IntEnum):
    """Severity of an error frame."""

    ROUTINE = 0
    """Normal on a working bus: lost arbitration, or the end of an error condition."""
    WARNING = 1
    """The bus still carries frames, with errors."""
    FAULT = 2
    """The bus no longer carries frames."""


class ErrorReport(NamedTuple):
    """Content of an error frame."""

    severity: Severity
    text: str


def decode_error_frame(kind: int, data: bytes | bytearray, bus: str) -> ErrorReport:
    """Decode an error frame's identifier and data; a frame that is not in SocketCAN's coding becomes a warning.

    `bus` is the name of the bus, as in `explain`.
    """
    if len(data) != _LENGTH:
        return ErrorReport(Severity.WARNING, f"error frame {kind:X} in the interface's own coding")
    parts = [words for bit, words in _CLASSES.items() if kind & bit]
    if kind & CONTROLLER:
        parts += [words for bit, words in _CONTROLLER.items() if data[1] & bit] or ["controller problem"]
    if kind & _PROTOCOL:
        parts.append(_violation(data[2], data[3]))
    if kind & _TRANSCEIVER:
        parts.append(f"transceiver: {_WIRES.get(data[4], 'unspecified error')}")
    if kind & _LOST_ARBITRATION:
        parts.append("arbitration lost")
    text = "; ".join(parts).format(interface=_interface_of(bus)) or f"error frame {kind:X}"
    if kind & BUS_OFF:
        return ErrorReport(Severity.FAULT, text)
    errors = kind & ~(_LOST_ARBITRATION | 0x200)  # 200h, CAN_ERR_CNT: the data has error counters
    routine = not errors or (errors == CONTROLLER and data[1] == ACTIVE)
    return ErrorReport(Severity.ROUTINE if routine else Severity.WARNING, text)


def queue_is_full(error: Exception) -> bool:
    """Whether a frame was not sent because the transmit queue is full; sending may succeed in the next cycle."""
    # ENOBUFS: the interface's queue is full. EAGAIN, and python-can without a number: the socket's queue is full.
    number = error_number(error)
    return number in (errno.ENOBUFS, errno.EAGAIN) or (isinstance(error, can.CanOperationError) and number is None)


def explain(error: Exception, bus: str, *, sending: bool = True) -> str:
    """Return the reason why a frame could not be sent or received, with the remedy.

    `bus` is the name of the bus: that of its interface, or python-can's `channel_info`.
    """
    reason, interface = " ".join(str(error).split()), _interface_of(bus)
    if sending and queue_is_full(error):
        return (
            f"{reason}: the transmit queue is full, because no node acknowledges (check the power of the drives, "
            f"cable, termination, bitrate) or it is shorter than a cycle's frames: ip link set {interface} "
            "txqueuelen 100"
        )
    match error_number(error):
        case errno.ENETDOWN:
            return f"{reason}: the interface is down; bring it up: ip link set {interface} up"
        case errno.ENODEV | errno.ENXIO:
            return f"{reason}: the interface no longer exists; check that the adapter is plugged in"
        case errno.EPIPE | errno.ECONNRESET:
            return f"{reason}: the listening end of the bus has closed the connection"
    return reason


def error_number(error: BaseException | None) -> int | None:
    """Return the system's error number, taken from the error or from one of its causes."""
    while error is not None:
        number = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
        if number is not None:
            return int(number)
        error = error.__cause__
    return None


def _interface_of(bus: str) -> str:
    """Return the name of a bus's interface, which python-can puts into quotes: socketcan channel 'can0'."""
    quoted = bus.split("'")
    return quoted[1] if len(quoted) > 2 else bus


def _violation(kind: int, location: int) -> str:
    what = ", ".join(words for bit, words in _VIOLATIONS.items() if kind & bit) or "protocol violation"
    when = " in sending" if kind & 0x80 else ""
    where = f" at the {_LOCATIONS[location]}" if location in _LOCATIONS else ""
    return f"{what}{when}{where}"
