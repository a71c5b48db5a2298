"""The step that tells the two kinds of stages apart: all three move, somebody reads an instrument beside a mark."""

from __future__ import annotations

import math

import numpy as np

from trirail.commissioning import moves
from trirail.commissioning.bench import Stopped
from trirail.commissioning.judgement import Judged
from trirail.commissioning.kinds import AXES, DISTINCT, NEAR, KindPredicted, judge_kind, predicted, way_apart
from trirail.commissioning.observer import Observer
from trirail.commissioning.report import Number
from trirail.commissioning.session import Done, Session
from trirail.config import geometry
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import other_kind
from trirail.kinematics.robot import forward

REMEDY = "move the sliders, by hand or by their homing, to where the platform is well within its limits"


class KindStep:
    """One turn and one straight way, of which the middle is measured from outside."""

    def __init__(self, session: Session, see: Observer) -> None:
        self._session = session
        self._see = see
        self._config = session.place.config
        self._person = session.place.person
        self._robot = geometry(self._config.geometry)

    def run(self) -> Done:
        """Find the way, go it, and judge by how far the mark went."""
        bench = self._session.bench()
        read_to = self._see.instrument()
        try:
            other = other_kind(self._robot)
            found = way_apart(self._config, self._robot, other, np.array(bench.position), read_to)
        except KinematicsError as error:
            return Judged("failed", (str(error),), REMEDY), {}
        if found is None:
            return Judged("failed", ("no way from here is within the limits of either kind",), REMEDY), {}
        way, expected = found
        kinds = self._robot.kind, other.kind
        if expected.apart < DISTINCT * read_to:
            return judge_kind(kinds, way, expected, None, read_to), _measured(expected, None, read_to)
        axis, line = AXES[way.axis], AXES[way.along]
        self._person.show(
            f"  It turns by {math.degrees(way.turn):+.2f}° and goes {way.distance * 1e3:+.2f} mm along {line}. Let the "
            f"instrument read a mark, pin or ball on the platform, within {NEAR * 1e3:g} mm of its centre, along {axis}"
            f", its numbers rising towards +{axis}. The edge of a turned table will not do."
        )
        rules, start = self._see.rules(), np.array(bench.position)

        def mark() -> float:
            now, shown = self._see.rules(), None
            if now is not None and rules is not None:
                shown = float(forward(self._robot, start + np.subtract(now, rules))[way.axis])
            return self._see.mark(axis, shown)

        try:
            self._go(way.first)
            first, before = np.array(bench.position), mark()
            self._go(way.second)
            second, after = np.array(bench.position), mark()
            self._go(start)
        except Stopped as why:
            return Judged("failed", (str(why),), "repeat the step of the slider that is named"), {}
        seen = predicted(self._robot, other, first, second, way.axis)
        moved = after - before
        return judge_kind(kinds, way, seen, moved, read_to), _measured(seen, moved, read_to)

    def _go(self, to: Array) -> None:
        """Move all three sliders to a place [m], with power for that long. Raises Stopped."""
        bench = self._session.bench()
        ways = to - np.array(bench.position)
        with bench.power():
            bench.play(moves.together(ways, self._config.limits.slider, bench.period))


def _measured(expected: KindPredicted, moved: float | None, read_to: float) -> dict[str, Number]:
    return expected._asdict() | {"moved": moved, "read_to": read_to}
