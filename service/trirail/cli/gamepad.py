"""A gamepad of Linux's as a pendant: its sticks move the robot while a shoulder button is held.

The codes are those of linux/input-event-codes.h, used as Documentation/input/gamepad.rst of the kernel has them. What
events mean is here without evdev, which only opens the device.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple, Protocol, Self

from trirail.errors import ServiceError

DEAD = 0.15
"""Share of a stick's way in which it counts as let go: no stick comes back to its middle exactly."""
QUIET = 2.0
"""A pad that has said nothing for so long is taken for gone until it says something [s]: of a wireless one whose link
is lost the kernel keeps the last state, for seconds. A stick in a hand is never still, but at its end."""
HELP = "a shoulder button held: left stick x y, right stick φ   pad ↑ ↓ speed   east button stop"


class EventType(IntEnum):
    """Of an event."""

    SYN = 0
    KEY = 1
    ABS = 3


class Code(IntEnum):
    """Of sticks, pads and the stream itself; those of buttons are in Button."""

    SYN_DROPPED = 3
    X = 0
    Y = 1
    RX = 3
    HAT_Y = 17


class Button(IntEnum):
    """Those that mean something here."""

    SOUTH = 304
    EAST = 305
    TL = 310
    TR = 311


class PadEvent(Protocol):
    """What evdev's InputEvent has."""

    @property
    def type(self) -> int:
        """An EventType."""

    @property
    def code(self) -> int:
        """Of what."""

    @property
    def value(self) -> int:
        """Of a button 1 or 0, of a stick where it is."""


class StickRange(NamedTuple):
    """Where a stick's values begin and end."""

    low: int
    high: int


class Gamepad:
    """The state of a gamepad from its events, at times of the monotonic clock [s]."""

    def __init__(self, ranges: Mapping[int, StickRange]) -> None:
        self._ranges = ranges
        self._at: dict[int, float] = {}
        self._shoulders: set[int] = set()
        self._heard = 0.0
        self.moving = False
        """Whether it is what moves the robot."""
        self.keys: list[str] = []
        """What has been pressed beside it, as keys of the pendant's: a space, + or -."""

    def apply(self, event: PadEvent, now: float) -> None:
        """Take in an event."""
        self._heard = now
        match event.type, event.code:
            case EventType.SYN, Code.SYN_DROPPED:
                self.let_go()  # the kernel had no room: what was pressed or let go meanwhile is not known
            case EventType.KEY, Button.TL | Button.TR:
                (self._shoulders.add if event.value else self._shoulders.discard)(event.code)
            case EventType.KEY, Button.EAST if event.value == 1:
                self.keys.append(" ")
            case EventType.ABS, Code.HAT_Y if event.value:
                self.keys.append("+" if event.value < 0 else "-")
            case EventType.ABS, Code.X | Code.Y | Code.RX:
                self._at[event.code] = self._share(event.code, event.value)

    def let_go(self) -> None:
        """Forget that a shoulder button is held: it must be pressed anew."""
        self._shoulders.clear()

    def direction(self, now: float) -> tuple[float, float, float] | None:
        """Return what the hand wants along x, y and φ, -1 to 1 each; None without a shoulder button, or with no stick.

        Right is x, away from the hand is y, the right stick to the left is φ, counterclockwise.
        """
        if not self._shoulders or now - self._heard > QUIET:
            return None
        x, y, turn = (self._at.get(code, 0.0) for code in (Code.X, Code.Y, Code.RX))
        return (x, -y, -turn) if x or y or turn else None

    def _share(self, code: int, value: int) -> float:
        """Return how far a stick is from its middle, -1 to 1, but for the dead part of its way."""
        low, high = self._ranges[code]
        share = (2.0 * value - low - high) / (high - low)
        beyond = min(max(0.0, abs(share) - DEAD) / (1.0 - DEAD), 1.0)
        return beyond if share > 0.0 else -beyond


class Pad:
    """An open gamepad. `close`, or the context's end, lets go of the device."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self.name = str(device.name)
        ranges = {code: StickRange(found.min, found.max) for code, found in device.capabilities()[EventType.ABS]}
        self.gamepad = Gamepad({code: found for code, found in ranges.items() if found.low < found.high})

    @classmethod
    def first(cls) -> Self:
        """Open the first gamepad that there is. Raises ServiceError where none is, or may be read."""
        try:
            import evdev
        except ImportError as error:
            raise ServiceError("a gamepad needs evdev: pip install 'trirail[gamepad]'") from error
        for path in evdev.list_devices():
            with contextlib.suppress(OSError):  # it has just been unplugged
                device = evdev.InputDevice(path)
                if is_gamepad(device.capabilities(absinfo=False)):
                    return cls(device)
                device.close()
        raise ServiceError("no gamepad found: plug one in; to read /dev/input takes a seat, or the group input")

    def fileno(self) -> int:
        """For select and its like."""
        return int(self._device.fileno())

    def poll(self, now: float) -> None:
        """Take in what it says. Raises ServiceError where it is gone."""
        try:
            for event in self._device.read():
                self.gamepad.apply(event, now)
        except BlockingIOError:
            return
        except OSError as error:
            raise ServiceError(f"the gamepad {self.name} is gone: the robot brakes") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._device.close()


def is_gamepad(capabilities: Mapping[int, Iterable[int]]) -> bool:
    """Whether a device with these codes by type is a gamepad with what is needed here."""
    buttons, sticks = (set(capabilities.get(kind, ())) for kind in (EventType.KEY, EventType.ABS))
    return {Button.SOUTH, Button.TL} <= buttons and {Code.X, Code.Y, Code.RX} <= sticks
