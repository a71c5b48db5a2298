"""The three drives under a guide's hands: a cycle that never ends, power for one drive alone, and what stops it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple

import numpy as np
from trirail_drivers.interface import NAMES, DriveGroup, Feedback, PowerState, Triple

from trirail.commissioning.moves import SlowMove
from trirail.config import Config
from trirail.kinematics.arrays import Array

FOLLOWING: Final = 0.0003
"""How far a powered slider may be from its setpoint before everything is stopped [m]: at 5 mm/s a drive without
velocity feed-forward and with a position loop of 20 /s lags 0.25 mm."""
SETTLE: Final = 0.3
"""How long a slider is given to come to rest after a motion [s]."""
INTERRUPTED: Final = "stopped by Ctrl-C"
LAST_WORDS: Final = 0.05
"""How long drives that missed the same heartbeat may take to tell of it, one after the other [s]."""
REST: Final = 0.05
"""How long a slider is looked at before it gets power [s]."""
RESET: Final = 1.0
"""How long a fault is given to be gone after a reset [s]."""
DELAY: Final = 2
"""SYNCs from writing a setpoint until a position is sampled that answers it: one takes it up, the next samples."""

_POWERED: Final = (
    PowerState.SWITCHED_ON,
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP_ACTIVE,
    PowerState.FAULT_REACTION_ACTIVE,
)
_OF_ITS_OWN: Final = ("emcy", "fault", "state")
"""Causes of faults that a drive has told of, rather than that it was not heard."""
_STILL: Final = (0.0, 0.0, 0.0)


class Stopped(Exception):
    """The drives were stopped, and are without power now; the text says why."""


class Travelled(NamedTuple):
    """What the drives said of a motion."""

    measured: Array
    """Positions, a row for each cycle, (N, 3) [m]."""
    following_error: tuple[float, float, float]
    """The greatest of each slider [m]."""


class Silence(NamedTuple):
    """What a powered drive did while it heard no SYNC."""

    seconds: float | None
    """When it let go by itself [s]; None where it did not."""
    by: str
    """The drive that spoke, "" where none did."""
    said: str
    """What it said of it, "" where it said nothing."""
    code: int = 0
    """The code that it said, as of an EMCY; 0 for none."""


class Bench:
    """Turns the drives' cycle. Whatever is wrong while a drive has power stops all of them in that same cycle."""

    def __init__(
        self,
        config: Config,
        drives: DriveGroup,
        tick: Callable[[], int],
        interrupted: Callable[[], bool],
    ) -> None:
        """`tick` waits for the next cycle and returns how many were missed; `interrupted` tells of Ctrl-C.

        The drives have been configured.
        """
        self.config = config
        self.period = config.period
        self._labels = config.geometry.labels
        self.missed = 0
        """Cycles missed while a drive had power."""
        self.worst = [0.0, 0.0, 0.0]
        """The greatest following errors since power was given [m]."""
        self._drives = drives
        self._tick = tick
        self._interrupted = interrupted
        self._powered: tuple[int, ...] = ()
        self._target = [0.0, 0.0, 0.0]
        self._written: deque[tuple[float, ...]] = deque(maxlen=DELAY + 8)
        self.feedback = drives.read()

    @property
    def position(self) -> Triple:
        """Where the drives say that the sliders are [m]."""
        return self.feedback.position

    def cycle(self, rates: Triple = _STILL) -> Feedback:
        """Turn one cycle; powered drives are held at their targets, of velocities `rates` [m/s].

        Raises Stopped; KeyboardInterrupt, once nothing has power, where that was asked for.
        """
        missed = self._tick()
        self._drives.sync()
        self.feedback = feedback = self._drives.read()
        if not self._powered:
            if self._interrupted():
                raise KeyboardInterrupt
            self._drives.write(feedback.position, _STILL)
            return feedback
        self.missed += missed
        if reason := self._wrong(feedback, missed):
            self._halt(reason)
        for index, place in enumerate(feedback.position):
            if index not in self._powered or not feedback.follows[index]:
                self._target[index] = place
        a, b, c = self._target
        self._drives.write((a, b, c), rates)
        self._written.append((a, b, c))
        return feedback

    def wait(self, seconds: float) -> Feedback:
        """Turn cycles for so long [s]."""
        for _ in range(max(1, round(seconds / self.period))):
            self.cycle()
        return self.feedback

    @contextmanager
    def power(self, alone: str | None = None) -> Iterator[None]:
        """Give all drives power, or one `alone`, and take it off at the end. Raises Stopped where they get none."""
        self.clear()
        before = self.feedback.position
        for name, was, now in zip(self._labels, before, self.wait(REST).position, strict=True):
            if abs(now - was) > FOLLOWING / 3.0:
                raise Stopped(
                    f"slider {name} is not at rest: it went {(now - was) * 1e3:.3f} mm by itself, or by a hand"
                )
        self._powered = tuple(range(len(NAMES))) if alone is None else (NAMES.index(alone),)
        self._target = list(self.feedback.position)
        self._written.extend([self.feedback.position] * (DELAY + 8))
        self.worst = [0.0, 0.0, 0.0]
        self._drives.enable(alone)
        try:
            for _ in range(round(self.config.watchdogs.enable_timeout / self.period)):
                if self._has_power(self.cycle()):
                    break
            else:
                states = ", ".join(f"{NAMES[index]} {self.feedback.state[index]}" for index in self._powered)
                timeout = self.config.watchdogs.enable_timeout
                self._halt(f"no power within watchdogs.enable_timeout = {timeout:g} s: {states}")
            yield
        except BaseException:
            if self._powered:
                self._stop()
            raise
        if not self._powered:
            return
        self._drives.disable()
        self._until_off()
        if (fault := self.feedback.fault) is not None:
            raise Stopped(fault.message)

    def play(self, way: SlowMove) -> Travelled:
        """Move powered sliders along a way from where they are held, and let them settle."""
        begin = tuple(self._target)
        measured = []
        for offset, rate in zip(way.position.tolist(), way.velocity.tolist(), strict=True):
            self._target = [place + by for place, by in zip(begin, offset, strict=True)]
            a, b, c = rate
            measured.append(self.cycle((a, b, c)).position)
        measured += [self.cycle().position for _ in range(round(SETTLE / self.period))]
        a, b, c = self.worst
        return Travelled(np.array(measured), (a, b, c))

    def home(self, timeout: float) -> None:
        """Home the drive that has power alone. Raises Stopped."""
        self._drives.home()
        for _ in range(round(timeout / self.period)):
            self.cycle()
            if not self.feedback.homing and all(self.feedback.homed[index] for index in self._powered):
                return
        self._halt(f"not homed within {timeout:g} s")

    def silence(self, seconds: float) -> Silence:
        """Send no SYNC and no heartbeat to the powered drive, for so long [s] or until it lets go by itself."""
        (index,) = self._powered
        for number in range(1, round(seconds / self.period) + 1):
            feedback = self._listen()
            state = feedback.state[index]
            if feedback.fault is not None or state is not PowerState.OPERATION_ENABLED:
                return self._last_words(index, number * self.period)
            if self._interrupted():
                self._halt(INTERRUPTED)
        # A drive that tells its state in answer to SYNC alone has had nobody to tell it to.
        self._drives.sync()
        state = self._listen().state[index]
        self._stop()
        return Silence(None if state is PowerState.OPERATION_ENABLED else seconds, "", str(state))

    def _listen(self) -> Feedback:
        """Let a period pass in which the drives hear nothing."""
        self._tick()
        self.feedback = self._drives.read()
        return self.feedback

    def _last_words(self, index: int, after: float) -> Silence:
        """Take in what the drives say that were not heard of; then stop what has not stopped by itself."""
        fault, state = self.feedback.fault, self.feedback.state[index]
        if fault is not None and fault.drive != NAMES[index]:
            # Another drive, which missed the heartbeat too, was heard first, and the driver has stopped them all.
            for _ in range(round(LAST_WORDS / self.period)):
                self._listen()
        own = self._drives.reported_faults[index]
        self._stop()
        if fault is None:
            return Silence(after, NAMES[index], str(state))
        own = own or fault
        by_itself = own.drive == NAMES[index] and own.cause in _OF_ITS_OWN
        return Silence(after if by_itself else None, own.drive, own.message, own.code)

    def clear(self) -> None:
        """Reset a fault, if there is one. Raises Stopped where it does not go."""
        if self.feedback.fault is not None:
            self._drives.reset()
            if (fault := self.wait(RESET).fault) is not None:
                raise Stopped(f"a fault stays: {fault.message}")

    def _has_power(self, feedback: Feedback) -> bool:
        return all(feedback.state[index] is PowerState.OPERATION_ENABLED for index in self._powered)

    def _wrong(self, feedback: Feedback, missed: int) -> str:
        """Say what must stop the drives now; "" where nothing."""
        if feedback.fault is not None:
            return feedback.fault.message
        if self._interrupted():
            return INTERRUPTED
        if missed > self.config.watchdogs.max_overruns:
            return f"{missed} cycles missed in a row: the machine is too busy; see trirail doctor"
        for index, name in enumerate(NAMES):
            state = feedback.state[index]
            if index not in self._powered:
                if state is PowerState.OPERATION_ENABLED:
                    return f"drive {name} has power, though it was left without"
                continue
            if state is PowerState.OPERATION_ENABLED and feedback.follows[index]:
                error = self._written[-DELAY - min(feedback.age[index], 7)][index] - feedback.position[index]
                self.worst[index] = max(self.worst[index], abs(error))
                if not abs(error) <= FOLLOWING:
                    slider = f"slider {self._labels[index]}"
                    return f"{slider}: following error {error * 1e3:.3f} mm, beyond {FOLLOWING * 1e3:g} mm"
        return ""

    def _halt(self, reason: str) -> None:
        self._stop()
        if kept := [name for name, state in zip(NAMES, self.feedback.state, strict=True) if state in _POWERED]:
            reason += f"; drive {', '.join(kept)} STILL HAS POWER: press the emergency stop"
        if self._interrupted():
            raise KeyboardInterrupt(reason)
        raise Stopped(reason)

    def _stop(self) -> None:
        """Stop all drives by their quick stop, and see their power go."""
        self._drives.quick_stop()
        self._until_off()

    def _until_off(self) -> None:
        self._powered = ()
        for _ in range(round((self.config.drives.stop_timeout + SETTLE) / self.period)):
            self._tick()
            self._drives.sync()
            self.feedback = self._drives.read()
            self._drives.write(self.feedback.position, _STILL)
            if not any(state in _POWERED for state in self.feedback.state):
                return
