"""Saving and restoring of all drive parameters, for `trirail drives save`, `compare` and `restore`."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import can
from canopen.objectdictionary import ODArray

from trirail_drivers.bus.frames import send_in_setup
from trirail_drivers.cia402 import canopen_frames, setup
from trirail_drivers.cia402.digital_io import MASK
from trirail_drivers.cia402.makers_objects import UNITS, address, owned
from trirail_drivers.cia402.objects import Key
from trirail_drivers.cia402.one_drive import HAS_POWER, wait_for_drive
from trirail_drivers.cia402.other_masters import exclusive_bus
from trirail_drivers.cia402.parameter_file import (
    IDENTITY,
    Origin,
    ParameterDifference,
    SavedParameters,
    compare,
    format_number,
    origin,
)
from trirail_drivers.cia402.parameters import Parameter, is_parameter, named, parameter, variables
from trirail_drivers.cia402.sdo import Remote, SdoRefused, TransferError, reason
from trirail_drivers.config import NO_IO, DigitalIo, Drive, Drives
from trirail_drivers.driver.conversations import read_until, run_concurrently
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import NAMES, Clock, PowerState

MAX_ATTEMPTS: Final = 3
"""Maximum number of requests for one object, of which frames may be lost."""
MAX_TIMEOUTS: Final = 3
"""Number of consecutive objects without an answer after which a drive counts as lost."""
MAX_WRITE_ROUNDS: Final = 3
"""Maximum number of passes over the differing values. Several are needed because one value may change another."""
STORE_TIMEOUT_S: Final = 20.0
"""Longest time to store parameters [s]: the drive answers only when it has finished (CiA 301, 1010h)."""
_STORE: Final[Key] = 0x1010, 1
_SAVE: Final = b"save"
_SDO_CHANNELS: Final = range(0x1200, 0x1300)
"""SDO parameters of CiA 301, whose identifiers depend on the node id."""
_POWERED: Final = (*HAS_POWER, PowerState.FAULT_REACTION_ACTIVE, None)
"""States in which the drive may have power; None represents a statusword that encodes no CiA 402 state."""

T = TypeVar("T")


class UnrestoredParameter(NamedTuple):
    """Parameter whose value in the drive still differs from the file after a restore."""

    different: ParameterDifference
    """Values in the file and in the drive."""
    why: str
    intended: bool
    """Whether the parameter was skipped on purpose, because the set-up writes it or it is the node id or bit rate."""
    by_setup: bool = False
    """Whether it was skipped because the set-up writes it at each start of the service."""


class RestoreResult(NamedTuple):
    """Result of restoring a drive's parameters."""

    written: tuple[Key, ...]
    left: tuple[UnrestoredParameter, ...]
    stored: bool
    not_stored: str
    """Reason why the parameters were not stored as requested, or ""."""

    @property
    def ok(self) -> bool:
        """Whether everything was restored and stored as requested."""
        return all(each.intended for each in self.left) and not self.not_stored


class RestoreAbortedError(DriveError):
    """A restore ended after some parameters had been written: the drive has parameters of both kinds."""

    def __init__(self, drive: str, written: tuple[Key, ...], intended: int, cause: BaseException) -> None:
        reason = str(cause) if isinstance(cause, Exception) else "interrupted"
        super().__init__(
            f"{reason}; drive {drive}: {len(written)} of {intended} parameters were written: "
            "restore it again before use"
        )
        self.written = written
        """Parameters that were written and read back."""
        self.intended = intended
        """Number of parameters that differed from the file."""


def save(
    bus: can.BusABC, drives: Drives, clock: Clock, names: Sequence[str] = NAMES
) -> dict[str, SavedParameters | DriveError]:
    """Read the parameters of the named drives concurrently, without writing anything.

    Raises DriveError if another master is on the bus.
    """
    begun = _Progress()
    return _run_conversations(bus, drives, clock, names, begun, lambda remote, drive: _save(remote, drive, begun))


def restore(
    bus: can.BusABC,
    drives: Drives,
    clock: Clock,
    name: str,
    saved: SavedParameters,
    *,
    replace: bool = False,
    store: bool = False,
    io: Sequence[DigitalIo] = NO_IO,
) -> RestoreResult:
    """Write the parameters that differ from a file, read each back, and report the remaining differences.

    Objects that the set-up writes with the drives' digital outputs `io`, the node id and the bit rate are skipped. The
    drive must be the same product as in the file; with `replace`, its revision, serial number or node id may differ.
    With `store`, the drive stores the parameters (1010h) once all are restored. Raises DriveError if the drive has
    power, or if another master is on the bus.
    """
    begun = _Progress()
    has_outputs = bool(io[NAMES.index(name)].outputs)
    try:
        ends = _run_conversations(
            bus,
            drives,
            clock,
            [name],
            begun,
            lambda remote, drive: _restore(
                remote, drive, saved, begun, has_outputs=has_outputs, replace=replace, store=store
            ),
        )
        return _result_of(ends[name])
    except BaseException as error:  # also Ctrl-C and other signals: the person must know that the drive has changed
        if not begun.has_begun:
            raise
        raise RestoreAbortedError(name, tuple(begun.written), begun.intended, error) from error


def _result_of(end: T | DriveError) -> T:
    """Return the result of a conversation. Raises the error with which it has ended instead."""
    if isinstance(end, DriveError):
        raise end
    return end


class _Progress:
    """Progress of each drive: number of finished objects, and their total number."""

    def __init__(self) -> None:
        self.has_begun = False
        """Whether a restore has begun to write."""
        self.written: dict[Key, None] = {}
        """Parameters that a restore has written and read back."""
        self.intended = 0
        """Number of parameters that a restore must write."""
        self.doing = "reading parameters"
        self.of: dict[str, tuple[int, int]] = {}

    def __str__(self) -> str:
        return f"{self.doing}: " + "; ".join(f"{name} {done} of {all_}" for name, (done, all_) in self.of.items())


def _run_conversations(
    bus: can.BusABC,
    drives: Drives,
    clock: Clock,
    names: Sequence[str],
    progress: _Progress,
    conversation: Callable[[Remote, Drive], Coroutine[Any, Any, T]],
) -> dict[str, T | DriveError]:
    """Run a conversation with each named drive. Raises DriveError if another master sends frames."""
    of = dict(zip(NAMES, drives.each, strict=True))
    with exclusive_bus(bus, drives, clock) as watched:
        remotes = [remote for remote in setup.remotes(watched, drives, clock) if remote.name in names]
        conversations = [conversation(remote, of[remote.name]) for remote in remotes]
        ends = run_concurrently(watched, clock, conversations, lambda: str(progress))
    return {remote.name: end for remote, end in zip(remotes, ends, strict=True)}


async def _save(remote: Remote, drive: Drive, progress: _Progress) -> SavedParameters:
    await wait_for_drive(remote, drive.node, to_pre_operational=False)
    drive_origin = await _origin(remote, drive)
    await _extend_arrays(remote)
    asked = [(key, variable) for key, variable in variables(remote.client.od) if is_parameter(variable)]
    read: dict[Key, Parameter] = {}
    unread: dict[Key, str] = {}
    unanswered: set[Key] = set()
    silent = 0
    for number, (key, variable) in enumerate(asked):
        progress.of[remote.name] = number, len(asked)
        try:
            content = await _repeat(partial(remote.content, key))
        except SdoRefused as refusal:
            unread[key] = reason(refusal.code)
        except TransferError as error:
            unread[key] = str(error).partition(": ")[2]
        except DriveTimeout:
            silent += 1
            if silent == MAX_TIMEOUTS:
                raise
            unread[key] = f"no answer within {remote.client.timeout:g} s"
            unanswered.add(key)
        else:
            silent = 0
            if content:
                read[key] = parameter(variable.data_type, content, variable.qualname)
            else:
                unread[key] = "it is empty, which no file can hold"
    # The built-in EDS describes only a few objects, and without its manufacturer's EDS a drive may have any others.
    complete = drive.eds is not None and not remote.skipped
    return SavedParameters(
        drive_origin, read, unread, remote.client.od, complete, frozenset(unanswered), remote.skipped
    )


async def _repeat(request: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Repeat a request whose answer was lost, and return its result. Raises the error of the last attempt."""
    for _ in range(MAX_ATTEMPTS - 1):
        with suppress(DriveTimeout, TransferError):
            return await request()
    return await request()


async def _extend_arrays(remote: Remote) -> None:
    """Add the array elements that the EDS omits to the dictionary; subindex 0 contains their number (CiA 301)."""
    for index, item in remote.client.od.items():
        if isinstance(item, ODArray) and 1 in item.subindices and is_parameter(item.subindices[1]):
            for subindex in range(1, (await _repeat(partial(remote.peek, index)) or 0) + 1):
                item.add_member(item[subindex])


async def _origin(remote: Remote, drive: Drive) -> Origin:
    return origin(
        {name: await _repeat(partial(remote.peek, *key)) for name, key in IDENTITY.items()} | {"node": drive.node}
    )


async def _restore(
    remote: Remote,
    drive: Drive,
    saved: SavedParameters,
    progress: _Progress,
    *,
    has_outputs: bool,
    replace: bool,
    store: bool,
) -> RestoreResult:
    await wait_for_drive(remote, drive.node, to_pre_operational=False)
    await _check_without_power(remote)
    drive_origin = await _origin(remote, drive)
    _check(remote.name, saved.origin, drive_origin, replace=replace)
    send_in_setup(remote.client.bus, canopen_frames.nmt(canopen_frames.NMT_PRE_OPERATIONAL, drive.node))
    written_by_setup = {
        key: "" if key[0] in UNITS or (key == MASK and not has_outputs) else owned(key, drive)
        for key in saved.parameters
    }
    kept = {
        key: _skip_reason(remote, drive, key, each, saved.origin, drive_origin) or written_by_setup[key]
        for key, each in saved.parameters.items()
    }
    units = {key: each for key, each in saved.parameters.items() if key[0] in UNITS}
    _, refused_units = await _write(remote, units, progress)
    for key, why in refused_units.items():
        progress.has_begun = bool(progress.written)
        raise DriveError(
            f"drive {remote.name}: object {named(key)}, the unit of the file's values, was not accepted: {why}; no "
            "other value was written"
        )
    intended = {key: each for key, each in saved.parameters.items() if not (kept[key] or key in units)}
    refused: dict[Key, str] = {}
    for _ in range(MAX_WRITE_ROUNDS):
        done, refused = await _write(remote, intended, progress)
        if not done:
            break
    now = await _read_held(remote, saved.parameters, progress)
    left = tuple(
        UnrestoredParameter(
            each, kept[each.key] or refused.get(each.key, ""), bool(kept[each.key]), bool(written_by_setup[each.key])
        )
        for each in compare(saved, SavedParameters(saved.origin, now, {}))
    )
    stored, not_stored = False, ""
    if store:
        not_stored = await _store(remote) if all(each.intended for each in left) else "not all is as in the file"
        stored = not not_stored
    return RestoreResult(tuple(progress.written), left, stored, not_stored)


async def _write(
    remote: Remote, intended: Mapping[Key, Parameter], progress: _Progress
) -> tuple[list[Key], dict[Key, str]]:
    """Write the parameters that differ, and try a refused parameter again after the others, which may have blocked it.

    Return the objects that were written, and the reasons why the other objects were not written.
    """
    held = await _read_held(remote, intended, progress)
    due = [key for key, each in intended.items() if key not in held or held[key].data != each.data]
    for key in due:  # all sizes are checked before anything is written
        size = len(held[key].data) if key in held else len(intended[key].data)
        if intended[key].fixed_size and size != len(intended[key].data):
            raise DriveError(
                f"drive {remote.name}: object {named(key)} has {size} bytes, but "
                f"{len(intended[key].data)} in the file{'' if progress.has_begun else '; nothing was written'}"
            )
    written: list[Key] = []
    refused: dict[Key, str] = {}
    progress.intended = len({*due, *progress.written})
    progress.doing = "writing parameters"
    while due:
        for number, key in enumerate(due):
            progress.of[remote.name] = number, len(due)
            await _check_without_power(remote)
            progress.has_begun = True
            refused[key] = await _write_one(remote, key, intended[key], held.get(key))
            if not refused[key]:
                written.append(key)
                progress.written[key] = None
        again = [key for key in due if refused[key]]
        if len(again) == len(due):
            break
        due = again
    return written, {key: why for key, why in refused.items() if why}


async def _write_one(remote: Remote, key: Key, wanted: Parameter, held: Parameter | None) -> str:
    """Write one object and read it back; return the reason why the drive did not accept the value, or ""."""
    if held is None:
        return "the drive does not let it be read"
    try:
        await _repeat(partial(remote.put, key, wanted.data, str(wanted.value)))
        client = remote.client
        result, waited = await read_until(
            lambda: _repeat(partial(remote.content, key)),
            lambda data: data == wanted.data,
            client.pause,
            client.clock,
            client.timeout,
        )
    except SdoRefused as refusal:
        return reason(refusal.code)
    return "" if result == wanted.data else f"it keeps another value, after {waited:.3g} s"


async def _read_held(remote: Remote, parameters: Mapping[Key, Parameter], progress: _Progress) -> dict[Key, Parameter]:
    """Return the current values of the given parameters, except for parameters that cannot be read from the drive."""
    progress.doing = "reading parameters"
    held = {}
    for number, (key, each) in enumerate(parameters.items()):
        progress.of[remote.name] = number, len(parameters)
        try:
            held[key] = parameter(each.data_type, await _repeat(partial(remote.content, key)), each.name)
        except (SdoRefused, TransferError):
            continue
    return held


def _skip_reason(remote: Remote, drive: Drive, key: Key, saved: Parameter, of_file: Origin, of_drive: Origin) -> str:
    """Return the reason why a parameter is skipped although no set-up writes it, or ""."""
    variable = remote.client.od.get_variable(*key) if drive.eds else None
    if variable is not None and not is_parameter(variable):
        return "is no parameter of the drive"
    if key[0] in _SDO_CHANNELS and of_file.node != of_drive.node:
        return "follows the node id"
    names = (saved.name, remote.name_of(key))
    return next(filter(None, (address(key, name, of_drive.vendor) for name in names)), "")


def _check(name: str, of_file: Origin, of_drive: Origin, *, replace: bool) -> None:
    """Raise DriveError if the file belongs to another product or, unless `replace`, to another drive."""
    others = []
    for field in ("device_type", "vendor", "product", "revision", "serial", "node"):
        theirs, mine = getattr(of_file, field), getattr(of_drive, field)
        if theirs == mine or (theirs is None and field not in ("vendor", "product")):
            continue
        if theirs is not None and field in ("device_type", "vendor", "product"):
            raise DriveError(
                f"drive {name}: its {field} is {format_number(field, mine)}, but the file has "
                f"{format_number(field, theirs)}; "
                "use a file for the same product"
            )
        others.append(f"{field} {format_number(field, mine)} (the file's {format_number(field, theirs)})")
    if others and not replace:
        raise DriveError(
            f"drive {name} has {', '.join(others)}; if that is intended, as with a spare drive, add --replace"
        )


async def _check_without_power(remote: Remote) -> None:
    statusword = await _repeat(partial(remote.read, 0x6041))
    state = canopen_frames.power_state(statusword)
    if state in _POWERED:
        raise DriveError(
            f"drive {remote.name}: parameters can only be restored while the drive has no power; its state is "
            f"{state or 'none of CiA 402'} (statusword {statusword:04X})"
        )


async def _store(remote: Remote) -> str:
    """Make the drive store its parameters; return the reason why it refused, or ""."""
    await _check_without_power(remote)
    client = remote.client
    patience, client.timeout = client.timeout, max(client.timeout, STORE_TIMEOUT_S)
    try:
        await remote.put(_STORE, _SAVE, '"save"')
    except SdoRefused as refusal:
        return reason(refusal.code)
    finally:
        client.timeout = patience
    return ""
