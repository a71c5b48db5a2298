"""A drive's object dictionary over SDO, without threads: reads, writes and checks that name what failed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can
import canopen
from canopen.objectdictionary import ObjectDictionary, ODVariable
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trirail_drivers.cia402 import frames
from trirail_drivers.cia402.settings import INVALID, NO_REMOTE_REQUEST
from trirail_drivers.errors import BusError, ConfigurationRefused, DriveError, DriveTimeout

# What canopen would say of a failed transfer is in the DriveError; standard error is for that one line.
logging.getLogger("canopen").addHandler(logging.NullHandler())

Clock = Callable[[], float]

NO_SUCH_OBJECT = (0x0602_0000, 0x0609_0011)
"""SDO abort codes: object does not exist, subindex does not exist (CiA 301)."""


class Client(SdoClient):
    """An SDO client that reads the bus itself while it waits, where canopen would have a thread do it."""

    def __init__(self, bus: can.BusABC, node: int, objects: ObjectDictionary, timeout: float, clock: Clock) -> None:
        super().__init__(frames.SDO_REQUEST + node, frames.SDO_ANSWER + node, objects)  # type: ignore[no-untyped-call]
        self.network = canopen.Network(bus)
        self.bus = bus
        self.timeout = timeout
        self.clock = clock

    def read_response(self) -> bytes:
        """Wait for the drive's answer; other frames are let go, for the cycle starts afresh."""
        deadline = self.clock() + self.timeout
        while self.responses.empty():
            message = self.bus.recv(max(0.0, deadline - self.clock()))
            if message is None:
                raise SdoCommunicationError("no answer")
            if message.arbitration_id == self.tx_cobid and not message.is_error_frame:
                self.responses.put(bytes(message.data))
        response: bytes = super().read_response()  # type: ignore[no-untyped-call]
        return response


class Remote:
    """A drive's object dictionary over SDO; every failure is told as this drive's and this object's."""

    def __init__(self, name: str, client: Client) -> None:
        self.name = name
        self.client = client

    def read(self, index: int, subindex: int = 0) -> int:
        """Value of an object."""
        variable = self._variable(index, subindex)
        with self._told("read", index, subindex, variable.qualname):
            return int(variable.decode_raw(self.client.upload(index, subindex)))

    def write(self, index: int, subindex: int, value: int) -> None:
        """Give an object a value."""
        variable = self._variable(index, subindex)
        with self._told(f"write {value} to", index, subindex, variable.qualname):
            self.client.download(index, subindex, variable.encode_raw(value))

    def check(self, index: int, subindex: int, wanted: int) -> None:
        """Read an object back; ConfigurationRefused if its value is not the wanted one."""
        found = self.read(index, subindex)
        # Bit 30 of a PDO's COB-ID tells whether remote requests are answered: unused here, so either will do.
        ignored = NO_REMOTE_REQUEST if index & 0xFA00 in (0x1400, 0x1800) and subindex == 1 else 0
        if found | ignored != wanted | ignored:
            name = self._variable(index, subindex).qualname
            # PDO parameters are bit fields, and read as the standard writes them.
            form = "{:08X}h" if 0x1400 <= index < 0x1C00 else "{}"
            raise ConfigurationRefused(self.name, name, index, subindex, form.format(wanted), form.format(found))

    def invalidate(self, index: int) -> None:
        """Switch off the PDO whose communication parameters are at `index`, if the drive has it at all."""
        with self._told("switch off the PDO of", index, 1, "COB-ID used by PDO"):
            try:
                identifier = int.from_bytes(self.client.upload(index, 1), "little")
            except SdoAbortedError as error:
                if error.code in NO_SUCH_OBJECT:
                    return
                raise
            if not identifier & INVALID:
                self.client.download(index, 1, (identifier | INVALID).to_bytes(4, "little"))

    def _variable(self, index: int, subindex: int) -> ODVariable:
        variable = self.client.od.get_variable(index, subindex)
        if variable is None:
            raise DriveError(f"drive {self.name}: object {index:04X}:{subindex:02X} is not in its EDS")
        return variable

    @contextmanager
    def _told(self, attempt: str, index: int, subindex: int, name: str) -> Iterator[None]:
        """Turn what canopen and the bus raise into the one tree of errors."""
        called = f"object {index:04X}:{subindex:02X} ({name})"
        try:
            yield
        except SdoAbortedError as error:
            reason = error.CODES.get(error.code, "for a reason of its own")
            raise DriveError(
                f"drive {self.name}: cannot {attempt} {called}: {reason} (SDO abort {error.code:08X})"
            ) from error
        except SdoCommunicationError as error:
            raise DriveTimeout(self.name, f"answer about {called}", self.client.timeout) from error
        except (can.CanError, OSError) as error:
            raise BusError(f"drive {self.name}: cannot {attempt} {called}: {error}") from error
