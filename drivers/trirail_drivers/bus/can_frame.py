"""`struct can_frame` of linux/can.h: layout of a classical CAN frame in memory and in captures."""

from __future__ import annotations

from struct import Struct
from typing import Final

CAN_FRAME: Final = Struct("=IB3x8s")
"""`struct can_frame`: identifier with flags, length, data."""
CAPTURED: Final = Struct(f"<d{CAN_FRAME.size}s")
"""Captured frame: seconds since 1970, and `struct can_frame`."""
HEADER: Final = Struct("=IB")
"""Beginning of `struct can_frame`: identifier with flags, length."""
DATA_AT: Final = 8
"""Offset of the data in `struct can_frame`."""
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
"""Flags next to the identifier: 29-bit identifier, remote frame, error frame of the controller."""
STANDARD_BITS: Final = 0x7FF
EXTENDED_BITS: Final = 0x1FFF_FFFF
