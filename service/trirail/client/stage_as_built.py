"""Simulation of a real stage that differs from the service's model in its geometry and by backlash in its drives.

Simulated cameras use the pose of this stage. The positions of its motors are taken from the records that a service
publishes.
"""

from __future__ import annotations

import dataclasses
import threading
from collections import deque
from typing import Any, cast

import numpy as np
from trirail_drivers.interface import Triple

from trirail.errors import ServiceError
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import forward
from trirail.wire.records import unpack

HISTORY = 5000
"""Number of latest cycles for which positions are stored."""
COMES_WITHIN = 2.0
"""Longest wait for the records of a given time [s]."""


def built_otherwise(robot: Geometry, rng: np.random.Generator, places: float, angles: float) -> Geometry:
    """Return a copy of a geometry with random errors in its legs.

    The errors are at most `places` [m] for each coordinate and `angles` [rad] for each angle.
    """

    def near(place: tuple[float, float]) -> tuple[float, float]:
        x, y = (np.array(place) + rng.uniform(-places, places, 2)).tolist()
        return x, y

    def angle(value: float) -> float:
        return value + float(rng.uniform(-angles, angles))

    legs: list[Any] = []
    for leg in robot.each:
        values = {field.name: getattr(leg, field.name) for field in dataclasses.fields(cast(Any, leg))}
        points = {name: near(value) for name, value in values.items() if isinstance(value, tuple)}
        turns = {name: angle(value) for name, value in values.items() if name.endswith("angle")}
        legs.append(dataclasses.replace(cast(Any, leg), **points, **turns))
    return dataclasses.replace(robot, legs=tuple(legs))


class StageAsBuilt:
    """Simulated slider positions and table pose, computed from the motor positions in a robot's records.

    `robot.records(stage.add_records)` supplies the records. `built` is the true geometry of the stage. `play` is the
    backlash of each slider [m], the distance that the motor moves after a reversal before the slider follows. Each
    motor starts in the middle of its backlash.
    """

    def __init__(self, built: Geometry, play: Triple = (0.0, 0.0, 0.0)) -> None:
        self._built = built
        self._half = np.abs(play) / 2.0
        self._changed = threading.Condition()
        self._cycles: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=HISTORY)
        self._sliders: np.ndarray[tuple[int], np.dtype[np.float64]] | None = None

    def add_records(self, batch: bytes) -> None:
        """Add a batch of records."""
        rows = unpack(batch)
        motors = rows["position"]
        sliders = np.array(motors[0]) if self._sliders is None else self._sliders
        with self._changed:
            for time, motor in zip((rows["deadline_ns"] * 1e-9).tolist(), motors, strict=True):
                sliders = np.clip(sliders, motor - self._half, motor + self._half)
                self._cycles.append((time, tuple(sliders.tolist())))
            self._sliders = sliders
            self._changed.notify_all()

    def sliders_at(self, time: float) -> Triple:
        """Return the positions of the sliders [m] at a monotonic time [s], interpolated linearly between two cycles.

        Wait for the records of that time. Raises ServiceError if these records do not arrive or are no longer stored.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._cycles and self._cycles[-1][0] >= time, COMES_WITHIN):
                raise ServiceError(
                    f"no records of time {time:.3f} s within {COMES_WITHIN:g} s; check that the service is running"
                )
            after = len(self._cycles) - 1
            while after > 0 and self._cycles[after - 1][0] >= time:
                after -= 1
            (begin, first), (end, last) = self._cycles[max(0, after - 1)], self._cycles[after]
        if time < begin:
            raise ServiceError(f"time {time:.3f} s is before the first record that is kept, at {begin:.3f} s")
        share = (time - begin) / (end - begin) if end > begin else 1.0
        a, b, c = (p + share * (q - p) for p, q in zip(first, last, strict=True))
        return a, b, c

    def pose_at(self, time: float) -> Triple:
        """Return the table's pose x, y [m], phi [rad] at a monotonic time [s].

        Raises the ServiceError of `sliders_at`, and KinematicsError if no pose belongs to the slider positions.
        """
        x, y, phi = forward(self._built, self.sliders_at(time)).tolist()
        return x, y, phi
