"""`struct can_frame` of linux/can.h: how a classical CAN frame lies in memory, and is captured."""

from __future__ import annotations

from struct import Struct
from typing import Final

CAN_FRAME: Final = Struct("=IB3x8s")
"""`struct can_frame`: identifier with flags, length, data."""
CAPTURED: Final = Struct(f"<d{CAN_FRAME.size}s")
"""A captured frame: seconds since 1970, `struct can_frame`."""
HEAD: Final = Struct("=IB")
"""Its beginning: identifier with flags, length."""
DATA_AT: Final = 8
"""Where its data begins."""
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
"""Flags beside the identifier: one of 29 bits, a remote frame, a report of the controller."""
STANDARD_BITS: Final = 0x7FF
EXTENDED_BITS: Final = 0x1FFF_FFFF
