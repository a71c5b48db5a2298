"""Homing mode of a simulated drive (CiA 402-2): home is the edge of a switch, or the current position."""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from trirail_drivers.simulated.servo import Servo

EDGES: Final = {17: 1, 18: -1, 19: -1, 20: 1, 21: 1, 22: -1}
"""Homing methods (6098h) without index pulse, and the direction in which each method finally crosses the switch's edge.
"""
STANDING: Final = (35, 37)
"""Homing methods with which the current position becomes home."""


class Phase(Enum):
    """Phase of a homing run."""

    IDLE = auto()
    SEARCH = auto()
    """Fast motion towards the edge until it is crossed."""
    RETREAT = auto()
    """Fast motion back across the edge."""
    APPROACH = auto()
    """Slow motion across the edge; home is where the axis crosses it."""
    HALT = auto()
    """Braking after the edge has been crossed."""


class HomingMode:
    """Homing mode of one servo; velocities are in counts/s, accelerations in counts/s²."""

    def __init__(self, servo: Servo, switch: float | None) -> None:
        self.switch = switch
        """Position of the edge of the switch [counts]; None if there is no switch."""
        self.attained = False
        self.failed = False
        """Whether a homing error has occurred; the next start clears it."""
        self.phase = Phase.IDLE
        self._servo = servo
        self._direction = 1
        self._fast = self._slow = self._acceleration = 1.0
        self._offset = 0

    @property
    def under_way(self) -> bool:
        """Whether homing has started and has been neither finished nor interrupted."""
        return self.phase is not Phase.IDLE

    def forget(self) -> None:
        """Reset the phase and the result, as at a change of mode."""
        self.attained = self.failed = False
        self.phase = Phase.IDLE

    def start(self, method: int, fast: float, slow: float, acceleration: float, offset: int) -> None:
        """Start homing by `method`; afterwards the position at home is `offset` [counts]."""
        self.forget()
        self._fast, self._slow, self._acceleration, self._offset = fast, slow, acceleration, offset
        if method in STANDING and self._servo.velocity == 0.0:
            self._refer(self._servo.position)
        elif method in EDGES and min(fast, slow, acceleration) > 0.0:
            self._direction = EDGES[method]
            self.phase = Phase.RETREAT if self._beyond() else Phase.SEARCH
        else:
            self.failed = True

    def interrupt(self) -> None:
        """Abandon homing. The drive itself then has to brake."""
        self.phase = Phase.IDLE

    def move(self, step: float, halted: bool) -> None:
        """Move for `step` seconds. If `halted`, the axis only brakes, and homing continues afterwards."""
        servo = self._servo
        before = self._beyond()
        speed = 0.0 if halted else self._speed()
        servo.run(speed, self._acceleration, step)
        if self.phase is Phase.HALT and servo.velocity == 0.0 and self.switch is not None:
            self._refer(self.switch)
        crossed = self._beyond() is not before
        if crossed and self.phase in (Phase.SEARCH, Phase.RETREAT, Phase.APPROACH):
            self.phase = Phase(self.phase.value + 1)

    def _speed(self) -> float:
        match self.phase:
            case Phase.SEARCH:
                return self._direction * self._fast
            case Phase.RETREAT:
                return -self._direction * self._fast
            case Phase.APPROACH:
                return self._direction * self._slow
            case _:
                return 0.0

    def _beyond(self) -> bool:
        """Whether the axis is on the side of the edge that it reaches when it moves in the final direction."""
        return self.switch is not None and self._direction * (self._servo.position - self.switch) >= 0.0

    def _refer(self, home: float) -> None:
        """Shift the positions so that `home` [counts] gets the position `offset`, and finish homing."""
        shift = self._offset - home
        self._servo.shift(shift)
        if self.switch is not None:
            self.switch += shift
        self.phase = Phase.IDLE
        self.attained = True
