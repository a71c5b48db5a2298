"""Classical CAN frames, whatever the drives speak."""

from __future__ import annotations

import can


def data_frame(identifier: int, data: bytes) -> can.Message:
    """A data frame with an 11-bit identifier."""
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=False)


def remote_frame(identifier: int, length: int) -> can.Message:
    """A request for the data frame of an 11-bit identifier."""
    return can.Message(arbitration_id=identifier, is_remote_frame=True, dlc=length, is_extended_id=False)


def frame_bits(n: int) -> int:
    """Bits that a classical frame of `n` data bytes and an 11-bit identifier takes at most.

    8n + 44 bits and 3 of interframe space; 34 + 8n of these are open to bit stuffing, which at worst adds one
    bit after the first five and then one after every four (ISO 11898-1).
    """
    return 8 * n + 47 + (34 + 8 * n - 1) // 4
