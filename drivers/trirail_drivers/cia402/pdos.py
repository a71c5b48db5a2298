"""Mapping of a CiA 402 drive's PDOs, or selection of suitable PDOs with a fixed mapping (CiA 301, 1400h to 1BFFh)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Final, NamedTuple

from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, title
from trirail_drivers.cia402.process_data import (
    ACTUAL_POSITION,
    CONTROLWORD,
    CYCLIC_SYNCHRONOUS_POSITION,
    DIGITAL_INPUTS,
    DIGITAL_OUTPUTS,
    POSITIONS,
    STATUSWORD,
    VELOCITY_OFFSET,
    FeedbackPdo,
    SetpointPdo,
    fits_feedback,
    fits_setpoints,
)
from trirail_drivers.cia402.sdo import INVALID, NO_REMOTE_REQUEST, Remote, SdoRefused
from trirail_drivers.errors import DriveError

RPDO: Final = 0x1400
TPDO: Final = 0x1800
MAX_PDOS: Final = 512
"""Maximum number of PDOs in one direction (CiA 301)."""
_MAX_GAP: Final = 4
"""Number of consecutive missing PDOs after which the search ends; after that, only PDOs of the EDS are considered."""
_IDENTIFIER: Final = 0x7FF
EVERY_SYNC: Final = 1
ON_CHANGE: Final = 255
"""Transmission types."""
INHIBIT_UNIT_S: Final = 1e-4
"""Unit of a PDO's inhibit time (CiA 301, 1800h:03) [s]."""
_OFFSETS: Final = {0x60B0: "position", 0x60B1: "velocity", 0x60B2: "torque"}
"""Offsets that a drive adds to the setpoints of mode 8 (CiA 402-2)."""


class PdoParameters(NamedTuple):
    """Parameters of a PDO in a drive."""

    at: int
    """Index of the PDO's communication parameters."""
    cob_id: int | None
    kind: int | None
    """Transmission type."""
    entries: tuple[int, ...] | None
    """Mapping without empty entries; None if the drive does not report it."""
    number: int | None
    """Number of mapped entries, including empty ones."""

    def maps(self, entries: tuple[int, ...]) -> bool:
        """Whether the PDO has exactly this mapping."""
        return self.entries == entries and self.number == len(entries)

    @property
    def valid(self) -> bool:
        """Whether the PDO is in use."""
        return self.cob_id is not None and not self.cob_id & INVALID

    @property
    def identifier(self) -> int:
        """CAN identifier of the PDO's frames."""
        return (self.cob_id or 0) & _IDENTIFIER


class _TargetPdo(NamedTuple):
    """Required parameters of a PDO."""

    cob_id: int
    kind: int
    entries: tuple[int, ...]
    timer: tuple[int, int] | None
    """Subindex and value of the event timer, if it must change."""
    inhibit: tuple[int, int] | None
    """Subindex and value of the inhibit time, if it must change."""


class _ReversibleWrites:
    """Written values of one PDO, which can be undone if the drive refuses one of them."""

    def __init__(self, remote: Remote) -> None:
        self._remote = remote
        self._before: list[tuple[Key, int]] = []

    async def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object. Raises SdoRefused."""
        before = await self._remote.peek(index, subindex)
        await self._remote.write(index, subindex, value)
        if before is not None:
            self._before.append(((index, subindex), before))

    async def undo(self) -> None:
        """Write the previous values, the last one first: CiA 301 allows changes only in a certain order."""
        while self._before:
            key, before = self._before.pop()
            with suppress(SdoRefused):
                await self._remote.write(*key, before)


class Pdos:
    """Set-up of the PDOs of one drive."""

    def __init__(self, drive: Differences, node: int) -> None:
        self._drive = drive
        self._remote = drive.remote
        self._node = node
        self._used: set[int] = set()

    async def setpoints(self, mode: int, *, velocity_offset: bool = True) -> tuple[SetpointPdo, int | None]:
        """Set up the SYNC-driven RPDO of the setpoints and the event-driven RPDO of the controlword.

        Return the former, and the identifier of the latter, or None if the setpoints' RPDO contains the controlword.
        Without `velocity_offset`, the setpoints contain a velocity offset only if a fixed mapping does.
        Raises DriveError if an RPDO cannot be mapped and no fixed RPDO fits.
        """
        position = POSITIONS[mode]
        wanted: list[tuple[int, ...]] = [(position,)]
        offset = velocity_offset and mode == CYCLIC_SYNCHRONOUS_POSITION
        if offset and await self._mappable(VELOCITY_OFFSET):
            wanted.insert(0, (position, VELOCITY_OFFSET))
        control = await self._map(RPDO, canopen_frames.RPDO1 + self._node, ON_CHANGE, (CONTROLWORD,))
        for entries in wanted:
            if (
                identifier := await self._map(RPDO + 1, canopen_frames.RPDO2 + self._node, EVERY_SYNC, entries)
            ) is not None:
                chosen = SetpointPdo(identifier, entries)
                break
        else:
            chosen = await self._fixed_setpoints(mode)
        if control is None and not chosen.has_controlword:
            pdo = await self._find_fixed(RPDO, lambda entries: entries == (CONTROLWORD,), "controlword 6040", ON_CHANGE)
            control = pdo.identifier
        if offset and not chosen.has_velocity:
            self._drive.lack((0x60B1, 0), "it cannot be mapped into the setpoint's PDO")
        if chosen.has_velocity and not velocity_offset:
            self._drive.add_note("the fixed mapping of its setpoints contains the velocity offset, which stays in use")
        if mode == CYCLIC_SYNCHRONOUS_POSITION:
            await self._clear_offsets(chosen)
        return chosen, control

    async def _clear_offsets(self, chosen: SetpointPdo) -> None:
        """Set the offsets that the setpoints do not contain to 0: another program may have left values in the drive,
        which the drive would add to every setpoint.
        """
        for index, name in _OFFSETS.items():
            mapped = index == VELOCITY_OFFSET >> 16 and chosen.has_velocity
            if not mapped and (held := await self._remote.peek(index)):
                await self._drive.put((index, 0), held, 0, f"no {name} offset")

    async def outputs(self) -> int | None:
        """Set up the SYNC-driven RPDO of the digital outputs; return its identifier, or None if no RPDO is suitable."""
        entries, number = (DIGITAL_OUTPUTS,), canopen_frames.RPDO3 + self._node
        for index in (RPDO + 2, RPDO + 3, RPDO):
            if (
                index not in self._used
                and (identifier := await self._map(index, number, EVERY_SYNC, entries)) is not None
            ):
                return identifier
        pdo = await self._first_fixed(RPDO, entries, EVERY_SYNC)
        if pdo is None:
            self._drive.add_note("its digital outputs are written by SDO, since no RPDO takes 60FE:01: not on a path")
        return None if pdo is None else pdo.identifier

    async def feedback(self, *, inputs: bool = False) -> tuple[FeedbackPdo, int | None, bool, int | None, bool]:
        """Set up the TPDOs of the position, of the statusword and, if `inputs` is True, of the digital inputs.

        Return five values: the SYNC-driven TPDO of the position; the identifier of the TPDO of the statusword, or None;
        whether the statusword must be polled; the identifier of the TPDO of the digital inputs, which may be that of
        the statusword, or None; and whether the inputs must be polled. Raises DriveError if no TPDO can contain the
        position or the inputs.
        """
        chosen, status, polled, beside = await self._feedback_and_status(inputs=inputs)
        if not inputs:
            return chosen, status, polled, None, False
        identifier, index = (status, TPDO) if beside else await self._inputs()
        return chosen, status, polled, identifier, await self._must_poll_inputs(index)

    async def _must_poll_inputs(self, index: int) -> bool:
        """Whether the digital inputs must be polled, given their TPDO; if they may be late, add a note."""
        polled = not await self._is_repeated(index)
        inhibit, timer = [await self._remote.peek(index, subindex) for subindex in (3, 5)]
        if polled or inhibit:
            late = canopen_frames.POLL_PERIOD if polled else (inhibit or 0) * INHIBIT_UNIT_S
            held = ("missing" if time is None else str(time) for time in (inhibit, timer))
            self._drive.add_note(
                f"its digital inputs may be {1000 * late:g} ms late, so that a goal with stop_at stops later, and "
                f"shorter pulses may be lost{'; they are also requested by SDO' if polled else ''}; their inhibit time "
                f"{index:04X}:03 and event timer {index:04X}:05 are {' and '.join(held)}: set them to 0 and "
                f"{1000 * canopen_frames.STATUS_PERIOD:g} with the manufacturer's tool, or use inputs of another drive"
            )
        return polled

    async def _inputs(self) -> tuple[int, int]:
        """Set up a TPDO with only the digital inputs; return its identifier, and the index of its parameters.

        Raises DriveError if no TPDO fits.
        """
        entries, number = (DIGITAL_INPUTS,), canopen_frames.TPDO3 + self._node
        for index in (TPDO + 2, TPDO + 3, TPDO):
            if (
                index not in self._used
                and (identifier := await self._map(index, number, ON_CHANGE, entries)) is not None
            ):
                return identifier, index
        if (pdo := await self._first_fixed(TPDO, entries, ON_CHANGE)) is not None:
            return pdo.identifier, pdo.at
        raise DriveError(
            f"drive {self._remote.name}: its digital inputs 60FD cannot be mapped into a TPDO; use inputs of another "
            "drive in [inputs]"
        )

    async def _first_fixed(self, base: int, entries: tuple[int, ...], kind: int) -> PdoParameters | None:
        """Return an unused PDO that has exactly the given mapping and transmission type, or None."""
        for index in await self._all(base):
            pdo = await self._pdo(index)
            if index not in self._used and pdo.valid and pdo.entries == entries and await self._has_kind(pdo, kind):
                self._used.add(index)
                return pdo
        return None

    async def _feedback_and_status(self, *, inputs: bool) -> tuple[FeedbackPdo, int | None, bool, bool]:
        """Set up the TPDOs of position and statusword.

        Return the same values as `feedback`, except that the last is whether the statusword's TPDO contains the inputs.
        """
        untimed = ""
        if not await self._remote.has(TPDO, 5):
            untimed = f"{title((0x1800, 5))}: it has none that can be used"
        elif not await self._can_be_prompt(TPDO):
            untimed = f"{title((0x1800, 3))}: it stays {await self._remote.peek(TPDO, 3)}"
        wanted = [(ACTUAL_POSITION, STATUSWORD), (ACTUAL_POSITION,)] if untimed else [(ACTUAL_POSITION,)]
        for entries in wanted:
            identifier = await self._map(TPDO + 1, canopen_frames.TPDO2 + self._node, EVERY_SYNC, entries)
            if identifier is not None:
                chosen = FeedbackPdo(identifier, entries)
                break
        else:
            pdo = await self._find_fixed(TPDO, fits_feedback, "actual position 6064", EVERY_SYNC)
            chosen = FeedbackPdo(pdo.identifier, pdo.entries or ())
        if chosen.has_status:
            if untimed:
                self._drive.add_note(f"{untimed}; its statusword comes with the position")
            return chosen, None, False, False
        status, polled, beside = await self._status(inputs=inputs)
        if polled:
            self._drive.add_note(f"its statusword is also requested by SDO, every {canopen_frames.POLL_PERIOD:g} s")
        return chosen, status, polled, beside

    async def switch_off_others(self) -> tuple[frozenset[int], frozenset[int]]:
        """Switch off unused PDOs, since they would add bus load or let other senders command the drive.

        Return the identifiers of the RPDOs and of the TPDOs that stay on.
        """
        stay_on: dict[int, set[int]] = {RPDO: set(), TPDO: set()}
        for base, identifiers in stay_on.items():
            for index in await self._all(base):
                pdo = await self._pdo(index)
                if index in self._used or not pdo.valid or pdo.cob_id is None:
                    continue
                if await self._can_be_switched_off(pdo):
                    self._drive.note((index, 1), pdo.cob_id, pdo.cob_id | INVALID, "a PDO that is not used")
                else:
                    self._drive.add_note(f"PDO {index:04X} cannot be switched off, so it stays on, unused")
                    identifiers.add(pdo.identifier)
        return frozenset(stay_on[RPDO]), frozenset(stay_on[TPDO])

    async def _can_be_switched_off(self, pdo: PdoParameters) -> bool:
        """Switch off a PDO; return whether it is off."""
        try:
            await self._remote.write(pdo.at, 1, (pdo.cob_id or 0) | INVALID)
        except SdoRefused:
            return False
        held, _ = await self._remote.wait_until((pdo.at, 1), lambda held: bool(held & INVALID))
        return held is None or bool(held & INVALID)

    # ------------------------------------------------------------------ mapping

    async def _map(self, index: int, identifier: int, kind: int, entries: tuple[int, ...]) -> int | None:
        """Map a PDO in the order that CiA 301 prescribes; return its identifier, or None if the drive refuses."""
        if not await self._remote.has(index, 1) or not await self._remote.has(index + 0x200):
            return None
        current = await self._pdo(index)
        sending = index >= TPDO
        cob_id = identifier | (NO_REMOTE_REQUEST if sending else 0)
        timer = await self._event_timer(index, kind)
        inhibit = await self._parameter(index, 3, 0) if sending else None
        alike = current.valid and current.identifier == identifier and current.kind == kind and current.maps(entries)
        if alike and not (timer or inhibit):
            self._used.add(index)
            return identifier
        for entry in entries:
            if not await self._is_mappable(entry, sending):
                return None
        noted = len(self._drive.changes)
        wanted = _TargetPdo(cob_id, kind, entries, timer, inhibit)
        await self._note(current, wanted)
        kept = await self._try_to_map(current, wanted)
        if kept is None:
            del self._drive.changes[noted:]
        else:
            self._used.add(index)
        return kept

    async def _is_mappable(self, entry: int, sending: bool) -> bool:
        """Whether PDOs in this direction can contain the object of a mapping entry (CiA 301, 1600h).

        It is checked only if nothing may be written: otherwise the mapping itself shows the result.
        """
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        remote = self._remote
        if not remote.read_only:
            return True
        if not await remote.has(index, subindex) or await remote.bits(index, subindex) != bits:
            return False
        if sending:
            return await remote.peek(index, subindex) is not None
        return await remote.may_be_written(index, subindex)

    async def _try_to_map(self, current: PdoParameters, wanted: _TargetPdo) -> int | None:
        """Map a PDO; return its identifier, or None if the drive refuses. Then the PDO is as it was before."""
        cob_id, kind, entries, timer, inhibit = wanted
        index, wait_until = current.at, self._remote.wait_until
        writes = _ReversibleWrites(self._remote)
        fixed = False
        try:
            # CiA 301: the identifier may change only while the PDO is invalid, so the old identifier is marked invalid.
            await writes.write(
                index, 1, (current.cob_id if current.valid and current.cob_id is not None else cob_id) | INVALID
            )
            await wait_until((index, 1), lambda held: bool(held & INVALID))
        except SdoRefused:
            if not current.valid:
                return None
            fixed, cob_id = True, current.cob_id or 0
        try:
            if current.kind != kind:
                await writes.write(index, 2, kind)
                await self._drive.confirm((index, 2), kind)
            for parameter in (inhibit, timer):
                if parameter is not None:
                    await self._set_time(writes, index, kind, *parameter)
            if not current.maps(entries):
                await writes.write(index + 0x200, 0, 0)
                await wait_until((index + 0x200, 0), lambda held: held == 0)
                for position, entry in enumerate(entries, start=1):
                    await writes.write(index + 0x200, position, entry)
                    await self._drive.confirm((index + 0x200, position), entry)
                await writes.write(index + 0x200, 0, len(entries))
                await self._drive.confirm((index + 0x200, 0), len(entries))
            if not fixed:
                await writes.write(index, 1, cob_id)
        except SdoRefused as refusal:
            self._drive.add_note(f"PDO {index:04X} cannot be mapped as wanted: {str(refusal).partition(': ')[2]}")
            await writes.undo()
            return None
        if not fixed:
            await self._drive.confirm((index, 1), cob_id)
        return cob_id & _IDENTIFIER

    async def _set_time(self, writes: _ReversibleWrites, index: int, kind: int, subindex: int, value: int) -> None:
        """Set the event timer or the inhibit time of a PDO.

        If the drive refuses one of a TPDO, the TPDO is used all the same: the statusword and the inputs are also polled
        by SDO if they may be late. A TPDO that is sent at SYNC ignores both times (CiA 301).
        """
        try:
            await writes.write(index, subindex, value)
        except SdoRefused as refusal:
            if index < TPDO:
                raise
            named = f"{index:04X}:{subindex:02X}"
            self._drive.changes = [each for each in self._drive.changes if each.object != named]
            if kind != EVERY_SYNC:
                held = await self._remote.peek(index, subindex)
                self._drive.lack((index, subindex), f"it cannot be set, and stays {held}", refusal)
            return
        await self._drive.confirm((index, subindex), value)

    async def _event_timer(self, index: int, kind: int) -> tuple[int, int] | None:
        """Return the subindex and the value of the event timer if it must be changed, otherwise None.

        The event timer of a TPDO repeats the statusword and the inputs. That of an RPDO is a deadline, and must be off.
        """
        if index < TPDO:
            return await self._parameter(index, 5, 0)
        return (
            await self._parameter(index, 5, round(1000 * canopen_frames.STATUS_PERIOD)) if kind == ON_CHANGE else None
        )

    async def _parameter(self, index: int, subindex: int, value: int) -> tuple[int, int] | None:
        """Return `subindex` and `value` if this communication parameter of a PDO must be changed to `value`.

        Return None if the drive lacks the parameter, or if the parameter already equals `value`.
        """
        if not await self._remote.has(index, subindex) or await self._remote.peek(index, subindex) == value:
            return None
        return subindex, value

    async def _note(self, current: PdoParameters, wanted: _TargetPdo) -> None:
        cob_id, kind, entries, timer, inhibit = wanted
        note, look = self._drive.note, self._remote.peek
        if not current.valid or current.identifier != cob_id & _IDENTIFIER:
            note((current.at, 1), current.cob_id, cob_id, "the PDO's identifier")
        if current.kind != kind:
            note((current.at, 2), current.kind, kind, "at every SYNC" if kind == EVERY_SYNC else "event-driven")
        for parameter in (inhibit, timer):
            if parameter is not None:
                note((current.at, parameter[0]), await look(current.at, parameter[0]), parameter[1])
        if not current.maps(entries):
            had = current.entries or ()
            for position, entry in enumerate(entries, start=1):
                now = had[position - 1] if position <= len(had) else None
                if now != entry:
                    note((current.at + 0x200, position), now, entry, "the PDO's mapping")
            if current.number != len(entries):
                note((current.at + 0x200, 0), current.number, len(entries), "the PDO's mapping")

    # ------------------------------------------------------------------ PDOs that cannot be changed

    async def _fixed_setpoints(self, mode: int) -> SetpointPdo:
        name = f"setpoints {POSITIONS[mode] >> 16:04X}"
        pdo = await self._find_fixed(RPDO, lambda entries: fits_setpoints(entries, mode), name, EVERY_SYNC)
        return SetpointPdo(pdo.identifier, pdo.entries or ())

    async def _find_fixed(
        self, base: int, fits: Callable[[tuple[int, ...]], bool], name: str, kind: int
    ) -> PdoParameters:
        """Return an unused PDO whose fixed mapping fits. Raises DriveError if there is none."""
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
                    but = f", which fits, but its transmission type {index:04X}:02 stays {pdo.kind}; expected {kind}"
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
            return await self._drive.ensure(pdo.at, 2, kind) == kind
        except DriveError:
            return False

    # ------------------------------------------------------------------ the statusword

    async def _status(self, *, inputs: bool) -> tuple[int | None, bool, bool]:
        """Set up the TPDO of the statusword, and of the inputs if they are wanted and fit into the same TPDO.

        Return the identifier of the TPDO, or None; whether the statusword must be polled; and whether the TPDO contains
        the inputs.
        """
        number = canopen_frames.TPDO1 + self._node
        if inputs:
            identifier = await self._map(TPDO, number, ON_CHANGE, (STATUSWORD, DIGITAL_INPUTS))
            if identifier is not None:
                return identifier, not await self._is_repeated(TPDO), True
        identifier = await self._map(TPDO, number, ON_CHANGE, (STATUSWORD,))
        if identifier is not None:
            return identifier, not await self._is_repeated(TPDO), False
        pdo = await self._first_fixed(TPDO, (STATUSWORD,), ON_CHANGE)
        if pdo is None:
            return None, True, False
        return pdo.identifier, not await self._is_repeated(pdo.at), False

    async def _is_repeated(self, index: int) -> bool:
        """Whether the drive sends an event-driven TPDO periodically, often enough, and changes as early as a poll."""
        period_ms, inhibit = await self._remote.peek(index, 5) or 0, await self._remote.peek(index, 3) or 0
        is_prompt = inhibit <= round(canopen_frames.POLL_PERIOD / INHIBIT_UNIT_S)
        return 0 < period_ms <= round(1000 * canopen_frames.STATUS_PERIOD) and is_prompt

    async def _can_be_prompt(self, index: int) -> bool:
        """Whether the inhibit time is 0 or can be set to 0. With another inhibit time, a statusword may be delayed."""
        held = await self._remote.peek(index, 3)
        if not held:
            return True
        writes = _ReversibleWrites(self._remote)
        try:
            await writes.write(index, 1, (await self._remote.peek(index, 1) or 0) | INVALID)
            await self._remote.wait_until((index, 1), lambda held: bool(held & INVALID))
            await writes.write(index, 3, 0)
            can_be_0 = (await self._remote.wait_until((index, 3), lambda held: held == 0))[0] == 0
        except SdoRefused:
            can_be_0 = False
        await writes.undo()
        return can_be_0

    # ------------------------------------------------------------------ reading

    async def _mappable(self, entry: int) -> bool:
        """Whether the drive has an object and its EDS does not exclude the object from PDOs."""
        variable = self._remote.client.od.get_variable(entry >> 16, entry >> 8 & 0xFF)
        there = await self._remote.has(entry >> 16, entry >> 8 & 0xFF)
        return there and (variable is None or bool(variable.pdo_mappable))

    async def _all(self, base: int) -> list[int]:
        named = {index for index in self._remote.client.od if base <= index < base + MAX_PDOS}
        index, missed = base, 0
        while missed < _MAX_GAP and index < base + MAX_PDOS:
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
        # Some drives count empty entries.
        mapped = None if entries is None else tuple(entry & 0xFFFF_FFFF for entry in entries if entry)
        return PdoParameters(index, await look(index, 1), await look(index, 2), mapped, number)
