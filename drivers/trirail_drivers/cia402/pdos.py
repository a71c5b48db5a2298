"""Maps a CiA 402 drive's PDOs, or uses those that cannot be changed and fit (CiA 301, 1400h to 1BFFh)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from trirail_drivers.cia402 import frames
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import title
from trirail_drivers.cia402.sdo import INVALID, NO_REMOTE_REQUEST, SdoRefused
from trirail_drivers.cia402.ways import (
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


class Pdos:
    """The PDOs of one drive."""

    def __init__(self, drive: Differences, node: int) -> None:
        self._drive = drive
        self._remote = drive.remote
        self._node = node
        self._used: set[int] = set()

    def setpoints(self, mode: int) -> tuple[SetpointPdo, int | None]:
        """The RPDO of the setpoints, at every SYNC, and the identifier of the controlword's, at once.

        DriveError names what the drive lacks where neither can be mapped and nothing fixed fits.
        """
        position = POSITIONS[mode]
        wanted: list[tuple[int, ...]] = [(position,)]
        if mode == CYCLIC_SYNCHRONOUS_POSITION and self._mappable(VELOCITY_OFFSET):
            wanted.insert(0, (position, VELOCITY_OFFSET))
        control = self._map(RPDO, frames.RPDO1 + self._node, ON_CHANGE, (CONTROLWORD,))
        for entries in wanted:
            if (identifier := self._map(RPDO + 1, frames.RPDO2 + self._node, EVERY_SYNC, entries)) is not None:
                found = SetpointPdo(identifier, entries)
                break
        else:
            found = self._fixed_setpoints(mode)
        if control is None and not found.has_controlword:
            control = self._fixed(
                RPDO, lambda entries: entries == (CONTROLWORD,), "controlword 6040", ON_CHANGE
            ).identifier
        if mode == CYCLIC_SYNCHRONOUS_POSITION and not found.has_velocity:
            self._drive.lack((0x60B1, 0), "it cannot be mapped into the setpoint's PDO")
        return found, control

    def feedback(self) -> tuple[FeedbackPdo, int | None, bool]:
        """The TPDO of the position, at every SYNC; the identifier of the statusword's, or None; and whether to poll."""
        timed = self._remote.has(TPDO, 5) and self._can_be_prompt(TPDO)
        wanted = [(ACTUAL_POSITION,)] if timed else [(ACTUAL_POSITION, STATUSWORD), (ACTUAL_POSITION,)]
        for entries in wanted:
            identifier = self._map(TPDO + 1, frames.TPDO2 + self._node, EVERY_SYNC, entries)
            if identifier is not None:
                found = FeedbackPdo(identifier, entries)
                break
        else:
            pdo = self._fixed(TPDO, fits_feedback, "actual position 6064", EVERY_SYNC)
            found = FeedbackPdo(pdo.identifier, pdo.entries or ())
        if found.has_status:
            if not timed:
                self._drive.tell(
                    f"{title((0x1800, 5))}: it has none to count on; its statusword comes with the position"
                )
            return found, None, False
        status = self._status()
        polled = status is None or not self._timer()
        if polled:
            self._drive.tell(f"its statusword is also asked for by SDO, every {frames.POLL_PERIOD:g} s")
        return found, status, polled

    def switch_off_others(self) -> None:
        """Every PDO that is not used takes a share of the bus that nobody counted, or would hear a stranger."""
        for base in (RPDO, TPDO):
            for index in self._all(base):
                pdo = self._pdo(index)
                if index in self._used or not pdo.valid or pdo.cob_id is None:
                    continue
                try:
                    self._remote.write(index, 1, pdo.cob_id | INVALID)
                except SdoRefused:
                    self._drive.tell(f"PDO {index:04X} cannot be switched off, so it stays on, unused")
                else:
                    self._drive.note((index, 1), pdo.cob_id, pdo.cob_id | INVALID, "a PDO that is not used")

    # ------------------------------------------------------------------ mapping

    def _map(self, index: int, identifier: int, kind: int, entries: tuple[int, ...]) -> int | None:
        """Map a PDO in the order that CiA 301 wants; return its identifier, None where the drive does not let it."""
        if not self._remote.has(index, 1) or not self._remote.has(index + 0x200):
            return None
        found = self._pdo(index)
        sending = index >= TPDO
        cob_id = identifier | (NO_REMOTE_REQUEST if sending else 0)
        timer = self._event_timer(index, kind)
        inhibit = self._parameter(index, 3, 0) if sending else None
        alike = found.valid and found.identifier == identifier and found.kind == kind and found.maps(entries)
        if alike and not (timer or inhibit):
            self._used.add(index)
            return identifier
        if not all(self._travels(entry, sending) for entry in entries):
            return None
        noted = len(self._drive.found)
        self._note(found, cob_id, kind, entries, timer, inhibit)
        kept = self._try_to_map(found, cob_id, kind, entries, timer, inhibit)
        if kept is None:
            del self._drive.found[noted:]
        else:
            self._used.add(index)
        return kept

    def _travels(self, entry: int, sending: bool) -> bool:
        """Whether the drive has an object that PDOs of one direction may carry, and of that length (CiA 301, 1600h)."""
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        remote = self._remote
        if not remote.asks:
            return True  # it says so itself when it is mapped
        if not remote.has(index, subindex) or remote.bits(index, subindex) != bits:
            return False
        return remote.look(index, subindex) is not None if sending else remote.may_be_written(index, subindex)

    def _try_to_map(
        self,
        found: PdoParameters,
        cob_id: int,
        kind: int,
        entries: tuple[int, ...],
        timer: tuple[int, int] | None,
        inhibit: tuple[int, int] | None,
    ) -> int | None:
        index, write = found.at, self._remote.write
        fixed = False
        try:
            # CiA 301: the identifier changes only while the PDO is invalid; first it is made so under its old one.
            write(index, 1, (found.cob_id if found.valid and found.cob_id is not None else cob_id) | INVALID)
        except SdoRefused:
            if not found.valid:
                return None
            fixed, cob_id = True, found.cob_id or 0
        try:
            if found.kind != kind:
                write(index, 2, kind)
                self._drive.confirm((index, 2), kind)
            for parameter in (inhibit, timer):
                if parameter is not None:
                    write(index, *parameter)
                    self._drive.confirm((index, parameter[0]), parameter[1])
            if not found.maps(entries):
                write(index + 0x200, 0, 0)
                for position, entry in enumerate(entries, start=1):
                    write(index + 0x200, position, entry)
                    self._drive.confirm((index + 0x200, position), entry)
                write(index + 0x200, 0, len(entries))
                self._drive.confirm((index + 0x200, 0), len(entries))
        except SdoRefused as refusal:
            self._drive.tell(f"PDO {index:04X} cannot be mapped as wanted: {str(refusal).partition(': ')[2]}")
            if not fixed and found.valid and found.cob_id is not None:
                write(index, 1, found.cob_id)
            return None
        if not fixed:
            write(index, 1, cob_id)
            self._drive.confirm((index, 1), cob_id)
        return cob_id & _IDENTIFIER

    def _event_timer(self, index: int, kind: int) -> tuple[int, int] | None:
        """What repeats a statusword; of an RPDO it is a deadline, and controlwords come on change (CiA 301, 1400h)."""
        if index < TPDO:
            return self._parameter(index, 5, 0)
        return self._parameter(index, 5, round(1000 * frames.STATUS_PERIOD)) if kind == ON_CHANGE else None

    def _parameter(self, index: int, subindex: int, value: int) -> tuple[int, int] | None:
        """A communication parameter that the drive has and that is to change."""
        if not self._remote.has(index, subindex) or self._remote.look(index, subindex) == value:
            return None
        return subindex, value

    def _note(
        self,
        found: PdoParameters,
        cob_id: int,
        kind: int,
        entries: tuple[int, ...],
        timer: tuple[int, int] | None,
        inhibit: tuple[int, int] | None,
    ) -> None:
        note, look = self._drive.note, self._remote.look
        if not found.valid or found.identifier != cob_id & _IDENTIFIER:
            note((found.at, 1), found.cob_id, cob_id, "the PDO's identifier")
        if found.kind != kind:
            note((found.at, 2), found.kind, kind, "at every SYNC" if kind == EVERY_SYNC else "at once")
        for parameter in (inhibit, timer):
            if parameter is not None:
                note((found.at, parameter[0]), look(found.at, parameter[0]), parameter[1])
        if not found.maps(entries):
            had = found.entries or ()
            for position, entry in enumerate(entries, start=1):
                now = had[position - 1] if position <= len(had) else None
                if now != entry:
                    note((found.at + 0x200, position), now, entry, "the PDO's mapping")
            if found.number != len(entries):
                note((found.at + 0x200, 0), found.number, len(entries), "the PDO's mapping")

    # ------------------------------------------------------------------ PDOs that cannot be changed

    def _fixed_setpoints(self, mode: int) -> SetpointPdo:
        name = f"setpoints {POSITIONS[mode] >> 16:04X}"
        pdo = self._fixed(RPDO, lambda entries: fits_setpoints(entries, mode), name, EVERY_SYNC)
        return SetpointPdo(pdo.identifier, pdo.entries or ())

    def _fixed(self, base: int, fits: Callable[[tuple[int, ...]], bool], name: str, kind: int) -> PdoParameters:
        """A PDO as it is that will do; DriveError where there is none."""
        seen = []
        for index in self._all(base):
            pdo = self._pdo(index)
            if index not in self._used and pdo.valid and pdo.entries:
                if fits(pdo.entries) and self._has_kind(pdo, kind):
                    self._used.add(index)
                    self._drive.tell(f"PDO {index:04X} is used as it is mapped, for {name}")
                    return pdo
                seen.append(f"{index + 0x200:04X} = {', '.join(f'{entry:08X}h' for entry in pdo.entries)}")
        mapped = f": it has {'; '.join(seen)}" if seen else ""
        mapping = base + 0x201
        raise DriveError(
            f"drive {self._remote.name}: object {mapping:04X} cannot be mapped, and no PDO fits {name}{mapped}"
        )

    def _has_kind(self, pdo: PdoParameters, kind: int) -> bool:
        if pdo.kind == kind or (kind == ON_CHANGE and (pdo.kind or 0) >= ON_CHANGE - 1):
            return True
        try:
            return self._drive.give(pdo.at, 2, kind) == kind
        except DriveError:
            return False

    # ------------------------------------------------------------------ the statusword

    def _status(self) -> int | None:
        identifier = self._map(TPDO, frames.TPDO1 + self._node, ON_CHANGE, (STATUSWORD,))
        if identifier is not None:
            return identifier
        for index in self._all(TPDO):
            pdo = self._pdo(index)
            if (
                index not in self._used
                and pdo.valid
                and pdo.entries == (STATUSWORD,)
                and self._has_kind(pdo, ON_CHANGE)
            ):
                self._used.add(index)
                return pdo.identifier
        return None

    def _timer(self) -> bool:
        """Whether the drive repeats its statusword by itself."""
        return self._remote.look(TPDO, 5) == round(1000 * frames.STATUS_PERIOD)

    def _can_be_prompt(self, index: int) -> bool:
        """Whether the inhibit time is 0, or can be set to it: else a statusword may come late."""
        if not self._remote.has(index, 3) or self._remote.look(index, 3) == 0:
            return True
        cob_id = self._remote.look(index, 1) or 0
        try:
            self._remote.write(index, 1, cob_id | INVALID)
            self._remote.write(index, 3, 0)
        except SdoRefused:
            self._drive.lack((index, 3), "it cannot be set to 0")
            return False
        return self._remote.look(index, 3) == 0

    # ------------------------------------------------------------------ reading

    def _mappable(self, entry: int) -> bool:
        """Whether the drive has an object, and its EDS, where it has one, lets it be mapped."""
        variable = self._remote.client.od.get_variable(entry >> 16, entry >> 8 & 0xFF)
        return self._remote.has(entry >> 16, entry >> 8 & 0xFF) and (variable is None or bool(variable.pdo_mappable))

    def _all(self, base: int) -> list[int]:
        named = {index for index in self._remote.client.od if base <= index < base + MOST}
        index, missed = base, 0
        while missed < _GAP and index < base + MOST:
            if self._remote.has(index, 1):
                named.add(index)
                missed = 0
            else:
                missed += 1
            index += 1
        return sorted(index for index in named if self._remote.has(index, 1))

    def _pdo(self, index: int) -> PdoParameters:
        look = self._remote.look
        number = look(index + 0x200)
        entries = None if number is None else [look(index + 0x200, n + 1) for n in range(min(number, 64))]
        # Some have a number of entries that are all empty.
        told = None if entries is None else tuple(entry & 0xFFFF_FFFF for entry in entries if entry)
        return PdoParameters(index, look(index, 1), look(index, 2), told, number)
