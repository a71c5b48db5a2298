"""Servo axis with a first-order lag behind its setpoint, within the limits of its motor."""

from __future__ import annotations

import math
from typing import Final

from trirail_drivers import config
from trirail_drivers.driver.ramp import brake

INTACT: Final = (1.0, 1.0)
"""Fractions of the travel that an intact encoder counts, in forward and backward motion."""


class Servo:
    """One axis in counts and seconds: a position loop with velocity feed-forward and a braking ramp.

    Over a step, the setpoint r changes linearly from the previous target to the new one, the feed-forward w changes
    linearly from its previous value to the new one, and the position x obeys

        dx/dt = w + (r - x) / time_constant.

    The following error e = r - x therefore obeys de/dt = (dr/dt - w) - e / time_constant: it decays, unless an error of
    the feed-forward sustains it. With exact feed-forward there is no lag; without feed-forward the lag is
    dr/dt · time_constant. `feed_forward_gain` is the fraction of the feed-forward that this servo uses. With
    time_constant = 0 the servo is ideal: at the end of each step it has reached the target. Finally, the velocity is
    limited so that the servo can still brake in time, and to `max_velocity` and `max_acceleration`.
    """

    def __init__(
        self,
        position: float,
        *,
        time_constant: float,
        max_velocity: float,
        max_acceleration: float,
        feed_forward_gain: float = 1.0,
    ) -> None:
        self.position = position
        """Measured position [counts]."""
        self.velocity = 0.0
        """Measured velocity [counts/s]."""
        self.setpoint = position
        """Target of the last step [counts]."""
        self.limited = False
        """Whether a limit was active in the last step."""
        self.forced_velocity: float | None = None
        """Defect: velocity of the slider, whatever its setpoint is, until the brake stops the slider [counts/s]."""
        self.encoder = INTACT
        """Defect: fractions of the travel that the encoder counts, in forward and backward motion.

        A loose encoder counts none of it: (0, 0).
        """
        self.motor = 1.0
        """Defect: -1 if the motor and its encoder turn in opposite directions, as with two swapped phases; else 1."""
        self.travelled = 0.0
        """Actual travel of the motor since power-on, even if the encoder counts a different travel [counts]."""
        self.play = 0.0
        """Defect: backlash, the distance that a reversing motor travels before the slider follows [counts]."""
        self.driven = 0.0
        """Travel of the slider since power-on [counts]. Because of backlash, the travel of the motor may differ."""
        self.lag: float | None = None
        """Defect: time by which the slider lags behind its setpoint [s]; feed-forward then has no effect."""
        self._feed_forward = 0.0
        self._feed_forward_gain = feed_forward_gain
        self._time_constant = time_constant
        self._max_velocity = max_velocity
        self._max_acceleration = max_acceleration

    @property
    def max_acceleration(self) -> float:
        """Maximum acceleration of the motor [counts/s²]."""
        return self._max_acceleration

    @classmethod
    def configured(cls, simulated: config.Simulated, drive: config.Drive, counts: float) -> Servo:
        """Return the servo of a configuration, at rest at a position [counts]."""
        return cls(
            counts,
            time_constant=simulated.time_constant,
            feed_forward_gain=simulated.feed_forward_gain,
            max_velocity=simulated.max_velocity * drive.counts_per_metre,
            max_acceleration=simulated.max_acceleration * drive.counts_per_metre,
        )

    @property
    def following_error(self) -> float:
        """Setpoint minus position [counts]."""
        return self.setpoint - self.position

    def follow(self, target: float, feed_forward: float, step: float) -> None:
        """Move for `step` seconds towards `target` [counts], with `feed_forward` [counts/s] at the end of the step."""
        feed_forward *= self._feed_forward_gain if self.lag is None else 0.0
        time_constant = self._time_constant if self.lag is None else self.lag
        slope = (target - self.setpoint) / step
        uncovered = slope - 0.5 * (self._feed_forward + feed_forward)
        gap = self.following_error
        if time_constant > 0.0:
            settled = uncovered * time_constant
            closing = (gap - settled) * -math.expm1(-step / time_constant) / step
        else:
            closing = gap / step

        # Fastest approach that max_acceleration can still stop at the setpoint, in discrete steps.
        gain = self._max_acceleration * step
        brakable = 0.5 * gain * (math.sqrt(1.0 + 8.0 * abs(gap) / (gain * step)) - 1.0)
        if gap * closing > 0.0:
            closing = max(-brakable, min(closing, brakable))

        self._move(slope + closing, step)
        self.setpoint, self._feed_forward = target, feed_forward

    def chase(self, target: float, feed_forward: float, step: float) -> None:
        """Move for `step` seconds towards a constant `target` [counts] with a constant feed-forward [counts/s].

        This is the motion of a drive that follows each setpoint as soon as it arrives: dx/dt = w + (r - x) /
        time_constant with constant r and w, limited to `max_velocity` and `max_acceleration`.
        """
        feed_forward *= self._feed_forward_gain if self.lag is None else 0.0
        time_constant = self._time_constant if self.lag is None else self.lag
        gap = target - self.position
        if time_constant > 0.0:
            ahead = gap + feed_forward * time_constant
            wanted = ahead * -math.expm1(-step / time_constant) / step
        else:
            wanted = gap / step
        self._move(wanted, step)
        self.setpoint, self._feed_forward = target, feed_forward

    def _move(self, wanted: float, step: float) -> None:
        """Move for `step` seconds with the wanted velocity [counts/s], within the limits of the motor."""
        gain = self._max_acceleration * step
        velocity = max(-self._max_velocity, min(wanted, self._max_velocity))
        velocity = max(self.velocity - gain, min(velocity, self.velocity + gain))
        self.limited = velocity != wanted
        if self.forced_velocity is not None:
            velocity = self.forced_velocity
        self.velocity = velocity
        self._drive(velocity * step)

    def brake(self, deceleration: float, step: float) -> None:
        """Brake for `step` seconds with `deceleration` [counts/s²], or until standstill."""
        if self.forced_velocity is not None:
            self.velocity = self.forced_velocity
            self.coast(step)
            self.setpoint, self._feed_forward = self.position, 0.0
        else:
            self.roll(deceleration, step)

    def roll(self, deceleration: float, step: float) -> None:
        """Slow down as in `brake`, but without power: a forced velocity has no effect."""
        way, self.velocity = brake(0.0, self.velocity, deceleration, step)
        self._drive(way)
        self.setpoint, self._feed_forward = self.position, 0.0

    def run(self, velocity: float, acceleration: float, step: float) -> None:
        """Accelerate towards `velocity` [counts/s] with `acceleration` [counts/s²] for `step` seconds."""
        change = acceleration * step
        before = self.velocity
        self.velocity = max(before - change, min(velocity, before + change))
        if self.forced_velocity is not None:
            before = self.velocity = self.forced_velocity
        self._drive(0.5 * (before + self.velocity) * step)
        self.setpoint, self._feed_forward = self.position, 0.0

    def shift(self, by: float) -> None:
        """Shift the origin: nothing moves, but every position increases by `by` counts."""
        self.position += by
        self.setpoint += by

    def coast(self, step: float) -> None:
        """Keep the velocity for `step` seconds, like a drive that is waiting for its next setpoint."""
        self._drive(self.velocity * step)

    def push(self, by: float) -> None:
        """Turn the motor by hand by `by` [counts], without power."""
        self.turn(by)
        self.setpoint = self.position

    def _drive(self, by: float) -> None:
        """Turn the motor under power by `by` [counts]. If the motor has that defect, the direction is reversed."""
        self.turn(by if self.forced_velocity is not None else self.motor * by)

    def turn(self, by: float) -> None:
        """Turn the motor by `by` [counts]. The slider follows with backlash; the encoder counts its fraction."""
        forwards, backwards = self.encoder
        self.travelled += by
        half = abs(self.play) / 2.0
        self.driven = max(self.travelled - half, min(self.driven, self.travelled + half))
        self.position += by * (forwards if by > 0.0 else backwards)
