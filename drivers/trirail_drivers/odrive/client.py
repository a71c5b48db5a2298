"""Client of one ODrive, which sends one request at a time and awaits the answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import can

from trirail_drivers.bus.frames import Frame, FrameSender, send_in_setup
from trirail_drivers.driver.conversations import Wait
from trirail_drivers.errors import DriveAbsentError, DriveTimeout
from trirail_drivers.interface import Clock
from trirail_drivers.odrive import cansimple

ATTEMPTS: Final = 3
"""Number of times that a request is sent within `sdo_timeout`, since a frame may be lost."""


class OdriveClient:
    """Client of one drive. Among all received frames, it recognises the answers to its requests."""

    def __init__(self, bus: FrameSender, name: str, node: int, timeout: float, clock: Clock) -> None:
        self.name = name
        self.timeout = timeout
        self.clock = clock
        self.answered = 0
        """Number of answered requests."""
        self._bus = bus
        self.node = node
        self._beat: bytes | None = None
        """Data of the newest heartbeat that has not been returned yet."""

    def command(self, number: int, data: bytes) -> None:
        """Send a command, to which the drive sends no answer. Raises BusError."""
        send_in_setup(self._bus, cansimple.command(self.node, number, data))

    async def request(self, number: int, message_name: str) -> bytes:
        """Request a message by its command number and return its data.

        Raises BusError; DriveTimeout if the drive does not answer, or DriveAbsentError if it has never answered.
        """
        data = await self.try_request(number)
        if data is None:
            raise self.timeout_error(message_name)
        return data

    async def try_request(self, number: int) -> bytes | None:
        """Request a message by its command number; return its data, or None if the drive does not send it."""
        return await self._request(cansimple.request(self.node, number), number, lambda _: True)

    async def request_all(self, number: int) -> list[bytes]:
        """Request a message by its command number; return the different data that arrive within one attempt.

        The list is empty if no answer arrives, and has several items if nodes with the same id answer.
        """
        answers: list[bytes] = []
        data = await self.try_request(number)
        end = self.clock() + self.timeout / ATTEMPTS
        while data is not None:
            answers.append(data)
            data = await self._receive(number, end, lambda data: data not in answers)
        return answers

    async def read_setting(self, endpoint: int, path: str) -> bytes:
        """Read the bytes of the setting `path`, given its endpoint number.

        Raises the same errors as `request`.
        """
        question = cansimple.SDO.pack(cansimple.READ, endpoint, 0)
        data = await self._request(
            cansimple.command(self.node, cansimple.RX_SDO, question),
            cansimple.TX_SDO,
            lambda data: data[1:3] == question[1:3],  # the endpoint; a late answer has another one
        )
        if data is None:
            raise self.timeout_error(f"RxSdo of {path}")
        return data[cansimple.SDO.size :]

    async def heartbeat(self, deadline: float) -> bytes | None:
        """Return the data of a new heartbeat, or None if no heartbeat arrives before `deadline` [s]."""
        if self._beat is None:
            await self._receive(cansimple.HEARTBEAT, deadline, lambda _: True)
        beat, self._beat = self._beat, None
        return beat

    async def _request(self, question: Frame, number: int, accepts: Callable[[bytes], bool]) -> bytes | None:
        for _ in range(ATTEMPTS):
            send_in_setup(self._bus, question)
            data = await self._receive(number, self.clock() + self.timeout / ATTEMPTS, accepts)
            if data is not None:
                self.answered += 1
                return data
        return None

    async def _receive(self, number: int, deadline: float, accepts: Callable[[bytes], bool]) -> bytes | None:
        identifier, beats = (cansimple.identifier(self.node, each) for each in (number, cansimple.HEARTBEAT))

        def is_awaited(message: can.Message) -> bool:
            if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
                return False
            if message.arbitration_id == beats:
                self._beat = bytes(message.data)
            return message.arbitration_id == identifier and accepts(bytes(message.data))

        frame = await Wait(is_awaited, deadline)
        return None if frame is None else bytes(frame.data)

    def timeout_error(self, message_name: str) -> DriveTimeout:
        """Return the error for a message that the drive has not sent."""
        error = DriveTimeout if self.answered else DriveAbsentError
        return error(self.name, f"answer to {message_name}", self.timeout)
