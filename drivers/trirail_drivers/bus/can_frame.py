"""`struct can_frame` and `struct canfd_frame` of linux/can.h: layouts of CAN frames in memory and in captures.

Both structures begin with the same 16 bytes, if a CAN FD frame has at most 8 data bytes. Only `flags` differs, which is
padding in a classical frame.
"""

from __future__ import annotations

from struct import Struct
from typing import Final

CAN_FRAME: Final = Struct("=IB3x8s")
"""`struct can_frame`: identifier with flags, length, data."""
CANFD_FRAME: Final = Struct("=IBB2x64s")
"""`struct canfd_frame`: identifier with flags, length, FD flags, data."""
FRAME_SIZES: Final = CAN_FRAME.size, CANFD_FRAME.size
"""Sizes of the packets that a socket of CAN frames carries [bytes]."""
CAPTURED: Final = Struct(f"<d{CAN_FRAME.size}s")
"""Captured frame: seconds since 1970, and the first bytes of `struct can_frame` or `struct canfd_frame`. More than 8
data bytes, which only other nodes send, are cut off.
"""
HEADER: Final = Struct("=IB")
"""Beginning of both structures: identifier with flags, length."""
DATA_AT: Final = 8
"""Offset of the data in both structures."""
LENGTH_AT: Final = 4
"""Offset of the data length in both structures."""
FD_FLAGS_AT: Final = 5
"""Offset of the FD flags in `struct canfd_frame`."""
BIT_RATE_SWITCH: Final = 1
ERROR_STATE: Final = 2
FD_FORMAT: Final = 4
"""FD flags: data phase at the data bit rate; sender is error-passive; frame in CAN FD format."""
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
"""Flags next to the identifier: 29-bit identifier, remote frame, error frame of the controller."""
STANDARD_BITS: Final = 0x7FF
EXTENDED_BITS: Final = 0x1FFF_FFFF
