"""An SDO client that asks one node and awaits its answers (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from typing import Final

import can
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames, duplicate_node
from trirail_drivers.cia402.conversations import Wait
from trirail_drivers.interface import Clock

SECOND_ANSWERS: Final = 10
"""So many requests of one set-up that are answered twice are answered by two nodes."""
EXPEDITED: Final = 4
"""So many bytes travel with the first frame."""
PAUSE: Final = 0.002
"""What a drive is given to take an abort in [s]."""

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)
"""The client's command specifiers: the first byte's top bits."""
_ANSWERS: Final = {_DOWNLOAD_SEGMENT: 1, _DOWNLOAD: 3, _UPLOAD: 2, _UPLOAD_SEGMENT: 0, _ABORT: 4}
"""Those of the server's answers."""
_SEGMENTS: Final = (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
"""Those whose frames name no object."""
_IS_EXPEDITED, _HAS_SIZE, _TOGGLE, _LAST = 0x02, 0x01, 0x10, 0x01
"""Bits of a first byte; the toggle bit and the last segment's are those of segments."""
_TIMED_OUT: Final = 0x0504_0000
_NOT_ALTERNATED: Final = 0x0503_0000
_GIVEN_UP: Final = 0x0800_0000
"""SDO abort codes: timed out, toggle bit not alternated, general."""


class TwoNodesError(SdoCommunicationError):
    """Requests are answered twice."""

    def __init__(self, node: int) -> None:
        super().__init__(duplicate_node.warning(node, "both answer"))


class NoAnswerError(SdoCommunicationError):
    """The drive has not answered in time."""


class BootedError(SdoCommunicationError):
    """In place of an answer the drive has sent its boot-up message."""


class Client:
    """Asks one node, whose answers and boot-up message it hears among all frames.

    A drive may still answer what somebody asked before, this service's last run or an attempt that was given up.
    So what is taken for the answer to a request is of its kind, and names the same object.
    """

    def __init__(self, bus: can.BusABC, node: int, objects: ObjectDictionary, timeout: float, clock: Clock) -> None:
        self.bus = bus
        self.node = node
        self.od = objects
        self.timeout = timeout
        self.clock = clock
        self.answered = 0
        """Requests that were answered so far."""
        self._asked: bytes | None = None
        self._last = bytes(8)
        self._again = 0
        self._knows_no_segments = False

    async def pause(self, seconds: float) -> None:
        """Wait [s]."""
        await Wait(self._is_awaited, self.clock() + seconds)

    async def upload(self, index: int, subindex: int) -> bytes:
        """All bytes that the drive has for an object: some tell four of one that is shorter.

        Raises SdoAbortedError where the drive refuses, NoAnswerError, and SdoCommunicationError for what else fails.
        """
        answer = await self._request(struct.pack("<BHBI", _UPLOAD << 5, index, subindex, 0))
        if answer[0] & _IS_EXPEDITED:
            unused = answer[0] >> 2 & 3 if answer[0] & _HAS_SIZE else 0
            return answer[4 : 8 - unused]
        content, toggle = b"", 0
        while True:
            answer = await self._request(bytes([_UPLOAD_SEGMENT << 5 | toggle, *bytes(7)]))
            if answer[0] & _TOGGLE != toggle:
                self._abort(index, subindex, code=_NOT_ALTERNATED)
                raise SdoCommunicationError("Toggle bit mismatch")
            content += answer[1 : 8 - (answer[0] >> 1 & 7)]
            if answer[0] & _LAST:
                return content
            toggle ^= _TOGGLE

    async def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object; raises as `upload` does."""
        if 1 <= len(data) <= EXPEDITED:
            first = _DOWNLOAD << 5 | (EXPEDITED - len(data)) << 2 | _IS_EXPEDITED | _HAS_SIZE
            await self._request(struct.pack("<BHB4s", first, index, subindex, data))
            return
        await self._request(struct.pack("<BHBI", _DOWNLOAD << 5 | _HAS_SIZE, index, subindex, len(data)))
        toggle = 0
        for at in range(0, max(1, len(data)), 7):
            piece = data[at : at + 7]
            last = _LAST * (at + 7 >= len(data))
            first = _DOWNLOAD_SEGMENT << 5 | toggle | (7 - len(piece)) << 1 | last
            await self._request(struct.pack("<B7s", first, piece))
            toggle ^= _TOGGLE

    async def try_download(self, index: int, subindex: int, size: int) -> None:
        """Begin to write so many bytes and give it up before the first; SdoAbortedError where the drive refuses.

        A segmented download, whose first frame has the length only (CiA 301, SDO download initiate). A drive that
        answers none is not asked again: it takes expedited ones alone, and each would be waited for.
        """
        if self._knows_no_segments:
            return
        try:
            await self._request(struct.pack("<BHBI", _DOWNLOAD << 5 | _HAS_SIZE, index, subindex, size))
        except NoAnswerError:
            self._knows_no_segments = True
            return
        self._abort(index, subindex, code=_GIVEN_UP)
        # An abort is not answered, and the next request could overtake it in a drive that has room for one frame.
        await self.pause(PAUSE)

    async def _request(self, request: bytes) -> bytes:
        self._asked = request
        self._send(request)
        frame = await Wait(self._is_awaited, self.clock() + self.timeout)
        self._asked, self._last = None, request
        if self._again >= SECOND_ANSWERS:
            raise TwoNodesError(self.node)
        if frame is None:
            self._abort(*struct.unpack_from("<HB", request, 1), code=_TIMED_OUT)
            raise NoAnswerError("no answer")
        answer = bytes(frame.data)
        if frame.arbitration_id == canopen_frames.HEARTBEAT + self.node:
            raise BootedError("it has restarted")
        self.answered += 1
        if answer[0] >> 5 == _ABORT:
            raise SdoAbortedError(int.from_bytes(answer[4:], "little"))
        return answer

    def _abort(self, index: int, subindex: int, *, code: int) -> None:
        self._send(struct.pack("<BHBI", _ABORT << 5, index, subindex, code))

    def _send(self, data: bytes) -> None:
        self.bus.send(Frame(canopen_frames.SDO_REQUEST + self.node, data).message())

    def _is_awaited(self, message: can.Message) -> bool:
        """Whether a frame ends the waiting: the answer, a boot-up message in its place, an answer once too often.

        A request that was answered already may be once more by chance; so many are two servers.
        """
        if message.is_error_frame or message.is_remote_frame:
            return False
        data = bytes(message.data)
        if message.arbitration_id == canopen_frames.HEARTBEAT + self.node:
            return self._asked is not None and data == bytes([canopen_frames.BOOT_UP])
        if message.arbitration_id != canopen_frames.SDO_ANSWER + self.node:
            return False
        if self._asked is not None and answers(self._asked, data):
            return True
        self._again += answers(self._last, data)
        return self._asked is not None and self._again >= SECOND_ANSWERS


def answers(request: bytes, data: bytes) -> bool:
    """Whether a frame of an SDO server can be the answer to a request (CiA 301, 7.2.4.3: the first byte's top bits)."""
    if len(data) != 8:
        return False
    asked, answered = request[0] >> 5, data[0] >> 5
    same_object = asked in _SEGMENTS or data[1:4] == request[1:4]
    return same_object and answered in (_ANSWERS[asked], _ABORT)
