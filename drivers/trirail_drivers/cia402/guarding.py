"""Set-up of the mutual supervision of drive and service, and of the drive's EMCY (CiA 301).

Drive and service supervise each other by heartbeats, or by node guarding if the drive has no heartbeat consumer. Node
guarding needs remote frames, so a CAN FD bus needs the heartbeat consumer.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Final, NamedTuple

import can

from trirail_drivers.bus.frames import Frame, can_id, is_fd
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import Key, title
from trirail_drivers.cia402.sdo import INVALID, SdoRefused, shown
from trirail_drivers.config import Drives
from trirail_drivers.driver.conversations import Wait

_EMCY_ID: Final[Key] = 0x1014, 0
_EMCY_BITS: Final = 0x8000_07FF
"""Bits of 1014h that contain the identifier of the EMCY, and whether the EMCY is disabled."""
MOST_WATCHED: Final = 8
"""Maximum number of entries of 1016h that are read."""
MISSED: Final = 3
"""Number of consecutive missed heartbeats or guarding requests that count as a loss."""


class Supervision(NamedTuple):
    """Supervision of one drive."""

    guarded: bool
    """Whether node guarding is used."""
    heard: bool
    """Whether the drive sends heartbeats or answers node guarding."""
    emergency: int
    """Identifier of the drive's EMCY."""


async def configure_watchdogs(drive: Differences, drives: Drives, period: int, node: int) -> Supervision:
    """Configure the mutual supervision of drive and service with a heartbeat or guarding `period` [ms]."""
    consumes, fd = await drive.remote.has(0x1016, 1), is_fd(drive.remote.client.bus)
    guarded = not (consumes or fd) and await _configure_guarding(drive, period, node)
    heard = True
    if not guarded:
        heard = await drive.ensure(0x1017, 0, period) is not None
        if consumes or not fd:
            await _watch_master(drive, drives.master_node, MISSED * period)
        else:
            drive.lack((0x1016, 1), "it has no such object, and CAN FD has no remote frames for node guarding instead")
    await drive.ensure(0x1029, 1, 0)  # a drive without its master becomes pre-operational, so that it ignores setpoints
    return Supervision(guarded, heard, await _emergency(drive, node))


async def _watch_master(drive: Differences, master: int, period: int) -> None:
    """Make the drive monitor the master's heartbeat, in an entry of 1016h that is free or already the master's."""
    remote, wanted = drive.remote, master << 16 | period
    entries = range(1, 1 + min(await remote.peek(0x1016) or 1, MOST_WATCHED))
    held = {entry: await remote.peek(0x1016, entry) or 0 for entry in entries}
    own = [entry for entry, value in held.items() if value >> 16 & 0x7F == master]
    free = [entry for entry, value in held.items() if not (value >> 16 & 0x7F and value & 0xFFFF)]
    for entry in dict.fromkeys((*own, *free)):  # CiA 301: a node may appear in only one entry
        if await drive.try_ensure((0x1016, entry), wanted):
            return
    await drive.ensure(0x1016, 1, wanted)


async def _configure_guarding(drive: Differences, period: int, node: int) -> bool:
    """Set up node guarding. If the drive does not answer, restore the previous state and return False."""
    remote = drive.remote
    if not (await remote.has(0x100C) and await remote.has(0x100D)):
        return False
    current = await remote.peek(0x100C), await remote.peek(0x100D)
    heartbeats = await remote.peek(0x1017)
    if heartbeats:
        await drive.ensure(0x1017, 0, 0)  # CiA 301: a node uses either heartbeats or guarding, not both
    unset = 0 in current
    if remote.rehearsed and (heartbeats or unset):
        await _set_guarding(drive, period, MISSED)  # in a dry run, the answers cannot be tested
        return True
    # Guarding is tested before it is set up, since the first request after set-up starts the life time, after which a
    # drive without further requests reacts to the loss of its master (CiA 301, 7.2.8.2.2).
    answers = await _answers(drive, node)
    if answers or unset:
        await _set_guarding(drive, period, MISSED)
    if not answers and unset:
        answers = await _answers(drive, node)  # some drives, such as lely-core, answer only once guarding is set up
        if not answers:
            await _set_guarding(drive, *current)
    drive.add_note(
        "has no heartbeat consumer (1016): node guarding instead"
        if answers
        else "has object 100C:00 (Guard time), but does not answer node guarding"
    )
    return answers


async def _set_guarding(drive: Differences, guard_time: int | None, life_time_factor: int | None) -> None:
    for index, value in ((0x100C, guard_time), (0x100D, life_time_factor)):
        if value is not None:
            await drive.ensure(index, 0, value)


async def _answers(drive: Differences, node: int) -> bool:
    """Whether the drive answers a remote request for its state."""
    client = drive.remote.client
    try:
        client.bus.send(Frame(canopen_frames.HEARTBEAT + node, b"\0", remote=True).message())
    except (can.CanError, OSError, NotImplementedError):
        return False

    def is_answer(message: can.Message) -> bool:
        return can_id(message) == canopen_frames.HEARTBEAT + node and len(message.data) > 0

    return await Wait(is_answer, client.clock() + client.timeout) is not None


async def _emergency(drive: Differences, node: int) -> int:
    """Set the predefined identifier of the drive's EMCY; return it, or the identifier that the drive uses instead."""
    remote, usual = drive.remote, canopen_frames.EMCY + node
    current = await remote.peek(0x1014)
    if current is not None and current & _EMCY_BITS != usual and not await _move_emergency(drive, current, usual):
        kept = f"{title(_EMCY_ID)} stays {shown(*_EMCY_ID, current)}"
        if current & INVALID:
            drive.add_note(f"{kept}: its EMCY is off, so only its statusword shows faults")
        else:
            drive.add_note(f"{kept}: its EMCY is received there")
            usual = current & 0x7FF
    if await remote.peek(0x1015):
        await drive.ensure(0x1015, 0, 0)
    return usual


async def _move_emergency(drive: Differences, current: int, wanted: int) -> bool:
    """Change the identifier of the drive's EMCY; return whether the drive accepts it."""
    remote = drive.remote
    if not current & INVALID:  # CiA 301: the identifier must not change while the EMCY exists
        with suppress(SdoRefused):
            await remote.write(*_EMCY_ID, current | INVALID)
            await remote.wait_until(_EMCY_ID, lambda held: bool(held & INVALID))
    try:
        await drive.put(_EMCY_ID, current, wanted)
    except SdoRefused:
        with suppress(SdoRefused):
            await remote.write(*_EMCY_ID, current)
        return False
    return True
