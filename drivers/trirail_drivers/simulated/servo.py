"""A servo axis: first-order lag behind its setpoint, within what its motor can do."""

from __future__ import annotations

import math
from typing import Final

from trirail_drivers import config
from trirail_drivers.driver.ramp import braked

SOUND: Final = (1.0, 1.0)
"""An encoder that counts all of its travel, forwards and backwards."""


class Servo:
    """One axis in counts and seconds: a position loop with velocity feed-forward and a braking ramp.

    Over a step the setpoint r runs in a straight line from the last target to the new one, the feed-forward w
    likewise from the last to the new, and the position x obeys

        dx/dt = w + (r - x) / time_constant,

    so that the following error e = r - x obeys de/dt = (dr/dt - w) - e / time_constant: it fades, and only
    what the feed-forward leaves uncovered feeds it. An exact feed-forward has no lag, none at all lags by
    dr/dt · time_constant; `feed_forward_gain` is the share of it that this servo makes use of. With
    time_constant = 0 the servo is ideal: on the target at the end of each step. The velocity that this asks
    for is then cut to what can still be braked in time, to `max_velocity` and to `max_acceleration`.
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
        """What the last step aimed at [counts]."""
        self.limited = False
        """Whether the last step was cut to a limit."""
        self.forced_velocity: float | None = None
        """A defect: the velocity [counts/s] that the slider has whatever it is told, until its brake holds it."""
        self.encoder = SOUND
        """A defect: which shares of its travel the encoder counts, forwards and backwards; (0, 0) where it is loose."""
        self.travelled = 0.0
        """How far the motor has turned since power-on, whatever the encoder says [counts]."""
        self.play = 0.0
        """A defect: how far the motor turns before the slider goes along, where it turns back [counts]."""
        self.driven = 0.0
        """How far the slider has gone since power-on: as the motor, but for the play [counts]."""
        self.lag: float | None = None
        """A defect: how long it is behind its setpoint [s]; feed-forward does not help then."""
        self._feed_forward = 0.0
        self._feed_forward_gain = feed_forward_gain
        self._time_constant = time_constant
        self._max_velocity = max_velocity
        self._max_acceleration = max_acceleration

    @property
    def max_acceleration(self) -> float:
        """What the motor can do at most [counts/s²]."""
        return self._max_acceleration

    @classmethod
    def configured(cls, simulated: config.Simulated, drive: config.Drive, counts: float) -> Servo:
        """The servo that a configuration describes, at rest at a position [counts]."""
        return cls(
            counts,
            time_constant=simulated.time_constant,
            feed_forward_gain=simulated.feed_forward_gain,
            max_velocity=simulated.max_velocity * drive.counts_per_metre,
            max_acceleration=simulated.max_acceleration * drive.counts_per_metre,
        )

    @property
    def following_error(self) -> float:
        """Setpoint less position [counts]."""
        return self.setpoint - self.position

    def hold(self) -> None:
        """Stand still here, by the brake."""
        self.velocity = self._feed_forward = 0.0
        self.setpoint = self.position
        self.limited = False

    def follow(self, target: float, feed_forward: float, step: float) -> None:
        """Move for `step` seconds towards `target` [counts] with `feed_forward` [counts/s] at its end."""
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

        # The fastest approach that max_acceleration can still end on the setpoint, step by step.
        gain = self._max_acceleration * step
        brakable = 0.5 * gain * (math.sqrt(1.0 + 8.0 * abs(gap) / (gain * step)) - 1.0)
        if gap * closing > 0.0:
            closing = max(-brakable, min(closing, brakable))

        self._move(slope + closing, step)
        self.setpoint, self._feed_forward = target, feed_forward

    def chase(self, target: float, feed_forward: float, step: float) -> None:
        """Move for `step` seconds towards a `target` [counts] that has jumped there and stays, as does the rest.

        So a drive does that follows each setpoint from its arrival on: dx/dt = w + (r - x) / time_constant with
        constant r and w, cut to `max_velocity` and to `max_acceleration`.
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
        """Move for `step` seconds with the wanted velocity [counts/s], or what the motor can do of it."""
        gain = self._max_acceleration * step
        velocity = max(-self._max_velocity, min(wanted, self._max_velocity))
        velocity = max(self.velocity - gain, min(velocity, self.velocity + gain))
        self.limited = velocity != wanted
        if self.forced_velocity is not None:
            velocity = self.forced_velocity
        self.velocity = velocity
        self.turn(velocity * step)

    def brake(self, deceleration: float, step: float) -> None:
        """Slow down for `step` seconds with `deceleration` [counts/s²], at most to standstill."""
        if self.forced_velocity is not None:
            self.velocity = self.forced_velocity
            self.coast(step)
            self.setpoint, self._feed_forward = self.position, 0.0
        else:
            self.roll(deceleration, step)

    def roll(self, deceleration: float, step: float) -> None:
        """Slow down as `brake` does, but without power: no defect drives it on."""
        way, self.velocity = braked(0.0, self.velocity, deceleration, step)
        self.turn(way)
        self.setpoint, self._feed_forward = self.position, 0.0

    def run(self, velocity: float, acceleration: float, step: float) -> None:
        """Come to `velocity` [counts/s] with `acceleration` [counts/s²] for `step` seconds, following no setpoint."""
        change = acceleration * step
        before = self.velocity
        self.velocity = max(before - change, min(velocity, before + change))
        if self.forced_velocity is not None:
            before = self.velocity = self.forced_velocity
        self.turn(0.5 * (before + self.velocity) * step)
        self.setpoint, self._feed_forward = self.position, 0.0

    def shift(self, by: float) -> None:
        """Count from elsewhere: nothing moves, but every position is `by` counts more."""
        self.position += by
        self.setpoint += by

    def coast(self, step: float) -> None:
        """Keep the velocity for `step` seconds, as a drive does that waits for its next setpoint."""
        self.turn(self.velocity * step)

    def push(self, by: float) -> None:
        """Be turned by hand, without power [counts]."""
        self.turn(by)
        self.setpoint = self.position

    def turn(self, by: float) -> None:
        """Turn the motor `by` so much [counts]; the encoder counts what it counts of it."""
        forwards, backwards = self.encoder
        self.travelled += by
        half = abs(self.play) / 2.0
        self.driven = max(self.travelled - half, min(self.driven, self.travelled + half))
        self.position += by * (forwards if by > 0.0 else backwards)
