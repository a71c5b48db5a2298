"""Reads all parameters of drives, and gives them back: what `trirail drives save`, `compare` and `restore` do."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import can
from canopen.objectdictionary import ODArray, ODVariable

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames, eds, setup
from trirail_drivers.cia402.conversations import side_by_side, until
from trirail_drivers.cia402.makers_objects import address, owned
from trirail_drivers.cia402.objects import Key
from trirail_drivers.cia402.one_drive import HAS_POWER, greet
from trirail_drivers.cia402.other_masters import NoOtherMaster
from trirail_drivers.cia402.parameter_file import Different, Origin, Saved, compare, told
from trirail_drivers.cia402.parameters import BYTES, Parameter, is_parameter, of_kind, parameter
from trirail_drivers.cia402.sdo import Remote, SdoRefused, reason
from trirail_drivers.config import Drive, Drives
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import NAMES, Clock, PowerState

LISTENED: Final = 0.5
"""How long the bus is listened to for another master before anything is sent [s], or for three heartbeats."""
SILENT: Final = 3
"""So many requests in a row that are not answered: the drive has gone."""
ROUNDS: Final = 3
"""How often what differs is written: one value may have the drive change another."""
STORES_WITHIN: Final = 20.0
"""How long a drive may take to store its parameters [s]: it answers when that is done (CiA 301, 1010h)."""
_STORE: Final[Key] = 0x1010, 1
_SAVE: Final = b"save"
_POWERED: Final = (*HAS_POWER, PowerState.FAULT_REACTION_ACTIVE, None)
"""None: a statusword that is none of CiA 402's."""

T = TypeVar("T")


class Left(NamedTuple):
    """A parameter of a file that a drive does not hold after it was restored."""

    different: Different
    """The file's and the drive's."""
    why: str
    meant: bool
    """Whether it was left as it is: the set-up gives it, or it is node id or bitrate."""


class Restored(NamedTuple):
    """What came of giving a drive its parameters back."""

    written: tuple[Key, ...]
    left: tuple[Left, ...]
    stored: bool
    not_stored: str
    """Why it was not, where that was asked for."""

    @property
    def ok(self) -> bool:
        """Whether all is as it was asked for."""
        return all(each.meant for each in self.left) and not self.not_stored


def save(bus: can.BusABC, drives: Drives, clock: Clock, names: Sequence[str] = NAMES) -> dict[str, Saved | DriveError]:
    """Read the parameters of the drives of these names, side by side; nothing is written.

    Raises DriveError where another master is on the bus.
    """
    begun = _Progress()
    return _lead(bus, drives, clock, names, begun, lambda remote, drive: _save(remote, drive, begun))


def restore(
    bus: can.BusABC,
    drives: Drives,
    clock: Clock,
    name: str,
    saved: Saved,
    *,
    replace: bool = False,
    store: bool = False,
) -> Restored:
    """Give a drive what differs from a file, read each back, and say what differs still.

    What the set-up gives, node id and bitrate are left as they are; the drive must be of the file's product, and with
    `replace` may be of another revision or another one of the make. With `store` it keeps them (1010h) once they are
    all there. Raises DriveError where the drive has power, or another master is on the bus.
    """
    begun = _Progress()
    (found,) = _lead(
        bus,
        drives,
        clock,
        [name],
        begun,
        lambda remote, drive: _restore(remote, drive, saved, begun, replace=replace, store=store),
    ).values()
    if isinstance(found, DriveError):
        raise found
    return found


class _Progress:
    """How far each drive is: objects done, of how many."""

    def __init__(self) -> None:
        self.doing = "reading parameters"
        self.of: dict[str, tuple[int, int]] = {}

    def __str__(self) -> str:
        return f"{self.doing}: " + "; ".join(f"{name} {done} of {all_}" for name, (done, all_) in self.of.items())


def _lead(
    bus: can.BusABC,
    drives: Drives,
    clock: Clock,
    names: Sequence[str],
    progress: _Progress,
    conversation: Callable[[Remote, Drive], Coroutine[Any, Any, T]],
) -> dict[str, T | DriveError]:
    """Lead a conversation with each drive of these names, as long as no other master speaks."""
    of = dict(zip(NAMES, drives.each, strict=True))
    with NoOtherMaster(bus, [drive.node for drive in drives.each], drives.master_node) as watched:
        remotes = [remote for remote in setup.remotes(watched, drives, clock) if remote.name in names]
        listened = max(LISTENED, 3.0 * drives.heartbeat)

        async def begun(remote: Remote) -> T:
            await remote.client.pause(listened)
            return await conversation(remote, of[remote.name])

        ends = side_by_side(watched, clock, [begun(remote) for remote in remotes], lambda: str(progress))
    return {remote.name: end for remote, end in zip(remotes, ends, strict=True)}


async def _save(remote: Remote, drive: Drive, progress: _Progress) -> Saved:
    await greet(remote, drive.node, wakes=False)
    origin = await _origin(remote, drive)
    variables = [variable for variable in await _variables(remote) if is_parameter(variable)]
    read: dict[Key, Parameter] = {}
    unread: dict[Key, str] = {}
    silent = 0
    for number, variable in enumerate(variables):
        progress.of[remote.name] = number, len(variables)
        key = variable.index, variable.subindex
        try:
            read[key] = parameter(variable, await remote.content(key))
        except SdoRefused as refusal:
            unread[key] = reason(refusal.code)
        except DriveTimeout:
            silent += 1
            if silent == SILENT:
                raise
            unread[key] = f"no answer within {remote.client.timeout:g} s"
        else:
            silent = 0
    return Saved(origin, read, unread)


async def _variables(remote: Remote) -> list[ODVariable]:
    """The objects of the drive's EDS, in their order; how many an array has, the drive tells (CiA 301)."""
    found: dict[Key, ODVariable] = {}
    for index, item in remote.client.od.items():
        members = [item] if isinstance(item, ODVariable) else list(item.subindices.values())
        found |= {(index, each.subindex): each for each in members}
        if isinstance(item, ODArray) and 1 in item.subindices and is_parameter(item.subindices[1]):
            for subindex in range(1, (await remote.peek(index) or 0) + 1):
                found.setdefault((index, subindex), item[subindex])
    return [found[key] for key in sorted(found)]


async def _origin(remote: Remote, drive: Drive) -> Origin:
    vendor, product, revision, serial = [await remote.peek(0x1018, subindex) for subindex in range(1, 5)]
    return Origin(
        axis=remote.name,
        node=drive.node,
        device_type=await remote.read(0x1000),
        saved=datetime.datetime.now().astimezone().isoformat(timespec="seconds"),
        dictionary=Path(drive.eds).name if drive.eds else f"{eds.SERVO.name}, the built-in one",
        vendor=vendor,
        product=product,
        revision=revision,
        serial=serial,
    )


async def _restore(
    remote: Remote, drive: Drive, saved: Saved, progress: _Progress, *, replace: bool, store: bool
) -> Restored:
    await greet(remote, drive.node, wakes=False)
    await _without_power(remote)
    _check(remote.name, saved.origin, await _origin(remote, drive), replace=replace)
    send_in_setup(remote.client.bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node))
    kept = {key: _kept(remote, key, each, saved.origin.vendor) for key, each in saved.parameters.items()}
    meant = {key: each for key, each in saved.parameters.items() if not kept[key]}
    written: dict[Key, None] = {}
    refused: dict[Key, str] = {}
    for _ in range(ROUNDS):
        done, refused = await _write(remote, meant, progress)
        written |= dict.fromkeys(done)
        if not done:
            break
    now = await _held(remote, saved.parameters, progress)
    left = tuple(
        Left(each, kept[each.key] or refused.get(each.key, ""), bool(kept[each.key]))
        for each in compare(saved, Saved(saved.origin, now, {}))
    )
    stored, not_stored = False, ""
    if store:
        not_stored = await _store(remote) if all(each.meant for each in left) else "not all is as in the file"
        stored = not not_stored
    return Restored(tuple(written), left, stored, not_stored)


async def _write(
    remote: Remote, meant: Mapping[Key, Parameter], progress: _Progress
) -> tuple[list[Key], dict[Key, str]]:
    """Write what differs; what is refused is tried again after the others, which may have been in its way.

    Returns what was written, and of what was not, why.
    """
    held = await _held(remote, meant, progress)
    due = [key for key, each in meant.items() if key not in held or held[key].data != each.data]
    written: list[Key] = []
    refused: dict[Key, str] = {}
    progress.doing = "writing parameters"
    while due:
        for number, key in enumerate(due):
            progress.of[remote.name] = number, len(due)
            await _without_power(remote)
            refused[key] = await _written(remote, key, meant[key], held.get(key))
            if not refused[key]:
                written.append(key)
        again = [key for key in due if refused[key]]
        if len(again) == len(due):
            break
        due = again
    return written, {key: why for key, why in refused.items() if why}


async def _written(remote: Remote, key: Key, wanted: Parameter, held: Parameter | None) -> str:
    """Write one object and read it back; why the drive does not hold it, "" where it does."""
    if held is None:
        return "the drive does not tell it"
    if wanted.kind not in (BYTES, "text") and len(wanted.data) != len(held.data):
        return f"the drive has {len(held.data)} bytes, the file {len(wanted.data)}"
    try:
        await remote.put(key, wanted.data, str(wanted.value))
        client = remote.client
        found, waited = await until(
            lambda: remote.content(key), lambda data: data == wanted.data, client.pause, client.clock, client.timeout
        )
    except SdoRefused as refusal:
        return reason(refusal.code)
    return "" if found == wanted.data else f"it keeps another value, after {waited:.3g} s"


async def _held(remote: Remote, parameters: Mapping[Key, Parameter], progress: _Progress) -> dict[Key, Parameter]:
    """What the drive holds now, of what it tells."""
    progress.doing = "reading parameters"
    held = {}
    for number, (key, each) in enumerate(parameters.items()):
        progress.of[remote.name] = number, len(parameters)
        try:
            held[key] = of_kind(each.kind, await remote.content(key), each.name)
        except SdoRefused:
            continue
    return held


def _kept(remote: Remote, key: Key, saved: Parameter, vendor: int | None) -> str:
    """Why a parameter is left as it is; "" where it is not."""
    return owned(key) or address(key, saved.name, vendor) or address(key, remote.name_of(key), vendor)


def _check(name: str, of_file: Origin, of_drive: Origin, *, replace: bool) -> None:
    """Refuse a file of another product, and one of another revision or another drive unless that is meant."""
    for field in ("device_type", "vendor", "product"):
        mine, theirs = getattr(of_file, field), getattr(of_drive, field)
        if mine != theirs:
            raise DriveError(f"drive {name}: its {field} is {told(theirs)}, the file's {told(mine)}: another product")
    others = [field for field in ("revision", "serial") if getattr(of_file, field) != getattr(of_drive, field)]
    if others and not replace:
        what = ", ".join(
            f"{field} {told(getattr(of_drive, field))} (the file's {told(getattr(of_file, field))})" for field in others
        )
        raise DriveError(f"drive {name} has {what}; where that is meant, as with a spare drive, say --replace")


async def _without_power(remote: Remote) -> None:
    statusword = await remote.read(0x6041)
    state = canopen_frames.power_state(statusword)
    if state in _POWERED:
        raise DriveError(
            f"drive {remote.name}: parameters are restored without power only; its state is "
            f"{state or 'none of CiA 402'} (statusword {statusword:04X})"
        )


async def _store(remote: Remote) -> str:
    """Have the drive keep its parameters; why it does not, "" where it does."""
    await _without_power(remote)
    client = remote.client
    patience, client.timeout = client.timeout, max(client.timeout, STORES_WITHIN)
    try:
        await remote.put(_STORE, _SAVE, '"save"')
    except SdoRefused as refusal:
        return reason(refusal.code)
    finally:
        client.timeout = patience
    return ""
