"""Who watches whom: heartbeats, or node guarding where a drive has no heartbeat consumer; and its EMCY (CiA 301)."""

from __future__ import annotations

from typing import Final, NamedTuple

import can

from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.conversations import Wait
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.cia402.objects import title
from trirail_drivers.cia402.sdo import INVALID, shown
from trirail_drivers.config import Drives

_EMCY_BITS: Final = 0x8000_07FF
"""Of 1014h: whether it is off, and its identifier."""
MOST_WATCHED: Final = 8
"""Entries of 1016h that are looked at."""
MISSED: Final = 3
"""So many heartbeats, or guardings, in a row that do not come are a loss."""


class Watched(NamedTuple):
    """How a drive and the service know of each other."""

    guarded: bool
    heard: bool
    emergency: int
    """Identifier of its EMCY."""


async def give_watchdogs(drive: Differences, drives: Drives, period: int, node: int) -> Watched:
    """Set up what watches the drive and what it watches, with a `period` [ms]."""
    guarded = not await drive.remote.has(0x1016, 1) and await _give_guarding(drive, period, node)
    heard = True
    if not guarded:
        heard = await drive.give(0x1017, 0, period) is not None
        await _watch_master(drive, drives.master_node, MISSED * period)
    await drive.give(0x1029, 1, 0)  # a drive that lost its master turns pre-operational: deaf to setpoints
    return Watched(guarded, heard, await _emergency(drive, drives, node))


async def _watch_master(drive: Differences, master: int, period: int) -> None:
    """Let the drive watch the master's heartbeat, in an entry of 1016h in which it does not watch another node."""
    remote, wanted = drive.remote, master << 16 | period
    entries = range(1, 1 + min(await remote.peek(0x1016) or 1, MOST_WATCHED))
    held = {entry: await remote.peek(0x1016, entry) or 0 for entry in entries}
    own = [entry for entry, value in held.items() if value >> 16 & 0x7F == master]
    free = [entry for entry, value in held.items() if not (value >> 16 & 0x7F and value & 0xFFFF)]
    for entry in dict.fromkeys((*own, *free)):  # CiA 301: no two entries have one node
        if await drive.is_given((0x1016, entry), wanted):
            return
    await drive.give(0x1016, 1, wanted)


async def _give_guarding(drive: Differences, period: int, node: int) -> bool:
    """Set node guarding up, and try whether the drive answers; False, with all as it was, where it does not."""
    remote = drive.remote
    if not (await remote.has(0x100C) and await remote.has(0x100D)):
        return False
    found = await remote.peek(0x100C), await remote.peek(0x100D)
    heartbeats = await remote.peek(0x1017)
    if heartbeats:
        await drive.give(0x1017, 0, 0)  # CiA 301: a node has heartbeats or is guarded, not both
    unset = 0 in found
    if remote.rehearsed and (heartbeats or unset):
        await _set_guarding(drive, period, MISSED)  # it may answer none as it is; setting it up will tell
        return True
    # Asked before it is set, for with the first guarding after that its life time begins (CiA 301, 7.2.8.2.2).
    answers = await _answers(drive, node)
    if answers or unset:
        await _set_guarding(drive, period, MISSED)
    if not answers and unset:
        answers = await _answers(drive, node)  # some, as lely-core, answer only once it is set
        if not answers:
            await _set_guarding(drive, *found)
    drive.add_note(
        "has no heartbeat consumer (1016): node guarding instead"
        if answers
        else "object 100C:00 (Guard time) is there, but the drive answers no guarding"
    )
    return answers


async def _set_guarding(drive: Differences, guard_time: int | None, life_time_factor: int | None) -> None:
    for index, value in ((0x100C, guard_time), (0x100D, life_time_factor)):
        if value is not None:
            await drive.give(index, 0, value)


async def _answers(drive: Differences, node: int) -> bool:
    """Whether the drive answers a remote request for its state."""
    client = drive.remote.client
    try:
        client.bus.send(Frame(canopen_frames.HEARTBEAT + node, b"\0", remote=True).message())
    except (can.CanError, OSError, NotImplementedError):
        return False

    def is_answer(message: can.Message) -> bool:
        own = message.arbitration_id == canopen_frames.HEARTBEAT + node
        return own and not message.is_remote_frame and len(message.data) > 0

    return await Wait(is_answer, client.clock() + client.timeout) is not None


async def _emergency(drive: Differences, drives: Drives, node: int) -> int:
    """The identifier of the drive's EMCY: the predefined one, or what it keeps instead."""
    remote, usual = drive.remote, canopen_frames.EMCY + node
    found = await remote.peek(0x1014)
    if found is not None and found & _EMCY_BITS != usual and not await drive.is_given((0x1014, 0), usual):
        others = {canopen_frames.EMCY + other.node for other in drives.each} | {canopen_frames.SYNC}
        kept = shown(0x1014, 0, found)
        if found & INVALID:
            drive.add_note(
                f"{title((0x1014, 0))} stays {kept}: its EMCY is switched off, and its statusword alone tells"
            )
        elif found & 0x7FF in others:
            drive.lack((0x1014, 0), f"it keeps {kept}")
        else:
            drive.add_note(f"{title((0x1014, 0))} stays {kept}: its EMCY is heard there")
            usual = found & 0x7FF
    if await remote.peek(0x1015):
        await drive.give(0x1015, 0, 0)
    return usual
