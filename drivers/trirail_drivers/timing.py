"""Duration of frames on a bus, with worst-case bit stuffing, for classical CAN and for CAN FD."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

DEFAULT_BITRATE: Final = 1_000_000
"""Bit rate of a bus [bit/s], unless the configuration has another one."""
MOST_DATA: Final = 64
"""Maximum number of data bytes of a CAN FD frame."""
_NS: Final = 1_000_000_000
_ARBITRATION_BITS: Final = 30 - 1
"""Bits of a CAN FD frame at the bit rate of the arbitration: start, 11-bit identifier, RRS, IDE, FDF, res, BRS; and
acknowledgement with its delimiter, end of frame and interframe space (ISO 11898-1:2015, 10.4.2).
"""
_ARBITRATION_STUFFING: Final = (17 - 1) // 4
"""Maximum number of stuff bits among the 17 bits from the start of the frame to BRS."""


def frame_bits(n: int) -> int:
    """Return the worst-case length [bits] of a classical frame with `n` data bytes and an 11-bit identifier.

    The frame has 8n + 44 bits, followed by 3 bits of interframe space. 34 + 8n of the bits are subject to bit stuffing,
    which in the worst case adds one bit after the first five and then one after every four (ISO 11898-1).
    """
    return 8 * n + 47 + (34 + 8 * n - 1) // 4


def fd_frame_bits(n: int) -> tuple[int, int]:
    """Return the worst-case numbers of bits of a CAN FD frame with `n` data bytes and an 11-bit identifier.

    The first number counts bits at the bit rate of the arbitration, the second number bits at the data bit rate. The
    data phase consists of ESI, DLC, data, stuff count, CRC with its fixed stuff bits, and the CRC delimiter. Dynamic
    stuffing covers the bits from the start of the frame to the end of the data (ISO 11898-1:2015, 10.5).
    """
    crc = 17 if n <= 16 else 21
    fixed_stuffing = 1 + (4 + crc) // 4
    data = 5 + 8 * n + 4 + crc + fixed_stuffing + 1
    stuffing = (22 + 8 * n - 1) // 4
    return _ARBITRATION_BITS + _ARBITRATION_STUFFING, data + stuffing - _ARBITRATION_STUFFING


@dataclass(frozen=True)
class BusTiming:
    """Bit rates of a bus, from which the duration of its frames follows."""

    bitrate: int
    """Bit rate [bit/s]; on a CAN FD bus, that of the arbitration."""
    data_bitrate: int | None = None
    """Data bit rate of a CAN FD bus [bit/s], at which every frame is sent; None for classical CAN."""

    @property
    def fd(self) -> bool:
        """Whether the bus is a CAN FD bus."""
        return self.data_bitrate is not None

    def frame_ns(self, n: int) -> int:
        """Return the worst-case duration [ns] of a frame with `n` data bytes and an 11-bit identifier, rounded up."""
        if self.data_bitrate is None:
            return -(-frame_bits(n) * _NS // self.bitrate)
        arbitration, data = fd_frame_bits(n)
        return -(-arbitration * _NS // self.bitrate) - (-data * _NS // self.data_bitrate)

    @cached_property
    def frames_ns(self) -> tuple[int, ...]:
        """`frame_ns` for each number of data bytes up to MOST_DATA."""
        return tuple(self.frame_ns(n) for n in range(MOST_DATA + 1))

    def total_seconds(self, frames: int, data: int) -> float:
        """Return an upper bound [s] for the duration of `frames` frames with `data` bytes in total.

        No frame may have more than 16 data bytes. The bound exceeds the sum of the worst-case durations of classical
        frames by at most one bit per frame; for CAN FD, it is that sum.
        """
        if self.data_bitrate is None:
            return (8 * data + 47 * frames + (33 * frames + 8 * data) / 4) / self.bitrate
        arbitration, bits = fd_frame_bits(0)
        return frames * arbitration / self.bitrate + (frames * bits + 10 * data) / self.data_bitrate

    @property
    def link_settings(self) -> str:
        """Arguments of `ip link set` that bring a SocketCAN interface up with these bit rates."""
        fd = "" if self.data_bitrate is None else f" dbitrate {self.data_bitrate} fd on"
        return f"up type can bitrate {self.bitrate}{fd}"

    def __str__(self) -> str:
        """Return the bit rates for people."""
        return f"{self.bitrate} bit/s" + ("" if self.data_bitrate is None else f", data at {self.data_bitrate} bit/s")


DEFAULT_TIMING: Final = BusTiming(DEFAULT_BITRATE)
"""Bit rates of a bus, unless the configuration has others."""
