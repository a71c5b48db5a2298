"""Access to the object dictionary of a drive over SDO: reading, writing and checking of objects."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, TypeVar

import can
from canopen.objectdictionary import INTEGER_TYPES, SIGNED_TYPES
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from trirail_drivers.cia402.objects import Key, find_use, signed, width
from trirail_drivers.cia402.sdo_client import EXPEDITED, BootedError, Client, NoAnswerError, TwoNodesError
from trirail_drivers.driver.conversations import read_until, run_concurrently
from trirail_drivers.errors import BusError, DriveError, DriveTimeout
from trirail_drivers.interface import Clock

T = TypeVar("T")

NO_SUCH_OBJECT: Final = (0x0602_0000, 0x0609_0011)
"""SDO abort codes: object does not exist, subindex does not exist (CiA 301)."""
READ_ONLY: Final = 0x0601_0002
"""SDO abort code: an attempt to write a read-only object."""
TOO_LONG: Final = 0x0607_0012
WRONG_LENGTH: Final = (0x0607_0010, TOO_LONG, 0x0607_0013)
"""SDO abort codes: the value has a different length from the object, is too long, or is too short."""
INVALID: Final = 1 << 31
"""Bit of a PDO's COB-ID that marks the PDO as not used."""
NO_REMOTE_REQUEST: Final = 1 << 30
"""Bit of a TPDO's COB-ID that excludes remote requests. Some drives always report this bit, others never do."""
_SYNC_BITS: Final = 0x6000_07FF
"""Bits of 1005h: generation of SYNC, extended frames, and identifier. CiA 301 does not define bit 31."""
_BIT_FIELDS: Final = (0x1005, 0x1014, 0x60A8, 0x60A9, 0x60AA, 0x60FD, 0x60FE, 0x6502)


class SdoRefused(DriveError):
    """A drive refused a request for an object."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class RestartedError(DriveError):
    """A drive has restarted and lost its set-up."""


class TransferError(DriveError):
    """An SDO transfer contradicts the protocol, as after a lost frame."""


class Remote:
    """Object dictionary of a drive over SDO. Errors name the drive and the object.

    A value that has been read is cached until the object is written, since nobody else configures the drive meanwhile.
    """

    rehearsed = False
    """Whether this is a dry run, which writes no object."""
    read_only = False
    """Whether even the power of the drive is unchanged, and the drive is only asked which objects may be written."""

    boots = False
    """Whether the client is waiting for the drive to boot."""

    logs = True
    """Whether this wait is logged. It is not logged in the cycle."""

    def __init__(self, name: str, client: Client, skipped: str = "") -> None:
        self.name = name
        self.skipped = skipped
        """Note for people about the parts of the drive's EDS that were skipped, or ""."""
        self.client = client
        self._read: dict[Key, bytes | None] = {}
        self._missing: set[Key] = set()
        self._writable: dict[Key, bool] = {}
        self._described: dict[Key, tuple[int, bool]] = {}

    def describe(self, key: Key, size: int, *, signed: bool) -> None:
        """Set the size [bytes] of an object that no standard defines, and whether its values are signed."""
        self._described[key] = size, signed

    async def peek(self, index: int, subindex: int = 0) -> int | None:
        """Return the value of an object, from the cache or the drive; None if it is missing or cannot be read."""
        key = index, subindex
        if key not in self._read and key not in self._missing:
            try:
                with self._as_drive_error("read", key):
                    self._read[key] = await self.client.upload(index, subindex)
            except SdoRefused as refusal:
                if refusal.code in NO_SUCH_OBJECT:
                    self._missing.add(key)
                else:
                    self._read[key] = None
        data = self._read.get(key)
        return None if data is None else self._value(key, data)

    async def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the drive has an object."""
        await self.peek(index, subindex)
        return (index, subindex) not in self._missing

    async def read(self, index: int, subindex: int = 0) -> int:
        """Read the present value of an object from the drive. Raises SdoRefused if it cannot be read."""
        key = index, subindex
        return self._value(key, await self.content(key))

    async def content(self, key: Key) -> bytes:
        """Read the present bytes of an object from the drive. Raises SdoRefused if it cannot be read."""
        with self._as_drive_error("read", key):
            data = self._read[key] = await self.client.upload(*key)
        return self._own(key, data)

    async def write(self, index: int, subindex: int, value: int) -> None:
        """Write the value of an object. Raises SdoRefused if the drive refuses it."""
        key = index, subindex
        await self.put(key, await self._encoded(key, value), shown(index, subindex, value))

    async def put(self, key: Key, data: bytes, value: str) -> None:
        """Write the bytes of an object, shown to people as `value`. Raises SdoRefused if the drive refuses them."""
        self._read.pop(key, None)
        with self._as_drive_error(f"write {value} to", key):
            await self.client.download(*key, data)

    async def may_be_written(self, index: int, subindex: int = 0) -> bool:
        """Whether an object may be written, as far as the drive reports this before it receives a value."""
        key = index, subindex
        if key not in self._writable:
            try:
                await self._try_to_write("write", key, await self.bits(index, subindex) // 8)
            except SdoRefused:
                self._writable[key] = False
            else:
                self._writable[key] = True
        return self._writable[key]

    async def _try_to_write(self, attempt: str, key: Key, size: int) -> None:
        """Begin and abort a write. Raises SdoRefused if the object must not be written, or has a different size.

        Other refusals, such as that of a segmented transfer, are ignored.
        """
        try:
            with self._as_drive_error(attempt, key):
                await self.client.try_download(*key, size)
        except SdoRefused as refusal:
            read = len(self._read.get(key) or b"") == size  # then the size is known to be right
            if refusal.code in (READ_ONLY, *NO_SUCH_OBJECT, *(() if read else WRONG_LENGTH)):
                raise

    async def bits(self, index: int, subindex: int = 0) -> int:
        """Return the length of an object [bits], as read from the drive or, if it cannot be read, as described, or
        according to the drive's EDS or the standards.
        """
        key = index, subindex
        await self.peek(index, subindex)
        known = self._read.get(key)
        return 8 * (self._size(key) if known is None else len(self._own(key, known)))

    async def _encoded(self, key: Key, value: int) -> bytes:
        """Encode a value for an SDO. Raises SdoRefused if it is too long for the object."""
        size = await self.bits(*key) // 8
        if not size or not -1 << 8 * size - 1 <= value < 1 << 8 * size:
            raise SdoRefused(
                f"drive {self.name}: cannot write {shown(*key, value)} to {self._called(key)}: "
                f"the drive's object has {8 * size} bits, but the standard requires {8 * width(key)} bits",
                TOO_LONG,
            )
        return (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    async def wait_until(
        self, key: Key, predicate: Callable[[int], bool], seconds: float | None = None
    ) -> tuple[int | None, float]:
        """Read an object until `predicate` is True for its value, for at most `seconds`, or the time-out of an answer.

        This is needed because a drive may accept a value immediately and show it later. Return the value, or None if it
        cannot be read, and the time waited [s].
        """

        async def read() -> int | None:
            self._read.pop(key, None)
            return await self.peek(*key)

        def is_done(value: int | None) -> bool:
            return value is None or predicate(value)

        client = self.client
        return await read_until(
            read, is_done, client.pause, client.clock, client.timeout if seconds is None else seconds
        )

    def _value(self, key: Key, data: bytes) -> int:
        return int.from_bytes(self._own(key, data), "little", signed=self._signed(key))

    def _signed(self, key: Key) -> bool:
        return self._described[key][1] if key in self._described else signed(key)

    def _own(self, key: Key, data: bytes) -> bytes:
        """Return the bytes of an answer without padding, according to the object's length in the EDS.

        Some drives pad each value to four bytes. Other bytes are part of a value that is longer than in the EDS.
        """
        variable = self.client.od.get_variable(*key)
        if not data or len(data) > EXPEDITED or variable is None or not variable.fixed_size:
            return data
        own = data[: len(variable) // 8]
        is_negative = variable.data_type in SIGNED_TYPES and own[-1] & 0x80
        paddings = (b"\0", b"\xff") if is_negative else (b"\0",)
        return own if any(data == own.ljust(len(data), padding) for padding in paddings) else data

    def _size(self, key: Key) -> int:
        """Return the size of an object that cannot be read [bytes], as described, or according to the drive's EDS or
        the standards.
        """
        if key in self._described:
            return self._described[key][0]
        variable = self.client.od.get_variable(*key)
        return len(variable) // 8 if variable is not None and variable.data_type in INTEGER_TYPES else width(key)

    def name_of(self, key: Key) -> str:
        """Return the name of an object for people."""
        variable = self.client.od.get_variable(*key)
        if variable is not None:
            return str(variable.qualname)
        used = find_use(key)
        return used[1].name if used else "not in its EDS"

    def _called(self, key: Key) -> str:
        return f"object {key[0]:04X}:{key[1]:02X} ({self.name_of(key)})"

    def restarted(self) -> RestartedError:
        """Return the error of a drive that has restarted."""
        return RestartedError(f"drive {self.name}: the drive restarted meanwhile; check its power supply")

    @contextmanager
    def _as_drive_error(self, attempt: str, key: Key) -> Iterator[None]:
        """Convert exceptions of canopen and the bus into DriveErrors."""
        called = self._called(key)
        try:
            yield
        except SdoAbortedError as error:
            raise SdoRefused(
                f"drive {self.name}: cannot {attempt} {called}: {reason(error.code)}", error.code
            ) from error
        except TwoNodesError as error:
            raise DriveError(f"drive {self.name}: {error}") from error
        except NoAnswerError as error:
            raise DriveTimeout(self.name, f"answer for {called}", self.client.timeout) from error
        except BootedError as error:
            raise self.restarted() from error
        except SdoCommunicationError as error:
            raise TransferError(f"drive {self.name}: cannot {attempt} {called}: {error}") from error
        except (can.CanError, OSError) as error:
            raise BusError(f"drive {self.name}: cannot {attempt} {called}: {error}") from error


def run_setups(
    bus: can.BusABC,
    clock: Clock,
    remotes: Sequence[Remote],
    doing: str,
    conversations: Sequence[Coroutine[Any, Any, T]],
) -> list[T | DriveError]:
    """Run one conversation with each drive, all concurrently, and log the progress every second.

    The result for a drive that restarts after its conversation, while others are still under way, is a RestartedError.
    """
    over: set[str] = set()

    async def followed(remote: Remote, conversation: Coroutine[Any, Any, T]) -> T:
        try:
            return await conversation
        finally:
            over.add(remote.name)

    def state(remote: Remote) -> str:
        if remote.boots:
            return "booting"
        return f"{remote.client.answered} answers{', done' if remote.name in over else ''}"

    def progress() -> str:
        return f"set-up of the drives, {doing}: " + "; ".join(f"{each.name} {state(each)}" for each in remotes)

    def observe(message: can.Message) -> None:
        for remote in remotes:
            remote.client.observe(message)

    pairs = zip(remotes, conversations, strict=True)
    try:
        ends = run_concurrently(bus, clock, [followed(*pair) for pair in pairs], progress, observe)
    finally:
        for conversation in conversations:
            conversation.close()
    return [
        each.restarted() if each.client.has_booted and not isinstance(end, DriveError) else end
        for each, end in zip(remotes, ends, strict=True)
    ]


def reason(code: int) -> str:
    """Return the meaning of an SDO abort code."""
    return f"{SdoAbortedError.CODES.get(code, 'unknown reason')} (SDO abort {code:08X})"


def is_pdo(index: int) -> bool:
    """Whether an object is a communication or mapping parameter of a PDO."""
    return 0x1400 <= index < 0x1C00


def shown(index: int, subindex: int, value: int) -> str:  # noqa: ARG001
    """Return a value for people, with bit fields in hexadecimal as in the standards."""
    if is_pdo(index) or index in _BIT_FIELDS:
        return f"{value & 0xFFFF_FFFF:08X}h"
    return str(value)


def same(index: int, subindex: int, one: int, other: int) -> bool:
    """Whether two values of an object are equivalent for this service."""
    relevant = -1
    if is_pdo(index) and not index & 0x200 and subindex == 1:
        relevant = ~NO_REMOTE_REQUEST  # whether remote requests are answered
    elif index == 0x1005:
        relevant = _SYNC_BITS
    return not (one ^ other) & relevant
