"""Language of injected faults, one fault per line.

    [at SECONDS] [when DRIVE CONDITION] [with CHANCE] [A|B|C|all] FAULT [VALUE] [FRAMES …] [for SECONDS | for N frames]

`HELP` explains the words. A line with wrong syntax is refused, and the error message shows the correct form.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES

HELP: Final = """\
[at SECONDS] [when DRIVE CONDITION] [with CHANCE] [DRIVE] FAULT [VALUE] [FRAMES ...] [for SECONDS | for N frames]
  at 2.5 A silent for 0.5        when B moving B emcy 4310        with 0.01 C drop tpdo2

faults of frames, to and from a drive (all frames if no FRAMES are named):
  drop · duplicate · corrupt (one bit) · delay SECONDS · dlc LENGTH
  FRAMES  to the drive: to, nmt sync rpdo1 rpdo2 rpdo3 sdo-request; from it: from, heartbeat, emcy tpdo1 tpdo2 tpdo3
          sdo-answer; an ODrive: set_axis_state set_controller_mode set_input_pos clear_errors position-request rxsdo;
          from it: get_version get_error get_encoder_estimates txsdo; or an identifier: 0x181
faults of a drive:
  silent            receives and sends nothing    emcy CODE     sends an emergency only (hexadecimal)
  fault CODE        breaks down with an EMCY      reboot        loses its supply and its set-up
  stuck             the slider does not move      lag SECONDS   the slider follows late
  runaway SPEED     the slider moves at SPEED [m/s] regardless of setpoints, until the drive has no power
faults of its digital outputs and inputs, by their BIT in 60FEh and 60FDh:
  output-stuck BIT  keeps its state         input-bounces BIT  for 5 ms after each edge
  reserves BIT      the manufacturer reserves BIT: it cannot be switched, and is clear in the mask when read back
faults of its mechanics and wiring, as a ruler along the rail shows them:
  reversed          the slider moves backwards            scale RATIO    it moves RATIO times as far as counted
  swapped DRIVE     it moves the slider of DRIVE          loose          its encoder does not turn with the motor
  node ID           the slider of DRIVE is moved by the drive with this node id, whatever is configured
  counts NUMBER     the drive that moves the slider of DRIVE counts NUMBER per metre; below 0 if counts fall as it rises
  slips SHARE       its encoder misses this share of the travel while the position of the slider rises
  against           its encoder counts against its motor: when it has power, it runs away
  play METRES       between drive and slider: backlash
faults of the bus (no DRIVE):
  bus-off           the master's controller leaves the bus        error-passive   the controller is close to bus-off
  babble ID         a node sends this identifier without pause; frames with higher identifiers are blocked
DRIVE is A, B, C or all; with [can.simulated] built, the letters are those of its sliders.
CONDITION is enabled, moving, stopping or fault; the DRIVE before it may be any.
at     seconds after the line is read        for   duration; else until clear (emcy, fault, reboot: momentary)
with   chance per frame, or per second for faults of a drive or the bus
Commands: list · clear (ends all faults) · help"""


class FaultSyntaxError(DriveError):
    """A line does not describe a fault; the message shows the correct form."""


class Frames(NamedTuple):
    """Selection of frames between the bus and a drive."""

    to_drive: bool | None
    """Direction; None for both."""
    identifier: int | None
    """Identifier of the frame for node id 0; None for all identifiers."""
    per_node: int = 0
    """Increment of the identifier per node id; 0 if all nodes have the same identifier."""

    def match(self, to_drive: bool, identifier: int, node: int) -> bool:
        """Whether a frame to or from the drive `node` belongs to the selection."""
        if self.to_drive is not None and self.to_drive is not to_drive:
            return False
        return self.identifier is None or identifier == self.identifier + self.per_node * node


class Condition(NamedTuple):
    """State in which a drive must be for a fault to begin."""

    drive: int | None
    """Index of the drive; None for any drive."""
    state: str


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault described by one line."""

    line: str
    name: str
    drives: tuple[int, ...] = ()
    """Indices of the affected drives; empty for a fault of the bus."""
    value: float = 0.0
    """VALUE of the fault; codes and identifiers are whole numbers."""
    frames: tuple[Frames, ...] = ()
    delay: float = 0.0
    """Shortest time between the reading of the line and the beginning of the fault [s]."""
    condition: Condition | None = None
    chance: float = 1.0
    duration: float = math.inf
    """Duration of the fault [s]."""
    number: int | None = None
    """Number of affected frames; None for all."""


EITHER: Final = {"to": Frames(True, None), "from": Frames(False, None)}
"""Names of frames that exist in every protocol."""
CONDITIONS: Final = ("enabled", "moving", "stopping", "fault")
_DRIVES: Final = {name: (index,) for index, name in enumerate(NAMES)} | {"all": tuple(range(len(NAMES)))}


def _number(fits: Callable[[float], bool] = math.isfinite) -> Callable[[str], float]:
    """Return a parser of finite numbers for which `fits` is True; it raises ValueError for other words."""

    def read(word: str) -> float:
        value = float(word)
        if not (math.isfinite(value) and fits(value)):
            raise ValueError
        return value

    return read


_NOT_NEGATIVE: Final = _number(lambda value: value >= 0.0)


def _drive(word: str) -> float:
    return NAMES.index(word)


def _between(low: int, high: int, base: int) -> Callable[[str], float]:
    def read(word: str) -> float:
        value = int(word, base)
        if not low <= value <= high:
            raise ValueError
        return value

    return read


class _Kind(NamedTuple):
    """Syntax of the words after a fault's name."""

    wants: str = ""
    """Description of the fault's VALUE; empty if it has none."""
    read: Callable[[str], float] | None = None
    example: str = ""
    momentary: bool = False


_OF_FRAMES: Final = {
    "drop": _Kind(),
    "duplicate": _Kind(),
    "corrupt": _Kind(),
    "delay": _Kind("seconds", _NOT_NEGATIVE, "0.002"),
    "dlc": _Kind("a length from 0 to 8", _between(0, 8, 10), "3"),
}
_CODE: Final = _Kind("an error code, four hexadecimal digits", _between(1, 0xFFFF, 16), "4310", momentary=True)
_BIT: Final = _Kind("a bit from 0 to 31", _between(0, 31, 10), "16")
_OF_DRIVES: Final = {
    "silent": _Kind(),
    "emcy": _CODE,
    "fault": _CODE,
    "reboot": _Kind(momentary=True),
    "stuck": _Kind(),
    "lag": _Kind("seconds", _NOT_NEGATIVE, "0.05"),
    "runaway": _Kind("a speed in m/s", _number(), "0.2"),
    "reversed": _Kind(),
    "scale": _Kind("a ratio above 0", _number(lambda ratio: ratio > 0.0), "0.5"),
    "swapped": _Kind("a drive, A, B or C", _drive, "B"),
    "counts": _Kind("counts per metre, below 0 or above", _number(lambda counts: counts != 0.0), "-1e7"),
    "node": _Kind("a node id, 0 to 127", _between(0, 127, 10), "2"),
    "loose": _Kind(),
    "slips": _Kind("a share from 0 to 1", _number(lambda share: 0.0 <= share <= 1.0), "0.3"),
    "against": _Kind(),
    "output-stuck": _BIT,
    "input-bounces": _BIT,
    "reserves": _BIT,
    "play": _Kind("metres", _NOT_NEGATIVE, "0.00005"),
}
OF_PINS: Final = ("output-stuck", "input-bounces", "reserves")
"""Faults of digital outputs and inputs."""
OF_SLIDERS: Final = ("node", "counts")
"""Faults whose DRIVE names a slider. These faults override the configuration of the slider."""
_OF_BUS: Final = {
    "bus-off": _Kind(),
    "error-passive": _Kind(),
    "babble": _Kind("an identifier, hexadecimal", _between(0, 0x7FF, 16), "001"),
}
_KINDS: Final = _OF_FRAMES | _OF_DRIVES | _OF_BUS


class _FaultLineReader:
    """Words of a line, which are read one by one."""

    def __init__(self, line: str) -> None:
        self.left = line.split()

    def next_is(self, *words: str) -> bool:
        return bool(self.left) and self.left[0] in words

    def next_word(self, after: str, wants: str, example: str) -> str:
        if not self.left:
            raise FaultSyntaxError(f"{after} must be followed by {wants}, as in: {example}")
        return self.left.pop(0)

    def value(self, after: str, wants: str, example: str, read: Callable[[str], float]) -> float:
        word = self.next_word(after, wants, example)
        try:
            return read(word)
        except ValueError:
            raise FaultSyntaxError(f"{after} {word}: {after} must be followed by {wants}, as in: {example}") from None


def parse(line: str, known_frames: Mapping[str, Frames]) -> Fault:
    """Parse one line, given the names of the frames. Raises FaultSyntaxError, which shows the correct form."""
    words = _FaultLineReader(line)
    delay, chance, condition = 0.0, 1.0, None
    while words.next_is("at", "when", "with"):
        match words.left.pop(0):
            case "at":
                delay = words.value("at", "seconds", "at 2.5 A silent", _NOT_NEGATIVE)
            case "with":
                fits = _number(lambda chance: 0.0 < chance <= 1.0)
                chance = words.value("with", "a chance above 0, at most 1", "with 0.01 A drop tpdo2", fits)
            case "when":
                condition = _condition(words)
    drives = _DRIVES[words.left.pop(0)] if words.next_is(*_DRIVES) else ()
    if not words.left:
        raise FaultSyntaxError(f"expected a fault at the end, such as: A silent; known faults are {', '.join(_KINDS)}")
    name = words.left.pop(0)
    if name not in _KINDS:
        known = (*_KINDS, *(() if drives else _DRIVES))
        raise FaultSyntaxError(_unknown("fault", name, known))
    kind = _KINDS[name]
    if bool(drives) is (name in _OF_BUS):
        right = "the bus: do not name a drive" if drives else f"a drive: name the drive, as in: A {name}"
        raise FaultSyntaxError(f"{name} is a fault of {right}")
    who = "A " if drives else ""
    value = words.value(name, kind.wants, f"{who}{name} {kind.example}", kind.read) if kind.read else 0.0
    chosen = []
    while words.left and not words.next_is("for"):
        word = words.left.pop(0)
        if name not in _OF_FRAMES:
            raise FaultSyntaxError(f'"{word}" after {name}: only "for" may follow, as in: {who}{name} for 0.5')
        chosen.append(_frames(word, {**known_frames, **EITHER}))
    duration, number = _lasting(words, name, kind.momentary)
    return Fault(line, name, drives, value, tuple(chosen), delay, condition, chance, duration, number)


def _condition(words: _FaultLineReader) -> Condition:
    example = "when B moving A silent"
    drive = words.next_word("when", "A, B, C or any", example)
    if drive not in (*NAMES, "any"):
        raise FaultSyntaxError(f"when {drive}: when must be followed by A, B, C or any, as in: {example}")
    state = words.next_word(f"when {drive}", ", ".join(CONDITIONS), example)
    if state not in CONDITIONS:
        raise FaultSyntaxError(_unknown("condition", state, CONDITIONS))
    return Condition(None if drive == "any" else NAMES.index(drive), state)


def _frames(word: str, known: Mapping[str, Frames]) -> Frames:
    if word in known:
        return known[word]
    try:
        identifier = int(word, 16) if word.startswith("0x") else -1
    except ValueError:
        identifier = -1
    if not 0 <= identifier <= 0x7FF:
        raise FaultSyntaxError(_unknown("frames", word, (*known, "0x181")))
    return Frames(None, identifier)


def _lasting(words: _FaultLineReader, name: str, momentary: bool) -> tuple[float, int | None]:
    if not words.left:
        return (0.0 if momentary else math.inf), None
    words.left.pop(0)
    example = "for 0.5, or for 3 frames" if name in _OF_FRAMES else "for 0.5"
    value = words.value("for", "seconds", example, _NOT_NEGATIVE)
    if not words.left:
        return value, None
    if name not in _OF_FRAMES or words.left not in (["frames"], ["frame"]) or value != round(value) or value < 1:
        raise FaultSyntaxError(f'"{" ".join(words.left)}" after for {value:g}: the line must end as in: {example}')
    return math.inf, round(value)


def _unknown(what: str, word: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
    return f'unknown {what} "{word}"; {hint}'
