"""Cycle that runs the drives during a commissioning, can enable a single drive, and stops all drives on a problem."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Final, NamedTuple, NoReturn

import numpy as np
from trirail_drivers.interface import NAMES, DriveGroup, Feedback, PowerState, Triple

from trirail.commissioning.moves import MAX_VELOCITY, SlowMove
from trirail.config import Config
from trirail.kinematics.arrays import Array
from trirail.quantities import apart_from_limit

MAX_FOLLOWING_ERROR_M: Final = 0.0003
"""Following error of a powered slider above which all drives are stopped [m].

At 5 mm/s, a drive without velocity feed-forward and with a position-loop gain of 20 /s lags by 0.25 mm."""
SETTLE_TIME_S: Final = 0.3
"""Time within which a slider settles after a motion [s]."""
MAX_STOP_TRAVEL_M: Final = 0.001
"""Travel during a stop, beyond that of the quick-stop ramp, above which the power is cut [m].

A motor with wrong phases, or one that counts against its encoder, cannot brake by a ramp."""
INTERRUPTED: Final = "stopped by Ctrl-C"
REST_CHECK_S: Final = 0.05
"""Time for which the sliders are observed before power is applied [s]."""
RESET_TIMEOUT_S: Final = 1.0
"""Time within which a fault must clear after a reset [s]."""
SETUP_TIMEOUT_S: Final = 10.0
"""Longest wait for drives that are configured again after a fault [s]."""
FEEDBACK_DELAY_CYCLES: Final = 2
"""Number of SYNCs from a written setpoint to the first position that shows its effect.

The drive applies the setpoint at the first SYNC, and samples the position at the second."""

_HISTORY_CYCLES: Final = FEEDBACK_DELAY_CYCLES + 8
_POWERED_STATES: Final = (
    PowerState.SWITCHED_ON,
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP_ACTIVE,
    PowerState.FAULT_REACTION_ACTIVE,
)
_ZERO_VELOCITY: Final = (0.0, 0.0, 0.0)


class DrivesStoppedError(Exception):
    """Error raised after all drives were stopped and their power was switched off.

    The text contains the reason, and names the drives that have kept their power.
    """


class FollowingStopError(DrivesStoppedError):
    """Error raised if only a following error stopped the drives, which have no fault and no power."""


class MeasuredMotion(NamedTuple):
    """Feedback of the drives during a motion."""

    position: Array
    """Measured slider positions, with one row for each cycle, (N, 3) [m]."""
    following_error: tuple[float, float, float]
    """Maximum following error of each slider [m]."""


class WatchdogReaction(NamedTuple):
    """Reaction of a powered drive to missing SYNCs and heartbeats."""

    seconds: float | None
    """Time until the drive reported a state without power [s]; None if it kept its power."""
    message: str
    """Fault message of this drive; its state if it reported no fault."""
    code: int = 0
    """EMCY error code; 0 if there is no code."""


class Bench:
    """Runner of the drives' cycle. A problem while a drive has power stops all drives in the same cycle."""

    def __init__(
        self,
        config: Config,
        drives: DriveGroup,
        tick: Callable[[], int],
        interrupted: Callable[[], bool],
    ) -> None:
        """Create a bench for drives that have been configured.

        Parameters
        ----------
        tick
            Function that waits for the next cycle and returns the number of missed cycles.
        interrupted
            Function that returns True after Ctrl-C was pressed.
        """
        self.config = config
        self.period = config.period
        self._labels = config.geometry.labels
        self.missed_cycles = 0
        """Number of cycles missed while a drive had power."""
        self.max_errors = [0.0, 0.0, 0.0]
        """Maximum following error of each slider since power was applied [m]."""
        self._drives = drives
        self._tick = tick
        self._interrupted = interrupted
        self._powered: tuple[int, ...] = ()
        self._target = [0.0, 0.0, 0.0]
        self._setpoints: deque[tuple[float, ...]] = deque(maxlen=_HISTORY_CYCLES)
        self.feedback = drives.read()

    @property
    def position(self) -> Triple:
        """Measured slider positions [m]."""
        return self.feedback.position

    @property
    def power_warning(self) -> str:
        """Warning that names the drives that have power, for when no drive may have power; "" if no drive has power."""
        states, fault = self.feedback.state, self.feedback.fault
        powered = {name for name, state in zip(NAMES, states, strict=True) if state in _POWERED_STATES}
        if fault is not None and fault.cause == "timeout":
            powered.add(fault.drive)
        return f"drive {', '.join(sorted(powered))} STILL HAS POWER: press the emergency stop" if powered else ""

    def check_without_power(self) -> None:
        """Raise DrivesStoppedError if a drive has a fault, or has power."""
        if problem := self._describe():
            raise DrivesStoppedError(problem)

    def check_homed(self) -> None:
        """Raise DrivesStoppedError if the position of a drive is unknown because the drive is not homed."""
        for name, drive, homed in zip(NAMES, self.config.drives.each, self.feedback.homed, strict=True):
            if not homed:
                remedy = "repeat the set-up to accept its position" if drive.homing is None else "repeat its home step"
                raise DrivesStoppedError(f"drive {name} is not homed: {remedy}")

    def cycle(self, rates: Triple = _ZERO_VELOCITY) -> Feedback:
        """Run one cycle; send their target positions and the target velocities `rates` [m/s] to powered drives.

        Raises
        ------
        DrivesStoppedError
            If there is a problem while a drive has power.
        KeyboardInterrupt
            If Ctrl-C was pressed; all drives are first stopped.
        """
        missed = self._tick()
        self._drives.sync()
        self.feedback = feedback = self._drives.read()
        if not self._powered:
            if self._interrupted():
                raise KeyboardInterrupt
            self._drives.write(feedback.position, _ZERO_VELOCITY)
            return feedback
        self.missed_cycles += missed
        if reason := self._check(feedback, missed):
            self._stop_and_raise(reason)
        if reason := self._check_following(feedback):
            self._stop_and_raise(reason, FollowingStopError)
        for index, position in enumerate(feedback.position):
            # Until a drive follows setpoints, its measured position is its target, so that enabling causes no jump.
            if index not in self._powered or not feedback.follows[index]:
                self._target[index] = position
        a, b, c = self._target
        self._drives.write((a, b, c), rates)
        self._setpoints.append((a, b, c))
        return feedback

    def wait(self, seconds: float) -> Feedback:
        """Run cycles for `seconds` [s]; return the last feedback."""
        for _ in range(max(1, round(seconds / self.period))):
            self.cycle()
        return self.feedback

    @contextmanager
    def power(self, alone: str | None = None) -> Iterator[None]:
        """Enable all drives, or only the drive named `alone`; disable them when the context ends.

        Raises
        ------
        DrivesStoppedError
            If a slider moves before power is applied, if a drive is not enabled within `watchdogs.enable_timeout`, if
            the drives report a fault, or if a drive has power before it is enabled or after it is disabled. Also if
            `alone` is None and a drive is not homed.
        """
        self.max_errors = [0.0, 0.0, 0.0]
        self.clear_fault()
        if alone is None:
            self.check_homed()
        before = self.feedback.position
        for name, was, now in zip(self._labels, before, self.wait(REST_CHECK_S).position, strict=True):
            if abs(now - was) > MAX_FOLLOWING_ERROR_M / 3.0:
                raise DrivesStoppedError(
                    f"slider {name}: moved {(now - was) * 1e3:.3f} mm without power; keep hands off and try again"
                )
        self.check_without_power()
        self._powered = tuple(range(len(NAMES))) if alone is None else (NAMES.index(alone),)
        self._target = list(self.feedback.position)
        self._setpoints.extend([self.feedback.position] * _HISTORY_CYCLES)
        self._drives.enable(alone)
        try:
            for _ in range(round(self.config.watchdogs.enable_timeout / self.period)):
                if self._has_power(self.cycle()):
                    break
            else:
                states = ", ".join(f"{NAMES[index]} {self.feedback.state[index]}" for index in self._powered)
                timeout = self.config.watchdogs.enable_timeout
                self._stop_and_raise(f"no power within watchdogs.enable_timeout = {timeout:g} s: {states}")
            yield
        except BaseException:
            if self._powered:
                self._stop()
            raise
        if not self._powered:
            return
        self._drives.disable()
        self._wait_without_power()
        self.check_without_power()

    def prepare_hands_on(self) -> None:
        """Reset a fault, and check that a person may touch the sliders, as `check_hands_on` does.

        A fault may persist: with a pressed emergency stop, some drives report one.
        """
        with suppress(DrivesStoppedError):
            self.clear_fault()
        self.wait(REST_CHECK_S)
        self.check_hands_on()

    def check_hands_on(self) -> None:
        """Raise DrivesStoppedError if a drive has power, or does not answer."""
        if self.power_warning or any(self.feedback.unready):
            raise DrivesStoppedError(self._describe())

    def play(self, move: SlowMove) -> MeasuredMotion:
        """Move the powered sliders from their targets along `move`, and wait until they have settled."""
        start = tuple(self._target)
        measured = []
        for offset, rate in zip(move.position.tolist(), move.velocity.tolist(), strict=True):
            self._target = [position + by for position, by in zip(start, offset, strict=True)]
            a, b, c = rate
            measured.append(self.cycle((a, b, c)).position)
        measured += [self.cycle().position for _ in range(round(SETTLE_TIME_S / self.period))]
        a, b, c = self.max_errors
        return MeasuredMotion(np.array(measured), (a, b, c))

    def home(self, timeout: float) -> None:
        """Home the powered drive. Raises DrivesStoppedError if the drive is not homed within `timeout` [s]."""
        self._drives.home()
        for _ in range(round(timeout / self.period)):
            self.cycle()
            if not self.feedback.homing and all(self.feedback.homed[index] for index in self._powered):
                return
        self._stop_and_raise(f"not homed within {timeout:g} s")

    def provoke_watchdog(self, seconds: float) -> WatchdogReaction:
        """Send neither SYNC nor heartbeat until the powered drive has no power, at most for `seconds` [s].

        Return the reaction. Afterwards, all drives are stopped. Raises DrivesStoppedError if the bus is lost.
        """
        (index,) = self._powered
        off_after: float | None = None
        for number in range(1, round(seconds / self.period) + 1):
            self._tick()
            # Until the end of the test, no command may remove the power that the drive must remove by itself.
            self.feedback = self._drives.observe()
            if self._interrupted():
                self._stop_and_raise(INTERRUPTED)
            if self.feedback.fault is not None:
                self._stop_and_raise(self.feedback.fault.message)
            if self.feedback.state[index] not in _POWERED_STATES:
                off_after = number * self.period
                break
        state, fault = self.feedback.state[index], self._drives.read().fault
        own = self._drives.reported_faults[index] or fault
        self._stop()
        if own is None or own.drive != NAMES[index]:
            return WatchdogReaction(off_after, str(state))
        return WatchdogReaction(off_after, own.message, own.code)

    def clear_fault(self) -> None:
        """Reset a fault, if there is one. Raises DrivesStoppedError if the fault persists."""
        if self.feedback.fault is None:
            return
        self.wait(self.config.drives.heartbeat)  # a drive shows by its heartbeat that it is not in NMT operational
        for _ in range(round(SETUP_TIMEOUT_S / self.period)):
            if not any(self.cycle().unready):
                break
        self._drives.reset()
        if self.wait(RESET_TIMEOUT_S).fault is not None:
            problem = self._describe()
            raise DrivesStoppedError(f"the fault cannot be reset: {problem}")

    def _has_power(self, feedback: Feedback) -> bool:
        return all(feedback.state[index] is PowerState.OPERATION_ENABLED for index in self._powered)

    def _check(self, feedback: Feedback, missed: int) -> str:
        """Return the reason why the drives must be stopped; "" if there is no problem."""
        if feedback.fault is not None:
            return feedback.fault.message
        if self._interrupted():
            return INTERRUPTED
        if missed > self.config.watchdogs.max_overruns:
            return f"{missed} cycles missed in a row: the machine is too busy; see trirail doctor"
        for index, name in enumerate(NAMES):
            if index not in self._powered and feedback.state[index] is PowerState.OPERATION_ENABLED:
                return f"drive {name}: enabled, although this step leaves it without power"
        return ""

    def _check_following(self, feedback: Feedback) -> str:
        """Return the reason why the drives must be stopped if a powered slider does not follow its setpoints, or ""."""
        for index in self._powered:
            if feedback.state[index] is PowerState.OPERATION_ENABLED and feedback.follows[index]:
                # Compare an old position with the setpoint that was in effect when the position was sampled.
                sent = self._setpoints[-FEEDBACK_DELAY_CYCLES - min(feedback.age[index], 7)]
                error = sent[index] - feedback.position[index]
                self.max_errors[index] = max(self.max_errors[index], abs(error))
                if not abs(error) <= MAX_FOLLOWING_ERROR_M:  # also true if the error is NaN
                    slider = f"slider {self._labels[index]}"
                    shown, most = apart_from_limit(error, MAX_FOLLOWING_ERROR_M, "m")
                    return f"{slider}: following error {shown} exceeds the limit of {most}"
        return ""

    def _describe(self, reason: str = "") -> str:
        """Return a reason, the fault of the drives, and the warning of drives with power, as one line."""
        fault, unready = self.feedback.fault, filter(None, self.feedback.unready)
        texts = reason, "" if fault is None else fault.message, *map(str, unready), self.power_warning
        return "; ".join(dict.fromkeys(text for text in texts if text))

    def _stop_and_raise(self, reason: str, error: type[DrivesStoppedError] = DrivesStoppedError) -> NoReturn:
        """Stop all drives; raise `error`, or a plain DrivesStoppedError if a drive has a fault or still has power."""
        reason += self._stop()
        described = self._describe(reason)
        if self._interrupted():
            raise KeyboardInterrupt(described)
        raise (error if described == reason else DrivesStoppedError)(described)

    def _stop(self) -> str:
        """Stop all drives by their ramps; cut the power if a slider runs on. Return its travel in words, or ""."""
        speed = MAX_VELOCITY
        if self.feedback.homing:
            homing = [self.config.drives.each[index].homing for index in self._powered]
            speed = max([speed, *(max(each.speed_switch, each.speed_zero) for each in homing if each is not None)])
        ramp = speed**2 / (2.0 * self.config.drives.quick_stop_deceleration)
        start = self.feedback.position
        self._drives.quick_stop()
        if self._wait_without_power(MAX_STOP_TRAVEL_M + ramp):
            return ""
        travels = [(now - was) * 1e3 for now, was in zip(self.feedback.position, start, strict=True)]
        self._drives.disable()
        self._wait_without_power()
        travel, label = max(zip(travels, self._labels, strict=True), key=lambda each: abs(each[0]))
        return f"; slider {label}: ran on by {travel:.3f} mm, so all power was cut"

    def _wait_without_power(self, max_travel: float = math.inf) -> bool:
        """Run cycles until no drive has power, at most for `drives.stop_timeout` plus SETTLE_TIME_S.

        Return False as soon as a slider has moved more than `max_travel` [m].
        """
        self._powered = ()
        start = self.feedback.position
        for _ in range(round((self.config.drives.stop_timeout + SETTLE_TIME_S) / self.period)):
            self._tick()
            self._drives.sync()
            self.feedback = self._drives.read()
            self._drives.write(self.feedback.position, _ZERO_VELOCITY)
            if not any(state in _POWERED_STATES for state in self.feedback.state):
                break
            if any(abs(now - was) > max_travel for now, was in zip(self.feedback.position, start, strict=True)):
                return False
        return True
