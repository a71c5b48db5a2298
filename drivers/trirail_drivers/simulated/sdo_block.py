"""SDO block transfers as a server does them: segments without an answer each, a CRC over all (CiA 301, SDO block)."""

from __future__ import annotations

from binascii import crc_hqx
from typing import Final

from trirail_drivers.simulated.dictionary import TOO_LONG, SdoAbort

INVALID_BLOCK_SIZE = 0x05040002
INVALID_SEQUENCE = 0x05040003
CRC_ERROR = 0x05040004

MOST_SEGMENTS: Final = 127
"""Segments of a block at most."""
_SEGMENT: Final = 7
"""Bytes of a segment."""
_UPLOAD, _DOWNLOAD = 5, 6
"""The client's command specifiers, in the three highest bits."""
_END, _ACKNOWLEDGED, _START = 1, 2, 3
"""What the two lowest bits tell."""
_ABORT: Final = 0x80
CRC_WANTED: Final = 0x04
"""Bit of a command that begins a transfer: the client, or in the answer the server, reckons the CRC."""


class BlockUpload:
    """The client reads: blocks of segments go out, each block is acknowledged, then the CRC."""

    def __init__(self, content: bytes, request: bytes) -> None:
        self.over = False
        self._content = content
        self._with_crc = bool(request[0] & CRC_WANTED)
        self._sent = 0
        """Bytes acknowledged."""
        self._size = request[4]
        self._check_size()

    def takes(self, data: bytes) -> bool:
        """Whether a frame belongs to the transfer."""
        return data[0] >> 5 == _UPLOAD and data[0] & 0x03 != 0

    def answers(self, data: bytes) -> list[bytes]:
        """Go on with what the client said."""
        what = data[0] & 0x03
        if what == _START:
            return self._block()
        if what == _ACKNOWLEDGED:
            return self._acknowledged(data[1], data[2])
        self.over = True
        return []

    def _acknowledged(self, last: int, size: int) -> list[bytes]:
        """Segments after the last one that arrived are sent again, in blocks of the size that the client wants now."""
        if last > self._size:
            raise SdoAbort(INVALID_SEQUENCE)
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
            raise SdoAbort(INVALID_BLOCK_SIZE)


class BlockDownload:
    """The client writes: its segments come in blocks, each block is acknowledged, then its CRC is checked."""

    def __init__(self, request: bytes, longest: int) -> None:
        self.over = False
        self.content = b""
        """What was written, when it is over."""
        self.size = MOST_SEGMENTS
        """Segments of a block."""
        self._with_crc = bool(request[0] & CRC_WANTED)
        self._longest = longest
        self._received = bytearray()
        self._number = 0
        self._last = False

    def takes(self, data: bytes) -> bool:
        """Whether a frame belongs to the transfer: all do but an abort, until the last segment has come."""
        if self._last:
            return data[0] >> 5 == _DOWNLOAD and data[0] & 0x03 == _END
        return data[0] != _ABORT

    def answers(self, data: bytes) -> list[bytes]:
        """Go on with what the client said."""
        return self._segment(data) if not self._last else self._end(data)

    def _segment(self, data: bytes) -> list[bytes]:
        number, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if not 1 <= number <= self.size:
            raise SdoAbort(INVALID_SEQUENCE)
        in_turn = number == self._number + 1
        if in_turn:  # those after a gap are let go, and sent again after the acknowledgement
            self._received += data[1:]
            self._number, self._last = number, last
            if len(self._received) > self._longest + _SEGMENT:
                raise SdoAbort(TOO_LONG)
        if not last and number < self.size:
            return []
        acknowledged, self._number = self._number, 0
        return [bytes([0xA0 | _ACKNOWLEDGED, acknowledged, self.size]).ljust(8, b"\0")]

    def _end(self, data: bytes) -> list[bytes]:
        unused = data[0] >> 2 & 0x07
        self.content = bytes(self._received[: len(self._received) - unused])
        if self._with_crc and crc_hqx(self.content, 0) != int.from_bytes(data[1:3], "little"):
            raise SdoAbort(CRC_ERROR)
        self.over = True
        return [bytes([0xA0 | _END]).ljust(8, b"\0")]
