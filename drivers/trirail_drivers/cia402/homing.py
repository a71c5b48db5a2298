"""Homing of CiA 402 drives within the cycle, in homing mode (CiA 402-2, mode 6).

The drives are homed one after the other, while the other drives hold their positions in their setpoint mode. Each of
the three sliders moves the platform, and before homing the pose of the platform is unknown. If only one slider moves,
slowly, the platform follows a path that a person can foresee and watch. A wrong direction or a missing switch then
affects only one slider, and the two drives that hold their positions report a following error if the platform jams. If
all three sliders moved, the platform could go anywhere, and jam unnoticed.

The home offset 607Ch is set to 0, since manufacturers use different signs for it. The slider position at home is the
`offset` of [drives.X].
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from struct import Struct
from typing import Final

from trirail_drivers import config
from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.process_data import INTERPOLATED_POSITION
from trirail_drivers.interface import DriveFault, PowerState

HOMING = 6
_MODE, _MODE_DISPLAY, _STATUSWORD = 0x6060, 0x6061, 0x6041

FRESH_ANSWERS: Final = 4
"""Number of answers to SYNCs to wait for after homing. The next position is certain to be relative to home.

One answer may still be waiting for the bus, and one may be assigned to the wrong SYNC.
"""
SETPOINT_SYNCS: Final = 2
"""Number of SYNCs after which a drive has applied a written setpoint."""

HOME_IN_PLACE: Final = (35, 37)
"""Homing methods with which the present position becomes home (CiA 402-2)."""

_SDO: Final = Struct("<BHB4s")
_WRITE_BYTE: Final = 0x2F
_READ: Final = 0x40
_ABORTED: Final = 0x80
"""SDO commands: expedited download of one byte, upload, abort (CiA 301)."""

_TARGET_REACHED: Final = 1 << 10
_HOMING_ATTAINED: Final = 1 << 12
_ATTAINED: Final = _HOMING_ATTAINED | _TARGET_REACHED
_ERROR: Final = 1 << 13
"""Statusword bits in homing mode. In other modes, these bits have other meanings."""

Steps = Generator[None, None, None]
"""Sequence of steps, one of which is taken in each cycle."""


class HomingFailedError(Exception):
    """Homing has failed; the text states the reason."""


class HomingSequence:
    """Homing of the drives that have a homing method. Each call of `step` advances the homing by one step."""

    def __init__(self, axes: tuple[Cia402Axis, ...], drives: config.Drives, send: Callable[[Frame], object]) -> None:
        self._plan = [
            (axis, drive.homing) for axis, drive in zip(axes, drives.each, strict=True) if drive.homing is not None
        ]
        self._sdo_timeout = drives.sdo_timeout
        self._stop_timeout = drives.stop_timeout
        self._send = send
        self._steps: Steps | None = None
        self._axis: Cia402Axis | None = None
        self._stopping = False
        self._now = 0.0
        self.under_way = False
        """Whether drives are being homed."""
        self.restoring = False
        """Whether drives are being switched back to their setpoint mode before they get power."""
        self._forget_homes()

    def start(self) -> None:
        """Begin to home all powered drives that have a homing method. Until its homing is complete, a drive does not
        count as homed.
        """
        self._forget_homes()
        self.under_way, self._stopping = True, False
        self._steps = self._home_all()

    def stop(self) -> None:
        """Halt the moving drive, switch it back to its setpoint mode, and home no further drive."""
        self._stopping = True

    def restore(self) -> None:
        """Switch the drives that a quick stop left in homing mode back to their setpoint mode."""
        if not all(axis.cyclic for axis, _ in self._plan):
            self.restoring = True
            self._steps = self._restore_all()

    def abandon(self) -> None:
        """Abort the sequence, because the drives are losing power."""
        self._end()
        for axis, _ in self._plan:
            axis.mode_bits = 0
            axis.held = axis.sdo_asked = None  # nothing else is requested while an answer is awaited

    @property
    def idle(self) -> bool:
        """Whether no sequence is in progress."""
        return self._steps is None

    def step(self, now: float) -> DriveFault | None:
        """Take the next step, after the frames of a cycle have been handled; return a fault if homing fails."""
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
        for axis, homing in self._plan:
            if not self._stopping and not axis.left_out:
                self._axis = axis
                yield from self._home(axis, homing)

    def _restore_all(self) -> Steps:
        for axis, _ in self._plan:
            self._axis = axis
            yield from self._follow_setpoints(axis)

    def _home(self, axis: Cia402Axis, homing: config.Homing) -> Steps:
        axis.cyclic = False
        if axis.exchange.mode == INTERPOLATED_POSITION:
            # Bit 4 of the controlword, which enables interpolation, starts homing in mode 6. The drive must have
            # received a controlword without this bit before its mode changes.
            axis.follows = False
            yield from self._wait_for_syncs(axis)
        yield from self._change_mode(axis, HOMING)
        axis.follows = False
        result = _Result((yield from self._read_statusword(axis)))
        started = axis.sampled + FRESH_ANSWERS

        def in_place() -> bool:
            # Homing in place may end before any statusword shows it. At home, the drive counts from 0.
            return homing.method in HOME_IN_PLACE and axis.sampled >= started and abs(axis.actual) <= axis.still

        attained = False
        if self._stopping:
            yield from self._halt(axis)
        else:
            axis.mode_bits = canopen_frames.HOMING_START
            deadline = self._now + homing.timeout
            while not (self._stopping or attained):
                if self._now >= deadline:
                    raise HomingFailedError(f"home was not reached within {homing.timeout:g} s")
                yield
                if result.differs_from(axis.statusword) or in_place():
                    result.update((yield from self._read_statusword(axis)))
                    attained = result.attained(seen=in_place())
            if not attained:
                result.update((yield from self._halt(axis)))
                attained = result.attained(seen=in_place())
        axis.mode_bits = 0
        yield from self._follow_setpoints(axis)
        axis.homed = attained

    def _halt(self, axis: Cia402Axis) -> Generator[None, None, int]:
        """Halt the drive; return its statusword at standstill."""
        axis.mode_bits = canopen_frames.HALT
        deadline = self._now + self._stop_timeout
        yield from self._wait_for_answers(axis)
        while not (statusword := (yield from self._read_statusword(axis))) & _TARGET_REACHED:
            if self._now >= deadline:
                raise HomingFailedError(f"the slider did not stop within {self._stop_timeout:g} s")
            yield
        return statusword

    def _follow_setpoints(self, axis: Cia402Axis) -> Steps:
        """Switch back to the setpoint mode once the drive's setpoint equals its actual position."""
        yield from self._wait_for_answers(axis)
        standing = axis.actual
        yield
        # The control loop has received this position. From now on it sends this position, as this sequence did before.
        axis.held = standing
        axis.follows = True
        yield from self._wait_for_syncs(axis)
        yield from self._change_mode(axis, axis.exchange.mode)
        if axis.exchange.tells_following:
            # A statusword of homing mode, in which bit 12 has another meaning, may be the newest, or may still arrive.
            # Thus bit 12 counts as set only if both ways show it; otherwise the drive has FOLLOW_TIME to set it.
            shown = axis.statusword
            shown &= yield from self._read_statusword(axis)
            axis.statusword &= shown | ~canopen_frames.FOLLOWS_SETPOINTS
        axis.cyclic = True
        axis.held = None

    def _change_mode(self, axis: Cia402Axis, mode: int) -> Steps:
        yield from self._sdo(axis, _WRITE_BYTE, _MODE, mode)
        deadline = self._now + self._sdo_timeout
        while (shown := (yield from self._sdo(axis, _READ, _MODE_DISPLAY))[4]) != mode:
            if not axis.mode.shown and axis.state is not PowerState.OPERATION_ENABLED:
                return  # the drive shows its mode only with power
            if self._now >= deadline:
                raise HomingFailedError(f"object 6061:00 (Modes of operation display): expected {mode}, found {shown}")

    def _read_statusword(self, axis: Cia402Axis) -> Generator[None, None, int]:
        """Read the statusword by SDO, in the mode that `_change_mode` has confirmed.

        A statusword that is received by PDO may have been sent before, in another mode, in which its bits have other
        meanings. SDO answers are never late: the drive sends them in the order of the requests.
        """
        answer = yield from self._sdo(axis, _READ, _STATUSWORD)
        return int.from_bytes(answer[4:6], "little")

    def _sdo(self, axis: Cia402Axis, command: int, index: int, value: int = 0) -> Generator[None, None, bytes]:
        """Perform one SDO transfer over several cycles, without blocking; return the answer.

        An SDO server handles one request at a time (CiA 301), so an earlier request of the cycle is answered first.
        """
        while not axis.accepts_request(self._now):
            yield
        axis.sdo_answer, axis.sdo_asked = None, index.to_bytes(2, "little")
        request = _SDO.pack(command, index, 0, bytes([value]))
        if self._send(Frame(canopen_frames.SDO_REQUEST + axis.node, request)):
            axis.note_request(self._now, request)
        deadline = self._now + self._sdo_timeout
        while (answer := axis.sdo_answer) is None:
            if self._now >= deadline:
                axis.sdo_asked = None
                raise HomingFailedError(f"no answer for object {index:04X}:00 within {self._sdo_timeout:g} s")
            yield
        if answer[0] == _ABORTED:
            code = int.from_bytes(answer[4:], "little")
            raise HomingFailedError(f"object {index:04X}:00 was refused (SDO abort {code:08X})")
        return answer

    def _wait_for_syncs(self, axis: Cia402Axis) -> Steps:
        """Wait until the drive has applied the setpoint and the controlword that are written next."""
        applied = axis.syncs + SETPOINT_SYNCS
        yield from self._wait_until(lambda: axis.syncs >= applied, self._sdo_timeout, "no SYNC was sent")

    def _wait_for_answers(self, axis: Cia402Axis) -> Steps:
        """Wait until the drive's position is certain to be newer than the last step."""
        answered = axis.sampled + FRESH_ANSWERS
        yield from self._wait_until(
            lambda: axis.sampled >= answered, self._sdo_timeout, "the drive sent no new position"
        )

    def _wait_until(self, reached: Callable[[], bool], seconds: float, otherwise: str) -> Steps:
        deadline = self._now + seconds
        while not reached():
            if self._now >= deadline:
                raise HomingFailedError(f"{otherwise} within {seconds:g} s")
            yield


class _Result:
    """Result of one homing, shown by the statuswords that the drive has sent in homing mode.

    Bits 12 and 13 may still be set from an earlier homing, so they must have been clear since this homing began.
    """

    def __init__(self, statusword: int) -> None:
        """`statusword` is that before the start."""
        self._statusword, self._seen_clear = statusword, ~statusword

    def update(self, statusword: int) -> None:
        """Handle a later statusword. Raises HomingFailedError if it shows an error."""
        self._statusword = statusword
        self._seen_clear |= ~statusword
        if statusword & self._seen_clear & _ERROR:
            raise HomingFailedError(f"the drive reports a homing error (statusword {statusword:04X})")

    def differs_from(self, statusword: int) -> bool:
        """Whether a statusword of uncertain mode may show another result, so that it must be read by SDO."""
        return bool((statusword ^ self._statusword) & (_ATTAINED | _ERROR))

    def attained(self, *, seen: bool) -> bool:
        """Whether the drive has found home.

        Bit 12 need not have been clear if the result of this homing has been `seen` otherwise.
        """
        return self._statusword & _ATTAINED == _ATTAINED and (seen or bool(self._seen_clear & _HOMING_ATTAINED))
