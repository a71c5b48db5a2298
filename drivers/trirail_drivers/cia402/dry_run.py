"""Dry run of a drive's set-up, to find out which values would result and whether the drive would accept them."""

from __future__ import annotations

from collections.abc import Callable

from trirail_drivers.cia402.objects import MODE, MODE_DISPLAY, Key
from trirail_drivers.cia402.sdo import Remote, shown


class DryRun(Remote):
    """Object dictionary of a drive to which nothing is written. Values are read back as if they had been written.

    With `read_only`, the power of the drive is not changed either, and the drive is asked whether an object may be
    written. Whether the drive accepts a certain value cannot be known without writing it.
    """

    rehearsed = True

    def __init__(self, remote: Remote, *, read_only: bool) -> None:
        super().__init__(remote.name, remote.client)
        self.read_only = read_only
        self._read, self._missing, self._writable = remote._read, remote._missing, remote._writable
        self._written: dict[Key, bytes] = {}

    async def peek(self, index: int, subindex: int = 0) -> int | None:
        """Return the value that an object would have; None if it cannot be read."""
        value = await super().peek(index, subindex)
        return value if value is None else self._would_be((index, subindex), value)

    async def read(self, index: int, subindex: int = 0) -> int:
        """Return the value that an object would have. Raises SdoRefused if it cannot be read."""
        return self._would_be((index, subindex), await super().read(index, subindex))

    async def write(self, index: int, subindex: int, value: int) -> None:
        """Store a value as if it were written.

        Raises SdoRefused if the drive reports that the object may not be written.
        """
        key = index, subindex
        data = await self._encoded(key, value)
        if self.read_only:
            await self._try_to_write(f"write {shown(index, subindex, value)} to", key, len(data))
        self._written[key] = data
        if key == MODE and await self.bits(*MODE_DISPLAY) == await self.bits(*MODE):
            self._written[MODE_DISPLAY] = data

    async def wait_until(
        self,
        key: Key,
        predicate: Callable[[int], bool],  # noqa: ARG002  nothing is written, so there is nothing to wait for
        seconds: float | None = None,  # noqa: ARG002
    ) -> tuple[int | None, float]:
        """Return the value that an object would have, without waiting."""
        return await self.peek(*key), 0.0

    def _would_be(self, key: Key, value: int) -> int:
        data = self._written.get(key)
        return value if data is None else int.from_bytes(data, "little", signed=self._signed(key))
