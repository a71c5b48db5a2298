"""Who watches whom: heartbeats, or node guarding where a drive has no heartbeat consumer; and its EMCY (CiA 301)."""

from __future__ import annotations

from typing import Final, NamedTuple

import can

from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import frames
from trirail_drivers.cia402.differences import Differences
from trirail_drivers.config import Drives

MISSED: Final = 3
"""So many heartbeats, or guardings, in a row that do not come are a loss."""


class Watched(NamedTuple):
    """How a drive and the service know of each other."""

    guarded: bool
    heard: bool
    emergency: int
    """Identifier of its EMCY."""


def give_watchdogs(drive: Differences, drives: Drives, period: int, node: int) -> Watched:
    """Set up what watches the drive and what it watches, with a `period` [ms]."""
    guarded = not drive.remote.has(0x1016, 1) and _give_guarding(drive, period, node)
    heard = True
    if not guarded:
        heard = drive.give(0x1017, 0, period) is not None
        drive.give(0x1016, 1, drives.master_node << 16 | MISSED * period)
    if drive.remote.has(0x1029, 1):
        drive.give(0x1029, 1, 0)  # a drive that lost its master turns pre-operational: deaf to setpoints
    else:
        drive.lack((0x1029, 1), "it has no such object")
    return Watched(guarded, heard, _emergency(drive, drives, node))


def _give_guarding(drive: Differences, period: int, node: int) -> bool:
    """Set node guarding up, and try whether the drive answers; False, with all as it was, where it does not."""
    remote = drive.remote
    if not (remote.has(0x100C) and remote.has(0x100D)):
        return False
    found = remote.look(0x100C), remote.look(0x100D)
    heartbeats = remote.look(0x1017)
    if heartbeats:
        drive.give(0x1017, 0, 0)  # CiA 301: a node has heartbeats or is guarded, not both
    unset = 0 in found
    if remote.rehearsed and (heartbeats or unset):
        _set_guarding(drive, period, MISSED)  # it may answer none as it is; setting it up will tell
        return True
    # Asked before it is set, for with the first guarding after that its life time begins (CiA 301, 7.2.8.2.2).
    answers = _answers(drive, node)
    if answers or unset:
        _set_guarding(drive, period, MISSED)
    if not answers and unset:
        answers = _answers(drive, node)  # some, as lely-core, answer only once it is set
        if not answers:
            _set_guarding(drive, *found)
    drive.tell(
        "has no heartbeat consumer (1016): node guarding instead"
        if answers
        else "object 100C:00 (Guard time) is there, but the drive answers no guarding"
    )
    return answers


def _set_guarding(drive: Differences, guard_time: int | None, life_time_factor: int | None) -> None:
    for index, value in ((0x100C, guard_time), (0x100D, life_time_factor)):
        if value is not None:
            drive.give(index, 0, value)


def _answers(drive: Differences, node: int) -> bool:
    """Whether the drive answers a remote request for its state."""
    client = drive.remote.client
    try:
        client.bus.send(Frame(frames.HEARTBEAT + node, b"\0", remote=True).message())
    except (can.CanError, OSError, NotImplementedError):
        return False
    deadline = client.clock() + client.timeout
    while (left := deadline - client.clock()) > 0:
        message = client.bus.recv(left)
        if message is None:
            return False
        if message.arbitration_id == frames.HEARTBEAT + node and not message.is_remote_frame and message.data:
            return True
    return False


def _emergency(drive: Differences, drives: Drives, node: int) -> int:
    """The identifier of the drive's EMCY: the predefined one, or what it keeps instead."""
    remote, usual = drive.remote, frames.EMCY + node
    found = remote.look(0x1014)
    if found is not None and found & 0x8000_07FF != usual:
        drive.give(0x1014, 0, usual)
        now = remote.look(0x1014) or 0
        others = {frames.EMCY + other.node for other in drives.each} | {frames.SYNC}
        if now & 0x7FF != usual and not now & 1 << 31 and now & 0x7FF not in others:
            usual = now & 0x7FF
    if remote.look(0x1015):
        drive.give(0x1015, 0, 0)
    return usual
