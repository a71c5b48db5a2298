"""SDO server of a simulated device: python-canopen's server, extended by block transfers (CiA 301, SDO)."""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from typing import Any, Final

from canopen import SdoAbortedError
from canopen.sdo.server import SdoServer as CanopenServer

from trirail_drivers.simulated.dictionary import (
    MAX_DOMAIN_SIZE,
    NO_DATA,
    READ_ONLY,
    TOO_LONG,
    WRITE_ONLY,
    WRONG_LENGTH,
    Dictionary,
    ObjectEntry,
)
from trirail_drivers.simulated.sdo_block import CRC_WANTED, BlockDownload, BlockUpload

UNKNOWN_COMMAND: Final = 0x05040001

_HEADER: Final = Struct("<BHB4s")
_EXPEDITED, _SIZED, _UNUSED_AT = 0x02, 0x01, 2
_TOGGLE, _LAST = 0x10, 0x01
"""Bits of the first byte of a download and of its segments (CiA 301, SDO download)."""


class SdoServer(CanopenServer):
    """SDO server of one dictionary for one client; it handles one transfer at a time."""

    _index: Any  # canopen's server has no type hints
    _subindex: Any
    _buffer: Any

    def __init__(self, objects: Dictionary, respond: Callable[[bytes], None]) -> None:
        self.object_dictionary = objects
        super().__init__(0, 0, self)  # type: ignore[no-untyped-call]
        self._objects = objects
        self._respond = respond
        self.reset()

    def reset(self) -> None:
        """Discard the current transfer."""
        self._index = self._subindex = 0
        self._buffer = bytearray()
        self._uploads = False
        self._longest = 0
        self._block: BlockUpload | BlockDownload | None = None

    def request(self, data: bytes) -> None:
        """Answer one frame from the client; a frame that is not eight bytes long is ignored (CiA 301)."""
        if len(data) != 8:
            return
        block = self._block
        if block is None or not block.accepts(data):
            self._block = None
            self.on_request(0, data, 0.0)  # type: ignore[no-untyped-call]
            return
        try:
            self._continue_block(block, data)
        except SdoAbortedError as refused:
            self.abort(refused.code)

    def get_data(self, index: int, subindex: int, *, check_readable: bool = False) -> bytes:
        """Return the content of an object, as python-canopen's LocalNode does. Raises SdoAbortedError."""
        entry = self._objects[index, subindex]
        if check_readable and not entry.readable:
            raise SdoAbortedError(WRITE_ONLY)
        if index == 0x1003 and subindex > self._objects.internal(0x1003, 0).value:
            raise SdoAbortedError(NO_DATA)  # CiA 301, 1003h: no such error in the history
        return entry.encode()

    def set_data(self, index: int, subindex: int, data: bytes, *, check_writable: bool = False) -> None:  # noqa: ARG002
        """Write an object, as python-canopen's LocalNode does. Raises SdoAbortedError."""
        self._objects[index, subindex].load(bytes(data))

    def send_response(self, response: bytes) -> None:
        """Send a frame to the client."""
        self._respond(bytes(response))

    def abort(self, abort_code: int = UNKNOWN_COMMAND) -> None:
        """End the current transfer and send the abort code; the default is that of a segment without a transfer."""
        super().abort(abort_code)  # type: ignore[no-untyped-call]
        self.reset()

    def init_download(self, request: bytes) -> None:
        """Begin a download. Refuse an impossible write before its first segment.

        python-canopen's server would refuse the write only after the last segment. If a request states no size, the
        size of the object in the dictionary is used; python-canopen's server would assume four bytes.
        """
        entry = self._writable(request)
        command, index, subindex, payload = _HEADER.unpack(request)
        if command & _EXPEDITED:
            if not command & _SIZED:
                command |= _SIZED | (4 - min(entry.size or 4, 4)) << _UNUSED_AT
        elif command & _SIZED and entry.size not in (None, int.from_bytes(payload, "little")):
            raise SdoAbortedError(WRONG_LENGTH)
        self._uploads = False
        self._longest = 0 if command & _EXPEDITED else entry.size or MAX_DOMAIN_SIZE
        super().init_download(_HEADER.pack(command, index, subindex, payload))  # type: ignore[no-untyped-call]

    def init_upload(self, request: bytes) -> None:
        """Begin an upload.

        The answer for an empty object is a segment without data; python-canopen's server would refuse the request.
        """
        self._name(request)
        content = self.get_data(self._index, self._subindex, check_readable=True)
        self._uploads = not 0 < len(content) <= 4
        self._longest = 0
        if content:
            super().init_upload(request)  # type: ignore[no-untyped-call]
            return
        self._buffer, self._toggle = bytearray(), 0
        self._answer(0x41, bytes(4))

    def segmented_upload(self, command: int) -> None:
        """Send the next segment; a request without a transfer is refused."""
        if not self._uploads:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        super().segmented_upload(command)  # type: ignore[no-untyped-call]
        self._uploads = bool(self._buffer)

    def segmented_download(self, command: int, request: bytes) -> None:
        """Accept the next segment. Refuse a segment without a transfer, or one that exceeds the object's length."""
        if not self._longest:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        in_turn = command & _TOGGLE == self._toggle
        if in_turn and len(self._buffer) + 7 - (command >> 1 & 7) > self._longest:
            raise SdoAbortedError(TOO_LONG)
        super().segmented_download(command, request)  # type: ignore[no-untyped-call]
        if command & _LAST:
            self._longest = 0

    def block_upload(self, data: bytes) -> None:
        """Begin a block upload, which then handles the following frames."""
        if data[0] & 0x03:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        self._name(data)
        content = self.get_data(self._index, self._subindex, check_readable=True)
        self._block = BlockUpload(content, data)
        self._answer(0xC2 | data[0] & CRC_WANTED, len(content).to_bytes(4, "little"))

    def block_download(self, data: bytes) -> None:
        """Begin a block download, which then handles the following frames."""
        if data[0] & 0x01:
            raise SdoAbortedError(UNKNOWN_COMMAND)
        entry = self._writable(data)
        if data[0] & 0x02 and entry.size not in (None, int.from_bytes(data[4:], "little")):
            raise SdoAbortedError(WRONG_LENGTH)
        self._block = block = BlockDownload(data, entry.size or MAX_DOMAIN_SIZE)
        self._answer(0xA0 | data[0] & CRC_WANTED, bytes([block.size]))

    def _name(self, request: bytes) -> None:
        """Store the object that a request names, because an abort must name the object, too."""
        _, self._index, self._subindex, _ = _HEADER.unpack(request)

    def _writable(self, request: bytes) -> ObjectEntry:
        self._name(request)
        entry = self._objects[self._index, self._subindex]
        if not entry.writable:
            raise SdoAbortedError(READ_ONLY)
        return entry

    def _continue_block(self, block: BlockUpload | BlockDownload, data: bytes) -> None:
        answers: Any = block.answers(data)
        if block.over:
            self._block = None
            if isinstance(block, BlockDownload):
                self.set_data(self._index, self._subindex, block.content)
        for answer in answers:
            self._respond(answer)

    def _answer(self, command: int, payload: bytes) -> None:
        self._respond(_HEADER.pack(command, self._index, self._subindex, payload))
