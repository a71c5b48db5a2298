"""Server side of SDO block transfers, which have no answer to each segment, and one CRC (CiA 301, SDO block)."""

from __future__ import annotations

from binascii import crc_hqx
from typing import Final

from canopen import SdoAbortedError

from trirail_drivers.simulated.dictionary import TOO_LONG

INVALID_BLOCK_SIZE = 0x05040002
INVALID_SEQUENCE = 0x05040003
CRC_ERROR = 0x05040004

MOST_SEGMENTS: Final = 127
"""Maximum number of segments in a block."""
_SEGMENT: Final = 7
"""Size of a segment [bytes]."""
_UPLOAD, _DOWNLOAD = 5, 6
"""Command specifiers of the client, in the three highest bits."""
_END, _ACKNOWLEDGED, _START = 1, 2, 3
"""Subcommands, in the two lowest bits."""
_ABORT: Final = 0x80
CRC_WANTED: Final = 0x04
"""Bit of the first frame of a transfer: the client (or, in the answer, the server) supports the CRC."""


class BlockUpload:
    """Block upload: the server sends blocks of segments, the client acknowledges each block, and a CRC follows."""

    def __init__(self, content: bytes, request: bytes) -> None:
        self.over = False
        self._content = content
        self._with_crc = bool(request[0] & CRC_WANTED)
        self._sent = 0
        """Number of acknowledged bytes."""
        self._size = request[4]
        self._check_size()

    def accepts(self, data: bytes) -> bool:
        """Return whether a frame belongs to the transfer."""
        return data[0] >> 5 == _UPLOAD and data[0] & 0x03 != 0

    def answers(self, data: bytes) -> list[bytes]:
        """Return the answers to a frame of the client. Raises SdoAbortedError."""
        what = data[0] & 0x03
        if what == _START:
            return self._block()
        if what == _ACKNOWLEDGED:
            return self._acknowledged(data[1], data[2])
        self.over = True
        return []

    def _acknowledged(self, last: int, size: int) -> list[bytes]:
        """Continue after the segment that the client has received last, with the block size that it now requests."""
        if last > self._size:
            raise SdoAbortedError(INVALID_SEQUENCE)
        self._sent = min(self._sent + last * _SEGMENT, max(len(self._content), 1))
        self._size = size
        self._check_size()
        return [self._end()] if self._sent >= len(self._content) else self._block()

    def _block(self) -> list[bytes]:
        frames = []
        for number in range(1, self._size + 1):
            at = self._sent + (number - 1) * _SEGMENT
            segment = self._content[at : at + _SEGMENT]
            last = at + _SEGMENT >= len(self._content)
            frames.append(bytes([number | last << 7]) + segment.ljust(_SEGMENT, b"\0"))
            if last:
                break
        return frames

    def _end(self) -> bytes:
        unused = -len(self._content) % _SEGMENT if self._content else _SEGMENT
        crc = crc_hqx(self._content, 0) if self._with_crc else 0
        return (bytes([0xC0 | unused << 2 | _END]) + crc.to_bytes(2, "little")).ljust(8, b"\0")

    def _check_size(self) -> None:
        if not 1 <= self._size <= MOST_SEGMENTS:
            raise SdoAbortedError(INVALID_BLOCK_SIZE)


class BlockDownload:
    """Block download: the client sends blocks of segments, the server acknowledges each block and checks the CRC."""

    def __init__(self, request: bytes, longest: int) -> None:
        self.over = False
        self.content = b""
        """Written data, complete when the transfer has ended."""
        self.size = MOST_SEGMENTS
        """Number of segments in a block."""
        self._with_crc = bool(request[0] & CRC_WANTED)
        self._longest = longest
        self._received = bytearray()
        self._number = 0
        self._last = False

    def accepts(self, data: bytes) -> bool:
        """Return whether a frame belongs to the transfer. Until the last segment, every frame except an abort does."""
        if self._last:
            return data[0] >> 5 == _DOWNLOAD and data[0] & 0x03 == _END
        return data[0] != _ABORT

    def answers(self, data: bytes) -> list[bytes]:
        """Return the answers to a frame of the client. Raises SdoAbortedError."""
        return self._segment(data) if not self._last else self._end(data)

    def _segment(self, data: bytes) -> list[bytes]:
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if not 1 <= number <= self.size:
            raise SdoAbortedError(INVALID_SEQUENCE)
        in_turn = number == self._number + 1
        if in_turn:  # segments after a gap are dropped; the client repeats them after the acknowledgement
            self._received += data[1:]
            self._number, self._last = number, last
            if len(self._received) > self._longest + _SEGMENT:
                raise SdoAbortedError(TOO_LONG)
        if not last and number < self.size:
            return []
        acknowledged, self._number = self._number, 0
        return [bytes([0xA0 | _ACKNOWLEDGED, acknowledged, self.size]).ljust(8, b"\0")]

    def _end(self, data: bytes) -> list[bytes]:
        unused = data[0] >> 2 & 0x07
        self.content = bytes(self._received[: len(self._received) - unused])
        if self._with_crc and crc_hqx(self.content, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoAbortedError(CRC_ERROR)
        self.over = True
        return [bytes([0xA0 | _END]).ljust(8, b"\0")]
