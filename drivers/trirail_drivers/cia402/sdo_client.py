"""SDO client of one node (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from typing import Final

import can
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trirail_drivers.bus import canerrors
from trirail_drivers.bus.frames import Frame, FrameSender, can_id
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.objects import Key
from trirail_drivers.driver.conversations import Wait
from trirail_drivers.driver.duplicate_node import warning
from trirail_drivers.interface import Clock

MAX_SECOND_ANSWERS: Final = 10
"""Number of second answers within one set-up that proves that there are two nodes with the same id."""
EXPEDITED: Final = 4
"""Maximum size of a value in an expedited transfer [bytes]."""
MAX_UPLOAD: Final = 1 << 16
"""Maximum size of a value that is read [bytes]. Texts and numbers are far smaller; no domain is read."""
ABORT_PAUSE_S: Final = 0.002
"""Pause after an abort, during which the drive handles the abort [s]."""

_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)
"""Command specifiers of the client, in the top bits of the first byte."""
_ANSWERS: Final = {_DOWNLOAD_SEGMENT: 1, _DOWNLOAD: 3, _UPLOAD: 2, _UPLOAD_SEGMENT: 0, _ABORT: 4}
"""Command specifier of the server's answer to each command specifier of the client."""
_SEGMENTS: Final = (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
"""Command specifiers of frames without index and subindex."""
_IS_EXPEDITED, _HAS_SIZE, _TOGGLE, _LAST = 0x02, 0x01, 0x10, 0x01
"""Bits of the first byte. The last two bits are those of segments."""
_TIMED_OUT: Final = 0x0504_0000
_NOT_ALTERNATED: Final = 0x0503_0000
_GENERAL_ABORT: Final = 0x0800_0000
"""SDO abort codes: timed out, toggle bit not alternated, general."""


class TwoNodesError(SdoCommunicationError):
    """Requests have received two answers, so two nodes have the same id."""

    def __init__(self, node: int) -> None:
        super().__init__(warning(node, "both answer"))


class NoAnswerError(SdoCommunicationError):
    """The drive has not answered in time."""


class BootedError(SdoCommunicationError):
    """The drive has sent its boot-up message since the last answer."""


class Client:
    """SDO client of one node. Among all received frames, it recognises the node's answers and boot-up messages.

    A drive may still answer a request of a previous run of the service or of an aborted attempt. Therefore a frame is
    accepted as the answer to a request only if it has the expected command specifier and object.
    """

    def __init__(self, bus: FrameSender, node: int, objects: ObjectDictionary, timeout: float, clock: Clock) -> None:
        self.bus = bus
        self.node = node
        self.od = objects
        self.timeout = timeout
        self.clock = clock
        self.answered = 0
        """Number of answered requests."""
        self.has_booted = False
        """Whether the drive has sent a boot-up message that no request has reported yet."""
        self.is_stopped = False
        """Whether the newest heartbeat received while waiting shows NMT stopped, in which a node answers no request."""
        self.asked: bytes | None = None
        """Request whose answer is awaited."""
        self._last = bytes(8)
        self._again = 0
        self._knows_no_segments = False

    def observe(self, message: can.Message) -> None:
        """Note a boot-up message, which may also arrive while no request is pending."""
        self.has_booted |= self._is_boot_up(message)

    async def pause(self, seconds: float) -> None:
        """Wait for `seconds` [s]."""
        await Wait(self._is_awaited, self.clock() + seconds)

    async def upload(self, index: int, subindex: int) -> bytes:
        """Read an object. Some drives pad a shorter value to four bytes.

        Raises SdoAbortedError if the drive refuses, NoAnswerError, and SdoCommunicationError for other failures, such
        as segments that never end.
        """
        answer = await self._request(struct.pack("<BHBI", _UPLOAD << 5, index, subindex, 0))
        if answer[0] & _IS_EXPEDITED:
            unused = answer[0] >> 2 & 3 if answer[0] & _HAS_SIZE else EXPEDITED - self._described_size(index, subindex)
            return answer[4 : 8 - unused]
        size = int.from_bytes(answer[4:], "little") if answer[0] & _HAS_SIZE else None
        content, toggle = b"", 0
        while True:
            answer = await self._request(bytes([_UPLOAD_SEGMENT << 5 | toggle, *bytes(7)]), (index, subindex))
            if answer[0] & _TOGGLE != toggle:
                self._abort(index, subindex, code=_NOT_ALTERNATED)
                raise SdoCommunicationError("Toggle bit mismatch")
            segment = answer[1 : 8 - (answer[0] >> 1 & 7)]
            content += segment
            if answer[0] & _LAST:
                break
            if not segment or len(content) > min(MAX_UPLOAD, MAX_UPLOAD if size is None else size):
                self._abort(index, subindex, code=_GENERAL_ABORT)
                announced = "no size" if size is None else f"{size}"
                raise SdoCommunicationError(f"{len(content)} bytes received without an end, {announced} announced")
            toggle ^= _TOGGLE
        if size not in (None, len(content)):
            raise SdoCommunicationError(f"{len(content)} bytes received, {size} announced")
        return content

    def _described_size(self, index: int, subindex: int) -> int:
        """Return the size of a value in an expedited transfer that does not contain the size [bytes]."""
        variable = self.od.get_variable(index, subindex)
        return min(EXPEDITED, len(variable) // 8) if variable is not None and variable.fixed_size else EXPEDITED

    async def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write an object. Raises the same errors as `upload`."""
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
            await self._request(struct.pack("<B7s", first, piece), (index, subindex))
            toggle ^= _TOGGLE

    async def try_download(self, index: int, subindex: int, size: int) -> None:
        """Begin to write `size` bytes, and abort before the first byte. Raises SdoAbortedError if the drive refuses.

        The first frame of a segmented download contains only the size (CiA 301, SDO download initiate). A drive that
        does not answer this frame accepts only expedited transfers. It is not asked again, since every such request
        would time out.
        """
        if self._knows_no_segments:
            return
        try:
            await self._request(struct.pack("<BHBI", _DOWNLOAD << 5 | _HAS_SIZE, index, subindex, size))
        except NoAnswerError:
            self._knows_no_segments = True
            return
        self._abort(index, subindex, code=_GENERAL_ABORT)
        # An abort has no answer, and the next request could overwrite it in a drive that buffers only one frame.
        await self.pause(ABORT_PAUSE_S)

    async def _request(self, request: bytes, key: Key | None = None) -> bytes:
        """Send a request, and return the answer. `key` is the object of a segment, which does not contain it."""
        self._check_booted()
        self.asked = request
        self._send(request)
        frame = await Wait(self._is_awaited, self.clock() + self.timeout)
        self.asked, self._last = None, request
        if self._again >= MAX_SECOND_ANSWERS:
            raise TwoNodesError(self.node)
        if frame is None:
            index, subindex = key or struct.unpack_from("<HB", request, 1)
            self._abort(index, subindex, code=_TIMED_OUT)
            raise NoAnswerError("no answer")
        self.observe(frame)
        self._check_booted()
        answer = bytes(frame.data)
        self.answered += 1
        if answer[0] >> 5 == _ABORT:
            raise SdoAbortedError(int.from_bytes(answer[4:], "little"))
        return answer

    def _check_booted(self) -> None:
        booted, self.has_booted = self.has_booted, False
        if booted:
            raise BootedError("the drive has restarted")

    def _abort(self, index: int, subindex: int, *, code: int) -> None:
        self._send(struct.pack("<BHBI", _ABORT << 5, index, subindex, code))

    def _send(self, data: bytes) -> None:
        try:
            self.bus.send(Frame(canopen_frames.SDO_REQUEST + self.node, data).message())
        except (can.CanError, OSError) as error:
            # While all drives are off, no node acknowledges frames, and the queue becomes full. The request times out.
            if not canerrors.queue_is_full(error):
                raise

    def _is_awaited(self, message: can.Message) -> bool:
        """Whether a frame ends the wait: the answer, a boot-up message, or the last of too many second answers.

        A single second answer may be a late answer, but MAX_SECOND_ANSWERS of them prove that there are two servers.
        """
        if self._is_boot_up(message):
            return self.asked is not None
        identifier, data = can_id(message), bytes(message.data)
        if identifier == canopen_frames.HEARTBEAT + self.node and data:
            self.is_stopped = data[0] & canopen_frames.NMT_STATE_BITS == canopen_frames.STOPPED
        if identifier != canopen_frames.SDO_ANSWER + self.node:
            return False
        if self.asked is not None and answers(self.asked, data):
            return True
        self._again += answers(self._last, data)
        return self.asked is not None and self._again >= MAX_SECOND_ANSWERS

    def _is_boot_up(self, message: can.Message) -> bool:
        own = can_id(message) == canopen_frames.HEARTBEAT + self.node
        return own and bytes(message.data) == bytes([canopen_frames.BOOT_UP])


def answers(request: bytes, data: bytes) -> bool:
    """Whether a frame of an SDO server can be the answer to a request (CiA 301, 7.2.4.3: top bits of first byte)."""
    if len(data) != 8:
        return False
    asked, answered = request[0] >> 5, data[0] >> 5
    same_object = asked in _SEGMENTS or data[1:4] == request[1:4]
    return same_object and answered in (_ANSWERS[asked], _ABORT)
