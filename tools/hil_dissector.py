"""Check of a log of CAN frames by Wireshark's CANopen dissector, which knows CiA 301 but not trirail.

`tshark` decodes the log. The checks use only the fields that it prints (names: `tshark -G fields`), and no code of
trirail.
"""

from __future__ import annotations

import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from hil_needs import SEARCH
from hil_programs import Failed

HELD = "Wireshark's dissector reads every frame; each SDO request is answered for its object; started nodes stay so"

FIELDS = (
    "frame.time_epoch",
    "canopen.function_code",
    "canopen.node_id",
    "_ws.malformed",
    "canopen.sdo.main_idx",
    "canopen.sdo.sub_idx",
    "canopen.sdo.abort_code",
    "canopen.em.err_code",
    "canopen.nmt_guard.state",
    "canopen.nmt_ctrl.cd",
    "canopen.nmt_ctrl.node_id",
    "canopen.pdo.data.bytes",
)
SDO_ANSWER, SDO_REQUEST, EMERGENCY, ERROR_CONTROL = 0xB, 0xC, 0x1, 0xE
"""Function codes, which are bits 7 to 10 of an identifier (CiA 301, 7.3.3)."""
SYNC, RPDO3 = 0x1, 0x8
"""Function codes of SYNC, whose node id is 0, and of the PDO with digital outputs."""
BOOT_UP, OPERATIONAL = 0x0, 0x5
START, ALL_NODES = 0x01, 0
"""Command specifier and node id of an NMT command (CiA 301, 7.2.8.3.1)."""


class Dissected(NamedTuple):
    """Frame as decoded by the dissector. A field that the frame does not have is None."""

    t: float
    """Time since 1970 [s]."""
    function: int | None
    node: int | None
    malformed: bool
    entry: tuple[int, int] | None
    """Index and sub-index of an SDO."""
    abort: int | None
    emergency: int | None
    """Error code of an EMCY; 0 means "no error"."""
    state: int | None
    """NMT state in a heartbeat or boot-up message."""
    command: int | None
    commanded: int | None
    """NMT command, and the node id that it addresses."""
    data: bytes = b""
    """Data of a PDO."""


def dissect(log: Path) -> list[Dissected]:
    """Decode a log in candump's format by tshark. Raises Failed if tshark cannot read it."""
    command = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "occurrence=f"]
    for field in FIELDS:
        command += ["-e", field]
    done = subprocess.run(command, env={"PATH": SEARCH, "HOME": "/tmp"}, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise Failed(f"tshark cannot read {log}: {done.stderr.strip().splitlines()[-1]}")
    return [_frame(line.split("\t")) for line in done.stdout.splitlines()]


def problems(frames: Sequence[Dissected], until: float) -> list[str]:
    """Return the errors, one line each.

    All frames must be readable. Before the time `until` there are no disturbances: each node must answer every request
    for the right object, stay operational, and report no errors. Later these rules do not apply, since a node that
    receives nothing is sent a stop without a wait for its answer.
    """
    calm = [frame for frame in frames if frame.t < until]
    return [*_unreadable(frames), *_foreign(calm), *_unanswered(calm), *_fallen(calm)]


class Switch(NamedTuple):
    """PDO that changes a digital output."""

    sync: int
    """Number of SYNCs before the PDO in the log."""
    on: bool
    next_sync: float
    """Time of the SYNC after the PDO, at which the drive applies the output [s since 1970]."""


def switches(frames: Sequence[Dissected], node: int, output: int) -> list[Switch]:
    """Return the PDOs to a node that changed an output, a bit of 60FEh:01. The output is off at first."""
    changes: list[Switch] = []
    pending: list[bool] = []
    on, syncs = False, 0
    for frame in frames:
        if frame.function == SYNC and not frame.node:
            changes += [Switch(syncs, value, frame.t) for value in pending]
            pending, syncs = [], syncs + 1
        elif frame.function == RPDO3 and frame.node == node:
            value = bool(int.from_bytes(frame.data, "little") & output)
            pending += [value] if value is not on else []
            on = value
    return changes


def statistics(frames: Sequence[Dissected]) -> dict[str, int]:
    """Return statistics: the number of frames of each kind, as decoded by the dissector."""
    kinds = Counter("other" if frame.function is None else _KINDS.get(frame.function, "other") for frame in frames)
    return dict(sorted(kinds.items()))


_KINDS = {0x0: "NMT", 0x1: "SYNC and EMCY", SDO_ANSWER: "SDO", SDO_REQUEST: "SDO", ERROR_CONTROL: "heartbeat"}
_KINDS |= dict.fromkeys(range(0x3, 0xB), "PDO")


def _unreadable(frames: Sequence[Dissected]) -> Iterator[str]:
    for frame in frames:
        if frame.malformed:
            yield f"malformed, says Wireshark: function code {frame.function}, node {frame.node}, at {frame.t:.6f}"


def _foreign(frames: Sequence[Dissected]) -> Iterator[str]:
    """Yield a line if the dissector has not decoded every frame as CANopen; without a frame, nothing is proved."""
    undecoded = sum(frame.function is None for frame in frames)
    if undecoded or not frames:
        yield f"{undecoded} of {len(frames)} frames are not CANopen, says Wireshark"


def _unanswered(frames: Sequence[Dissected]) -> Iterator[str]:
    """Yield a line for each SDO request that has no answer, or an answer for a different object."""
    asked: dict[int, Dissected] = {}
    for frame in frames:
        if frame.entry is None or frame.node is None:
            continue
        if frame.function == SDO_REQUEST:
            asked[frame.node] = frame
        elif frame.function == SDO_ANSWER and (request := asked.pop(frame.node, None)) and request.entry != frame.entry:
            yield f"node {frame.node} is asked for {_entry(request)} and answers {_entry(frame)}, at {frame.t:.6f}"
    yield from (f"node {node} leaves {_entry(request)} without an answer" for node, request in asked.items())


def _fallen(frames: Sequence[Dissected]) -> Iterator[str]:
    """Yield a line for each node that leaves NMT operational without a command, or sends an EMCY."""
    operational: set[int] = set()
    for frame in frames:
        if frame.command not in (None, START):
            operational -= set(operational) if frame.commanded == ALL_NODES else {frame.commanded or 0}
        if frame.emergency:
            yield f"node {frame.node} sends EMCY {frame.emergency:04X}, at {frame.t:.6f}"
        if frame.state is None or frame.node is None:
            continue
        if frame.state == OPERATIONAL:
            operational.add(frame.node)
        elif frame.state != BOOT_UP and frame.node in operational:
            yield f"node {frame.node} is operational no more but {frame.state:02X}, at {frame.t:.6f}"


def _entry(frame: Dissected) -> str:
    index, sub = frame.entry or (0, 0)
    return f"{index:04X}:{sub:02X}"


def _frame(fields: Sequence[str]) -> Dissected:
    t, function, node, malformed, *entry, abort, emergency, state, command, commanded, data = fields
    index, sub = map(_number, entry)
    return Dissected(
        t=float(t),
        function=_number(function),
        node=_number(node),
        malformed=bool(malformed),
        entry=None if index is None else (index, sub or 0),
        abort=_number(abort),
        emergency=_number(emergency),
        state=_number(state),
        command=_number(command),
        commanded=_number(commanded),
        data=bytes.fromhex(data.replace(":", "")),
    )


def _number(text: str) -> int | None:
    return int(text, 0) if text else None
