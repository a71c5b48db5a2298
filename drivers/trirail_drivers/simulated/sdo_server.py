"""An SDO server: expedited and segmented transfers, and to whom block transfers go (CiA 301, service data objects)."""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from typing import Final

from trirail_drivers.simulated.dictionary import (
    LONGEST,
    NO_DATA,
    READ_ONLY,
    TOO_LONG,
    WRITE_ONLY,
    WRONG_LENGTH,
    Dictionary,
    ObjectEntry,
    SdoAbort,
)
from trirail_drivers.simulated.sdo_block import CRC_WANTED, BlockDownload, BlockUpload

TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001

_HEADER: Final = Struct("<BHB4s")
_ABORT: Final = Struct("<BHBI")


class SdoServer:
    """Serves one dictionary to one client, one transfer at a time."""

    def __init__(self, objects: Dictionary, respond: Callable[[bytes], None]) -> None:
        self._objects = objects
        self._respond = respond
        self.reset()

    def reset(self) -> None:
        """Forget the transfer under way."""
        self._key = (0, 0)
        self._toggle = 0
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._block: BlockUpload | BlockDownload | None = None

    def request(self, data: bytes) -> None:
        """Answer one frame of the client; one that is not eight bytes long is none (CiA 301)."""
        if len(data) != 8:
            return
        try:
            if self._block is not None and self._block.takes(data):
                self._go_on_in_blocks(self._block, data)
                return
            match data[0] >> 5:
                case 0:
                    self._download_segment(data)
                case 1:
                    self._start_download(data)
                case 2:
                    self._start_upload(data)
                case 3:
                    self._upload_segment(data)
                case 4:
                    self.reset()
                case 5:
                    self._start_block_upload(data)
                case 6:
                    self._start_block_download(data)
                case _:
                    self._refuse(data)
        except SdoAbort as abort:
            key = self._key
            self.reset()
            self._respond(_ABORT.pack(0x80, *key, abort.code))

    def _refuse(self, data: bytes) -> None:
        self._start(data)
        raise SdoAbort(UNKNOWN_COMMAND)

    def _start(self, data: bytes) -> tuple[ObjectEntry, bytes]:
        self.reset()
        _, index, subindex, payload = _HEADER.unpack(data)
        self._key = index, subindex
        return self._objects[index, subindex], payload

    def _readable(self, data: bytes) -> bytes:
        """What the object holds that a request to read names."""
        entry, _ = self._start(data)
        if not entry.readable:
            raise SdoAbort(WRITE_ONLY)
        if entry.index == 0x1003 and entry.subindex > self._objects.internal(0x1003, 0).value:
            raise SdoAbort(NO_DATA)  # CiA 301, 1003h: no such error in the history
        return entry.encode()

    def _writable(self, data: bytes) -> tuple[ObjectEntry, bytes]:
        entry, payload = self._start(data)
        if not entry.writable:
            raise SdoAbort(READ_ONLY)
        return entry, payload

    def _start_upload(self, data: bytes) -> None:
        content = self._readable(data)
        if 0 < len(content) <= 4:
            command = 0x43 | (4 - len(content)) << 2
            self._respond(_HEADER.pack(command, *self._key, content))
        else:
            self._upload = content
            self._respond(_HEADER.pack(0x41, *self._key, len(content).to_bytes(4, "little")))

    def _upload_segment(self, data: bytes) -> None:
        if self._upload is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        toggle = self._take_toggle(data)
        segment, self._upload = self._upload[:7], self._upload[7:] or None
        last = self._upload is None
        self._respond(bytes([toggle | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0"))

    def _start_download(self, data: bytes) -> None:
        entry, payload = self._writable(data)
        expedited, sized = data[0] & 0x02, data[0] & 0x01
        if expedited:
            length = 4 - (data[0] >> 2 & 0x03) if sized else min(entry.size or 4, 4)
            entry.load(payload[:length])
        else:
            self._download = bytearray()
            if sized and entry.size not in (None, int.from_bytes(payload, "little")):
                raise SdoAbort(WRONG_LENGTH)
        self._respond(_HEADER.pack(0x60, *self._key, b""))

    def _download_segment(self, data: bytes) -> None:
        if self._download is None:
            raise SdoAbort(UNKNOWN_COMMAND)
        toggle = self._take_toggle(data)
        self._download += data[1 : 8 - (data[0] >> 1 & 0x07)]
        entry = self._objects[self._key]
        if len(self._download) > (entry.size or LONGEST):
            raise SdoAbort(TOO_LONG)
        if data[0] & 0x01:
            content, self._download = bytes(self._download), None
            entry.load(content)
        self._respond(bytes([0x20 | toggle]).ljust(8, b"\0"))

    def _start_block_upload(self, data: bytes) -> None:
        if data[0] & 0x03:
            raise SdoAbort(UNKNOWN_COMMAND)
        content = self._readable(data)
        self._block = BlockUpload(content, data)
        self._respond(_HEADER.pack(0xC2 | data[0] & CRC_WANTED, *self._key, len(content).to_bytes(4, "little")))

    def _start_block_download(self, data: bytes) -> None:
        if data[0] & 0x01:
            raise SdoAbort(UNKNOWN_COMMAND)
        entry, payload = self._writable(data)
        if data[0] & 0x02 and entry.size not in (None, int.from_bytes(payload, "little")):
            raise SdoAbort(WRONG_LENGTH)
        self._block = block = BlockDownload(data, entry.size or LONGEST)
        self._respond(_HEADER.pack(0xA0 | data[0] & CRC_WANTED, *self._key, bytes([block.size])))

    def _go_on_in_blocks(self, block: BlockUpload | BlockDownload, data: bytes) -> None:
        answers = block.answers(data)
        if block.over:
            self._block = None
            if isinstance(block, BlockDownload):
                self._objects[self._key].load(block.content)
        for answer in answers:
            self._respond(answer)

    def _take_toggle(self, data: bytes) -> int:
        toggle = data[0] & 0x10
        if toggle != self._toggle:
            raise SdoAbort(TOGGLE_NOT_ALTERNATED)
        self._toggle ^= 0x10
        return toggle
