"""Homing of CiA 402 drives, from within the cycle: homing mode (CiA 402-2, mode 6).

One drive after the other, while the others hold their positions in the mode that they follow setpoints in. The three
sliders together place the platform, so each of them moves it, and before homing nobody knows where it is. With one
slider moving, slowly, the platform follows it alone, on a path that a person can foresee and watch; a wrong
direction or a missing switch moves one slider; and the two that hold report a following error when the platform is
jammed. With all three at once the platform would go where three unknown distances take it, and jam unnoticed.

The home offset 607Ch is 0: makers differ in its sign. The position at home is the `offset` of [drives.X].
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from struct import Struct
from typing import Final

from trirail_drivers import config
from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.interface import DriveFault, PowerState

HOMING = 6
_MODE, _MODE_DISPLAY, _STATUSWORD = 0x6060, 0x6061, 0x6041

FRESH: Final = 4
"""So many answers to SYNCs after homing, a position is surely counted from home: one is on its way, and one may be
taken for its neighbour."""
TAKEN_UP: Final = 2
"""So many SYNCs after it was written, a setpoint has been taken up."""

_SDO: Final = Struct("<BHB4s")
_WRITE_BYTE: Final = 0x2F
_READ: Final = 0x40
_ABORTED: Final = 0x80
"""SDO commands: expedited download of one byte, upload, abort (CiA 301)."""

_REACHED: Final = 1 << 10
_ATTAINED: Final = 1 << 12
_ERROR: Final = 1 << 13
"""Statusword bits in homing mode; in other modes they mean other things."""

Steps = Generator[None, None, None]
"""What is to be done, a cycle at each yield."""


class HomingFailedError(Exception):
    """Homing cannot go on; the text says why."""


class HomingSequence:
    """Homes the drives that have a homing method, one step at each `step`."""

    def __init__(self, axes: tuple[Cia402Axis, ...], drives: config.Drives, send: Callable[[Frame], object]) -> None:
        self._plan = [
            (axis, drive.homing.timeout)
            for axis, drive in zip(axes, drives.each, strict=True)
            if drive.homing is not None
        ]
        self._sdo_timeout = drives.sdo_timeout
        self._stop_timeout = drives.stop_timeout
        self._send = send
        self._steps: Steps | None = None
        self._axis: Cia402Axis | None = None
        self._stopping = False
        self._now = 0.0
        self.under_way = False
        """Drives are being homed."""
        self.restoring = False
        """Drives are being brought back to following setpoints, before they get power."""
        self._forget_homes()

    def start(self) -> None:
        """Begin to home all drives with a homing method and power; until each is done it does not count as homed."""
        self._forget_homes()
        self.under_way, self._stopping = True, False
        self._steps = self._home_all()

    def stop(self) -> None:
        """Halt the drive that moves and bring it back to following setpoints; home no other."""
        self._stopping = True

    def restore(self) -> None:
        """Bring drives that a quick stop left in homing mode back to following setpoints."""
        if not all(axis.cyclic for axis, _ in self._plan):
            self.restoring = True
            self._steps = self._restore_all()

    def abandon(self) -> None:
        """Leave it as it is: the drives are losing their power."""
        self._end()
        for axis, _ in self._plan:
            axis.mode_bits = 0
            axis.held = None

    @property
    def idle(self) -> bool:
        """Whether there is nothing to be done, cycle by cycle."""
        return self._steps is None

    def step(self, now: float) -> DriveFault | None:
        """Go on, when every frame of this cycle is in; return why that is impossible."""
        self._now = now
        axis = self._axis
        if self._steps is None:
            return None
        if axis is not None and not axis.follows:
            axis.held = axis.actual
        try:
            next(self._steps)
        except StopIteration:
            self._end()
        except HomingFailedError as failure:
            self._end()
            name = self._axis.name if self._axis is not None else ""
            return DriveFault(name, "homing", 0, f"drive {name}: homing: {failure}")
        return None

    def _end(self) -> None:
        self._steps = None
        self.under_way = self.restoring = False

    def _forget_homes(self) -> None:
        for axis, _ in self._plan:
            axis.homed = axis.homed and axis.left_out

    def _home_all(self) -> Steps:
        for axis, timeout in self._plan:
            if not self._stopping and not axis.left_out:
                self._axis = axis
                yield from self._home(axis, timeout)

    def _restore_all(self) -> Steps:
        for axis, _ in self._plan:
            self._axis = axis
            yield from self._follow_setpoints(axis)

    def _home(self, axis: Cia402Axis, timeout: float) -> Steps:
        axis.cyclic = False
        yield from self._change_mode(axis, HOMING)
        axis.follows = False
        # The newest statusword may be from before, and its bits mean other things in other modes.
        yield from self._sdo(axis, _READ, _STATUSWORD)
        axis.seen_clear = ~axis.statusword
        if not self._stopping:
            axis.mode_bits = canopen_frames.HOMING_START
            yield from self._until(lambda: self._stopping or _attained(axis), timeout, "home was not attained")
        attained = _attained(axis)
        if not attained:
            yield from self._halt(axis)
        axis.mode_bits = 0
        yield from self._follow_setpoints(axis)
        axis.homed = attained

    def _halt(self, axis: Cia402Axis) -> Steps:
        axis.mode_bits = canopen_frames.HALT
        answered = axis.sampled + FRESH
        yield from self._until(
            lambda: axis.sampled >= answered and bool(axis.statusword & _REACHED),
            self._stop_timeout,
            "the slider did not stand still",
        )

    def _follow_setpoints(self, axis: Cia402Axis) -> Steps:
        """Back to the mode of setpoints, when the drive's setpoint is where it stands."""
        answered = axis.sampled + FRESH
        yield from self._until(lambda: axis.sampled >= answered, self._sdo_timeout, "there was no new position")
        standing = axis.actual
        yield
        # Whoever gives setpoints has seen that position, and from now on holds it, as is done here meanwhile.
        axis.held = standing
        axis.follows = True
        taken_up = axis.syncs + TAKEN_UP
        yield from self._until(lambda: axis.syncs >= taken_up, self._sdo_timeout, "there was no SYNC")
        yield from self._change_mode(axis, axis.way.mode)
        axis.cyclic = True
        axis.held = None

    def _change_mode(self, axis: Cia402Axis, mode: int) -> Steps:
        yield from self._sdo(axis, _WRITE_BYTE, _MODE, mode)
        deadline = self._now + self._sdo_timeout
        while (found := (yield from self._sdo(axis, _READ, _MODE_DISPLAY))[4]) != mode:
            if found == 0 and not axis.mode.shown and axis.state is not PowerState.OPERATION_ENABLED:
                return  # it shows its mode with power
            if self._now >= deadline:
                raise HomingFailedError(f"object 6061:00 (Modes of operation display): wanted {mode}, found {found}")

    def _sdo(self, axis: Cia402Axis, command: int, index: int, value: int = 0) -> Generator[None, None, bytes]:
        """One SDO, without waiting: the cycle goes on, and a later one has the answer."""
        axis.sdo_answer, axis.sdo_asked = None, index.to_bytes(2, "little")
        self._send(Frame(canopen_frames.SDO_REQUEST + axis.node, _SDO.pack(command, index, 0, bytes([value]))))
        deadline = self._now + self._sdo_timeout
        while (answer := axis.sdo_answer) is None:
            if self._now >= deadline:
                axis.sdo_asked = None
                raise HomingFailedError(f"no answer about object {index:04X}:00 within {self._sdo_timeout:g} s")
            yield
        if answer[0] == _ABORTED:
            code = int.from_bytes(answer[4:], "little")
            raise HomingFailedError(f"object {index:04X}:00 was refused (SDO abort {code:08X})")
        return answer

    def _until(self, reached: Callable[[], bool], seconds: float, otherwise: str) -> Steps:
        deadline = self._now + seconds
        while not reached():
            if self._now >= deadline:
                raise HomingFailedError(f"{otherwise} within {seconds:g} s")
            yield


def _attained(axis: Cia402Axis) -> bool:
    """Whether home is attained: bit 12 may still be set by an earlier homing, so it must have been clear since."""
    if axis.statusword & _ERROR:
        raise HomingFailedError(f"the drive reports a homing error (statusword {axis.statusword:04X})")
    both = _ATTAINED | _REACHED
    return axis.statusword & both == both and bool(axis.seen_clear & _ATTAINED)
