"""`trirail jog` without arguments: a pendant in the terminal that moves the robot while a key is held."""

from __future__ import annotations

import math
import os
import re
import select
import signal
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Self

from rich.live import Live
from rich.text import Text

from trirail.cli import live, notation, terminal
from trirail.client.client import Robot
from trirail.client.goal import Velocity
from trirail.client.held_jog import SPEEDS, USUAL, HeldJog
from trirail.errors import ServiceError, TrirailError
from trirail.wire.goals import Tool
from trirail.wire.state import State
from trirail.wire.text import printable
from trirail.wire.vocabulary import Mode

_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
# An arrow key is sent as ESC [ A, in application mode as ESC O A, and with modifiers as ESC [ 1 ; 2 A.
_KEY = re.compile(r"\x1b[\[O](?P<parameters>[0-9;]*)(?P<final>[@-~])|(?P<escape>\x1b)|(?P<character>.)", re.DOTALL)

_BEGUN = re.compile(rb"\x1b([\[O][0-9;]*)?\Z")


def split(typed: bytes) -> tuple[bytes, bytes]:
    """Split the input into complete keys and an escape sequence at its end that is incomplete, as on a serial line."""
    begun = _BEGUN.search(typed)
    return (typed[: begun.start()], begun[0]) if begun is not None else (typed, b"")


def keys(typed: bytes) -> Iterator[str]:
    """Yield the keys in the input: up, down, left, right, escape, or a character in lower case; = counts as +.

    The escape sequences of other keys are skipped as a whole.
    """
    for match in _KEY.finditer(typed.decode("utf-8", errors="ignore")):
        if match["final"]:
            if arrow := _ARROWS.get(match["final"]):
                yield arrow
        elif match["escape"]:
            yield "escape"
        else:
            yield {"=": "+", "_": "-"}.get(match["character"], match["character"].lower())


KEY_TIMEOUT_S = 0.15
"""Time without a repeat after which a key counts as released [s]. A terminal does not report releases; it repeats a
held key every 30 to 50 ms, after a pause before the first repeat."""
REDRAW_S = 0.1
"""Interval at which the display is redrawn [s]."""
STALL_S = 0.5
"""Length of a pause in this program after which buffered keys are stale [s]. A stop is never stale."""
MAX_BUFFERED = 4096
"""Maximum number of bytes that the kernel buffers for a terminal."""
STATE_TIMEOUT_S = 1.0
"""Minimum time without a state after which the service counts as silent [s]."""
AXES = {"right": (1, 0, 0), "left": (-1, 0, 0), "up": (0, 1, 0), "down": (0, -1, 0), "a": (0, 0, 1), "d": (0, 0, -1)}
"""Directions along x, y and φ."""
HELP = "← → x   ↑ ↓ y   a d φ   + − speed   Space stop   q leave"
STOP_KEYS = (" ", "escape")
STOPPED = "stopped"


class Pendant:
    """Actions of keys: jog a tool while a key is held, choose the speed, stop.

    `top` is the platform's velocity limit.
    """

    def __init__(self, robot: Robot, top: Velocity, tool: Tool | None = None) -> None:
        self._robot = robot
        self._tool = tool
        self._top = top
        self._jog = HeldJog(robot.send, self._set_message)
        self._until = -math.inf
        self._choice = USUAL
        self.said = HELP
        """Last message for the operator, in one line."""
        self.over = False
        """Whether the operator has pressed the key that ends the pendant."""

    @property
    def speed(self) -> Velocity:
        """Velocity of a jog along each axis [m/s, m/s, rad/s]."""
        x, y, phi = (SPEEDS[self._choice] * top for top in self._top)
        return x, y, phi

    def press(self, key: str, now: float) -> None:
        """Handle a key that was pressed or that the terminal repeated; `now` is the time on the monotonic clock."""
        if key in AXES:
            self.hold(AXES[key], now)
            return
        self.release_key()
        if key in STOP_KEYS:
            threading.Thread(target=self._stop, name="stop", daemon=True).start()
        elif key in "+-":
            self._choice = min(max(self._choice + (1 if key == "+" else -1), 0), len(SPEEDS) - 1)
        elif key == "q":
            self.over = True

    def hold(self, direction: Sequence[float], now: float) -> None:
        """Jog along x, y and φ, each at a share of the speed, -1 to 1, until KEY_TIMEOUT_S has elapsed."""
        x, y, phi = (share * speed for share, speed in zip(direction, self.speed, strict=True))
        self._until = now + KEY_TIMEOUT_S
        self._jog.hold((x, y, phi), self._tool)

    def tick(self, now: float) -> None:
        """Release a key that was not repeated in time."""
        if now > self._until:
            self.release_key()

    def release_key(self) -> None:
        """Release the held key, if there is one."""
        if self._until > -math.inf:
            self._until = -math.inf
            self._jog.release()

    def close(self) -> None:
        """Release the held key, and ignore all later keys."""
        self._jog.close()

    def _stop(self) -> None:
        try:
            self._robot.stop()
            self._set_message(STOPPED)
        except TrirailError as error:
            self._set_message(str(error))

    def _set_message(self, words: str) -> None:
        self.said = words


class _StateReader:
    """Thread that reads the newest state until the context ends; `state` is None while the service is silent.

    The service counts as silent after `timeout` [s] without a state.
    """

    def __init__(self, robot: Robot, timeout: float) -> None:
        self.state: State | None = None
        self._robot = robot
        self._timeout = timeout
        self._over = False
        self._thread = threading.Thread(target=self._read_states, name="states", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        self._thread.join()

    def _read_states(self) -> None:
        while not self._over:
            for state in self._robot.states(self._timeout):
                if self._over:
                    return
                self.state = state
            self.state = None


def run(robot: Robot, tool: Tool | None = None) -> int:
    """Run the pendant until the operator leaves or the terminal closes; return the exit code.

    Keys move the `tool` or, if there is none, the platform's centre. Raises ServiceError if standard input is not a
    terminal that can show the pose, or the service does not answer.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty() and terminal.can_redraw()):
        raise ServiceError(
            "jogging with keys needs a terminal that shows the pose, which TERM=dumb does not; without such a "
            "terminal, use trirail jog VX VY W --seconds S"
        )
    info = robot.info()
    top = live.limits_of(info).platform.velocity
    pendant = Pendant(robot, top, tool)
    with _StateReader(robot, info.state_timeout(STATE_TIMEOUT_S)) as newest:
        try:
            with Live(console=terminal.out, auto_refresh=False, transient=True) as display, _raw(pendant):
                _serve(pendant, newest, display)
        except (KeyboardInterrupt, _TerminalClosed, OSError):
            pass  # OSError: the terminal has closed
        finally:
            pendant.close()
    return 0


def _serve(pendant: Pendant, newest: _StateReader, display: Live) -> None:
    descriptor = sys.stdin.fileno()
    drawn, last = -math.inf, time.monotonic()
    begun, mode = b"", None
    while not pendant.over:
        ready, _, _ = select.select([descriptor], [], [], KEY_TIMEOUT_S / 5.0)
        now = time.monotonic()
        stalled = now - last > STALL_S  # stopped and continued
        if stalled:
            pendant.release_key()
        typed, begun, more = begun, b"", b""  # if nothing follows, this is the key Escape
        if descriptor in ready:
            if not (more := os.read(descriptor, MAX_BUFFERED)):
                return  # the terminal is gone
            typed, begun = split(typed + more)
        for key in keys(typed):
            if not stalled or key in (*STOP_KEYS, "q"):
                pendant.press(key, now)
        pendant.tick(now)
        if not (stalled and len(more) > MAX_BUFFERED // 2):  # the kernel has more stale input
            last = now
        # Scroll Lock of a console suspends the output, in which writing would wait.
        if now - drawn > REDRAW_S and select.select([], [sys.stdout], [], 0.0)[1]:
            state, before = newest.state, mode
            mode = None if state is None else state.mode
            if mode == Mode.MOVING != before and pendant.said == STOPPED:
                pendant.said = HELP
            display.update(_shown(pendant, state), refresh=True)
            drawn = now


def _shown(pendant: Pendant, state: State | None) -> Text:
    x, _, phi = pendant.speed
    lines = ["no contact with the service" if state is None else f"{state.mode}, override {state.override:.0%}"]
    if state is not None:
        v_x, v_y, v_phi = state.velocity
        lines += [f"fault: {fault}" for fault in state.faults]
        lines.append(notation.measured_pose(state, 9))
        lines.append(f"  {v_x * 1e3:9.2f} mm/s   {v_y * 1e3:9.2f} mm/s   {math.degrees(v_phi):9.3f} °/s")
    lines.append(f"speed {x * 1e3:.3g} mm/s, {math.degrees(phi):.3g} °/s")
    lines.append(pendant.said)
    return Text("\n".join(map(printable, lines)), no_wrap=True, overflow="ellipsis")


class _TerminalClosed(Exception):
    """The terminal was closed, or the program was asked to exit."""


def _read_single_keys(descriptor: int) -> None:
    tty.setcbreak(descriptor, termios.TCSAFLUSH)
    attributes = termios.tcgetattr(descriptor)
    attributes[0] &= ~termios.IXON  # Ctrl-S would suspend the output
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)


@contextmanager
def _raw(pendant: Pendant) -> Iterator[None]:
    """Switch the terminal to unbuffered input without echo.

    When the program is suspended and when the context ends, the held key is released and the terminal is restored.
    """
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def hung_up(_number: int, _frame: FrameType | None) -> None:
        raise _TerminalClosed

    def suspended(number: int, _frame: FrameType | None) -> None:
        pendant.release_key()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)  # stops here until SIGCONT
        signal.signal(number, suspended)
        _read_single_keys(descriptor)

    handlers = dict.fromkeys((signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT), hung_up) | {signal.SIGTSTP: suspended}
    earlier = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    _read_single_keys(descriptor)
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)
        try:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
        except termios.error:
            return  # a closed terminal needs no restoring
