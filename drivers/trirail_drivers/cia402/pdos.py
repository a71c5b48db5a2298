"""Maps a CiA 402 drive's PDOs, or uses those that cannot be changed and fit (CiA 301, 1400h to 1BFFh)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import title
from trirail_drivers.cia402.process_data import (
    ACTUAL_POSITION,
    CONTROLWORD,
    CYCLIC_SYNCHRONOUS_POSITION,
    POSITIONS,
    STATUSWORD,
    VELOCITY_OFFSET,
    FeedbackPdo,
    SetpointPdo,
    fits_feedback,
    fits_setpoints,
)
from trirail_drivers.cia402.sdo import INVALID, NO_REMOTE_REQUEST, SdoRefused
from trirail_drivers.errors import DriveError

RPDO: Final = 0x1400
TPDO: Final = 0x1800
MOST: Final = 512
"""PDOs of one direction that CiA 301 has room for."""
_GAP: Final = 4
"""After so many in a row that a drive lacks it has no more, but for those in its EDS."""
_IDENTIFIER: Final = 0x7FF
EVERY_SYNC: Final = 1
ON_CHANGE: Final = 255
"""Transmission types."""


class PdoParameters(NamedTuple):
    """A PDO as a drive has it."""

    at: int
    """Index of its communication parameters."""
    cob_id: int | None
    kind: int | None
    """Transmission type."""
    entries: tuple[int, ...] | None
    """Its mapping, without empty entries; None where the drive does not tell."""
    number: int | None
    """How many entries it has, empty ones among them."""

    def maps(self, entries: tuple[int, ...]) -> bool:
        """Whether its mapping is this."""
        return self.entries == entries and self.number == len(entries)

    @property
    def valid(self) -> bool:
        """Whether it is in use."""
        return self.cob_id is not None and not self.cob_id & INVALID

    @property
    def identifier(self) -> int:
        """Of its frames."""
        return (self.cob_id or 0) & _IDENTIFIER


class _Wanted(NamedTuple):
    """What a PDO is to become."""

    cob_id: int
    kind: int
    entries: tuple[int, ...]
    timer: tuple[int, int] | None
    """Subindex and value of its event timer, where that is to change."""
    inhibit: tuple[int, int] | None
    """Likewise, of its inhibit time."""


class Pdos:
    """The PDOs of one drive."""

    def __init__(self, drive: Differences, node: int) -> None:
        self._drive = drive
        self._remote = drive.remote
        self._node = node
        self._used: set[int] = set()

    async def setpoints(self, mode: int) -> tuple[SetpointPdo, int | None]:
        """The RPDO of the setpoints, at every SYNC, and the identifier of the controlword's, at once.

        DriveError names what the drive lacks where neither can be mapped and nothing fixed fits.
        """
        position = POSITIONS[mode]
        wanted: list[tuple[int, ...]] = [(position,)]
        if mode == CYCLIC_SYNCHRONOUS_POSITION and await self._mappable(VELOCITY_OFFSET):
            wanted.insert(0, (position, VELOCITY_OFFSET))
        control = await self._map(RPDO, canopen_frames.RPDO1 + self._node, ON_CHANGE, (CONTROLWORD,))
        for entries in wanted:
            if (
                identifier := await self._map(RPDO + 1, canopen_frames.RPDO2 + self._node, EVERY_SYNC, entries)
            ) is not None:
                found = SetpointPdo(identifier, entries)
                break
        else:
            found = await self._fixed_setpoints(mode)
        if control is None and not found.has_controlword:
            pdo = await self._fixed(RPDO, lambda entries: entries == (CONTROLWORD,), "controlword 6040", ON_CHANGE)
            control = pdo.identifier
        if mode == CYCLIC_SYNCHRONOUS_POSITION and not found.has_velocity:
            self._drive.lack((0x60B1, 0), "it cannot be mapped into the setpoint's PDO")
        return found, control

    async def feedback(self) -> tuple[FeedbackPdo, int | None, bool]:
        """The TPDO of the position, at every SYNC; the identifier of the statusword's, or None; and whether to poll."""
        timed = await self._remote.has(TPDO, 5) and await self._can_be_prompt(TPDO)
        wanted = [(ACTUAL_POSITION,)] if timed else [(ACTUAL_POSITION, STATUSWORD), (ACTUAL_POSITION,)]
        for entries in wanted:
            identifier = await self._map(TPDO + 1, canopen_frames.TPDO2 + self._node, EVERY_SYNC, entries)
            if identifier is not None:
                found = FeedbackPdo(identifier, entries)
                break
        else:
            pdo = await self._fixed(TPDO, fits_feedback, "actual position 6064", EVERY_SYNC)
            found = FeedbackPdo(pdo.identifier, pdo.entries or ())
        if found.has_status:
            if not timed:
                self._drive.add_note(
                    f"{title((0x1800, 5))}: it has none to count on; its statusword comes with the position"
                )
            return found, None, False
        status = await self._status()
        polled = status is None or not await self._timer()
        if polled:
            self._drive.add_note(f"its statusword is also asked for by SDO, every {canopen_frames.POLL_PERIOD:g} s")
        return found, status, polled

    async def switch_off_others(self) -> None:
        """Every PDO that is not used takes a share of the bus that nobody counted, or would hear a stranger."""
        for base in (RPDO, TPDO):
            for index in await self._all(base):
                pdo = await self._pdo(index)
                if index in self._used or not pdo.valid or pdo.cob_id is None:
                    continue
                try:
                    await self._remote.write(index, 1, pdo.cob_id | INVALID)
                except SdoRefused:
                    self._drive.add_note(f"PDO {index:04X} cannot be switched off, so it stays on, unused")
                else:
                    self._drive.note((index, 1), pdo.cob_id, pdo.cob_id | INVALID, "a PDO that is not used")

    # ------------------------------------------------------------------ mapping

    async def _map(self, index: int, identifier: int, kind: int, entries: tuple[int, ...]) -> int | None:
        """Map a PDO in the order that CiA 301 wants; return its identifier, None where the drive does not let it."""
        if not await self._remote.has(index, 1) or not await self._remote.has(index + 0x200):
            return None
        found = await self._pdo(index)
        sending = index >= TPDO
        cob_id = identifier | (NO_REMOTE_REQUEST if sending else 0)
        timer = await self._event_timer(index, kind)
        inhibit = await self._parameter(index, 3, 0) if sending else None
        alike = found.valid and found.identifier == identifier and found.kind == kind and found.maps(entries)
        if alike and not (timer or inhibit):
            self._used.add(index)
            return identifier
        for entry in entries:
            if not await self._travels(entry, sending):
                return None
        noted = len(self._drive.found)
        wanted = _Wanted(cob_id, kind, entries, timer, inhibit)
        await self._note(found, wanted)
        kept = await self._try_to_map(found, wanted)
        if kept is None:
            del self._drive.found[noted:]
        else:
            self._used.add(index)
        return kept

    async def _travels(self, entry: int, sending: bool) -> bool:
        """Whether the drive has an object that PDOs of one direction may carry, and of that length (CiA 301, 1600h)."""
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        remote = self._remote
        if not remote.asks:
            return True  # it says so itself when it is mapped
        if not await remote.has(index, subindex) or await remote.bits(index, subindex) != bits:
            return False
        if sending:
            return await remote.peek(index, subindex) is not None
        return await remote.may_be_written(index, subindex)

    async def _try_to_map(self, found: PdoParameters, wanted: _Wanted) -> int | None:
        cob_id, kind, entries, timer, inhibit = wanted
        index, write, becomes = found.at, self._remote.write, self._remote.becomes
        fixed = False
        try:
            # CiA 301: the identifier changes only while the PDO is invalid; first it is made so under its old one.
            await write(index, 1, (found.cob_id if found.valid and found.cob_id is not None else cob_id) | INVALID)
            await becomes((index, 1), lambda held: bool(held & INVALID))
        except SdoRefused:
            if not found.valid:
                return None
            fixed, cob_id = True, found.cob_id or 0
        try:
            if found.kind != kind:
                await write(index, 2, kind)
                await self._drive.confirm((index, 2), kind)
            if inhibit is not None:
                await write(index, *inhibit)
                await self._drive.confirm((index, inhibit[0]), inhibit[1])
            if timer is not None:
                await self._set_timer(index, *timer)
            if not found.maps(entries):
                await write(index + 0x200, 0, 0)
                await becomes((index + 0x200, 0), lambda held: held == 0)
                for position, entry in enumerate(entries, start=1):
                    await write(index + 0x200, position, entry)
                    await self._drive.confirm((index + 0x200, position), entry)
                await write(index + 0x200, 0, len(entries))
                await self._drive.confirm((index + 0x200, 0), len(entries))
        except SdoRefused as refusal:
            self._drive.add_note(f"PDO {index:04X} cannot be mapped as wanted: {str(refusal).partition(': ')[2]}")
            if not fixed and found.valid and found.cob_id is not None:
                await write(index, 1, found.cob_id)
            return None
        if not fixed:
            await write(index, 1, cob_id)
            await self._drive.confirm((index, 1), cob_id)
        return cob_id & _IDENTIFIER

    async def _set_timer(self, index: int, subindex: int, value: int) -> None:
        """Set the event timer; a statusword that it does not repeat is asked for as well, in place of no PDO at all."""
        try:
            await self._remote.write(index, subindex, value)
        except SdoRefused as refusal:
            if index < TPDO:
                raise
            named = f"{index:04X}:{subindex:02X}"
            self._drive.found = [each for each in self._drive.found if each.object != named]
            self._drive.lack((index, subindex), "it cannot be set", refusal)
            return
        await self._drive.confirm((index, subindex), value)

    async def _event_timer(self, index: int, kind: int) -> tuple[int, int] | None:
        """What repeats a statusword; of an RPDO it is a deadline, and controlwords come on change (CiA 301, 1400h)."""
        if index < TPDO:
            return await self._parameter(index, 5, 0)
        return (
            await self._parameter(index, 5, round(1000 * canopen_frames.STATUS_PERIOD)) if kind == ON_CHANGE else None
        )

    async def _parameter(self, index: int, subindex: int, value: int) -> tuple[int, int] | None:
        """A communication parameter that the drive has and that is to change."""
        if not await self._remote.has(index, subindex) or await self._remote.peek(index, subindex) == value:
            return None
        return subindex, value

    async def _note(self, found: PdoParameters, wanted: _Wanted) -> None:
        cob_id, kind, entries, timer, inhibit = wanted
        note, look = self._drive.note, self._remote.peek
        if not found.valid or found.identifier != cob_id & _IDENTIFIER:
            note((found.at, 1), found.cob_id, cob_id, "the PDO's identifier")
        if found.kind != kind:
            note((found.at, 2), found.kind, kind, "at every SYNC" if kind == EVERY_SYNC else "at once")
        for parameter in (inhibit, timer):
            if parameter is not None:
                note((found.at, parameter[0]), await look(found.at, parameter[0]), parameter[1])
        if not found.maps(entries):
            had = found.entries or ()
            for position, entry in enumerate(entries, start=1):
                now = had[position - 1] if position <= len(had) else None
                if now != entry:
                    note((found.at + 0x200, position), now, entry, "the PDO's mapping")
            if found.number != len(entries):
                note((found.at + 0x200, 0), found.number, len(entries), "the PDO's mapping")

    # ------------------------------------------------------------------ PDOs that cannot be changed

    async def _fixed_setpoints(self, mode: int) -> SetpointPdo:
        name = f"setpoints {POSITIONS[mode] >> 16:04X}"
        pdo = await self._fixed(RPDO, lambda entries: fits_setpoints(entries, mode), name, EVERY_SYNC)
        return SetpointPdo(pdo.identifier, pdo.entries or ())

    async def _fixed(self, base: int, fits: Callable[[tuple[int, ...]], bool], name: str, kind: int) -> PdoParameters:
        """A PDO as it is that will do; DriveError where there is none."""
        seen = []
        for index in await self._all(base):
            pdo = await self._pdo(index)
            if index not in self._used and pdo.valid and pdo.entries:
                if fits(pdo.entries) and await self._has_kind(pdo, kind):
                    self._used.add(index)
                    self._drive.add_note(f"PDO {index:04X} is used as it is mapped, for {name}")
                    return pdo
                but = ""
                if fits(pdo.entries):
                    but = f", which fits, but its transmission type {index:04X}:02 stays {pdo.kind}; wanted {kind}"
                seen.append(f"{index + 0x200:04X} = {', '.join(f'{entry:08X}h' for entry in pdo.entries)}{but}")
        mapped = f": it has {'; '.join(seen)}" if seen else ""
        mapping = base + 0x201
        raise DriveError(
            f"drive {self._remote.name}: object {mapping:04X} cannot be mapped, and no PDO fits {name}{mapped}"
        )

    async def _has_kind(self, pdo: PdoParameters, kind: int) -> bool:
        if pdo.kind == kind or (kind == ON_CHANGE and (pdo.kind or 0) >= ON_CHANGE - 1):
            return True
        try:
            return await self._drive.give(pdo.at, 2, kind) == kind
        except DriveError:
            return False

    # ------------------------------------------------------------------ the statusword

    async def _status(self) -> int | None:
        identifier = await self._map(TPDO, canopen_frames.TPDO1 + self._node, ON_CHANGE, (STATUSWORD,))
        if identifier is not None:
            return identifier
        for index in await self._all(TPDO):
            pdo = await self._pdo(index)
            if (
                index not in self._used
                and pdo.valid
                and pdo.entries == (STATUSWORD,)
                and await self._has_kind(pdo, ON_CHANGE)
            ):
                self._used.add(index)
                return pdo.identifier
        return None

    async def _timer(self) -> bool:
        """Whether the drive repeats its statusword by itself."""
        return await self._remote.peek(TPDO, 5) == round(1000 * canopen_frames.STATUS_PERIOD)

    async def _can_be_prompt(self, index: int) -> bool:
        """Whether the inhibit time is 0, or can be set to it: else a statusword may come late."""
        if not await self._remote.has(index, 3) or await self._remote.peek(index, 3) == 0:
            return True
        cob_id = await self._remote.peek(index, 1) or 0
        try:
            await self._remote.write(index, 1, cob_id | INVALID)
            await self._remote.becomes((index, 1), lambda held: bool(held & INVALID))
            await self._remote.write(index, 3, 0)
        except SdoRefused:
            self._drive.lack((index, 3), "it cannot be set to 0")
            return False
        return (await self._remote.becomes((index, 3), lambda held: held == 0))[0] == 0

    # ------------------------------------------------------------------ reading

    async def _mappable(self, entry: int) -> bool:
        """Whether the drive has an object, and its EDS, where it has one, lets it be mapped."""
        variable = self._remote.client.od.get_variable(entry >> 16, entry >> 8 & 0xFF)
        there = await self._remote.has(entry >> 16, entry >> 8 & 0xFF)
        return there and (variable is None or bool(variable.pdo_mappable))

    async def _all(self, base: int) -> list[int]:
        named = {index for index in self._remote.client.od if base <= index < base + MOST}
        index, missed = base, 0
        while missed < _GAP and index < base + MOST:
            if await self._remote.has(index, 1):
                named.add(index)
                missed = 0
            else:
                missed += 1
            index += 1
        return [index for index in sorted(named) if await self._remote.has(index, 1)]

    async def _pdo(self, index: int) -> PdoParameters:
        look = self._remote.peek
        number = await look(index + 0x200)
        entries = None if number is None else [await look(index + 0x200, n + 1) for n in range(min(number, 64))]
        # Some have a number of entries that are all empty.
        told = None if entries is None else tuple(entry & 0xFFFF_FFFF for entry in entries if entry)
        return PdoParameters(index, await look(index, 1), await look(index, 2), told, number)
