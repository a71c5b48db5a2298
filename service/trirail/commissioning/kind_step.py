"""Step that identifies the kind of mechanism, 3-PRP or 3-PPR.

All three drives move, and a person measures the travel of a mark on the platform with an instrument.
"""

from __future__ import annotations

import math

import numpy as np

from trirail.commissioning import moves
from trirail.commissioning.bench import DrivesStoppedError
from trirail.commissioning.judgement import Judgement
from trirail.commissioning.mechanism_kind import (
    AXES,
    MARK_RADIUS_M,
    MIN_SEPARATION,
    MarkPrediction,
    find_test_move,
    judge_kind,
    predict_mark,
)
from trirail.commissioning.observer import Observer
from trirail.commissioning.report import Number
from trirail.commissioning.session import Session, StepOutcome
from trirail.config import geometry
from trirail.errors import KinematicsError
from trirail.kinematics.arrays import Array
from trirail.kinematics.geometry import other_kind
from trirail.kinematics.robot import forward

REMEDY = "move the sliders, by hand or by homing, until the platform is well within its limits"


class KindStep:
    """Step with three motions; a person measures the travel of a mark in the second motion.

    The first motion turns the platform, the second moves it along a straight line, and the third returns to the start.
    """

    def __init__(self, session: Session, observer: Observer) -> None:
        self._session = session
        self._observer = observer
        self._config = session.environment.config
        self._operator = session.environment.operator
        self._robot = geometry(self._config.geometry)

    def run(self) -> StepOutcome:
        """Plan the motion, carry it out, and judge the travel of the mark.

        Raises DrivesStoppedError if a drive is not homed.
        """
        bench = self._session.bench()
        bench.check_homed()
        resolution = self._observer.ask_instrument_resolution()
        try:
            other = other_kind(self._robot)
            plan = find_test_move(self._config, self._robot, other, np.array(bench.position), resolution)
        except KinematicsError as error:
            return Judgement("failed", (str(error),), REMEDY), {}
        if plan is None:
            return Judgement("failed", ("no test motion from here stays within the limits of both kinds",), REMEDY), {}
        move, expected = plan
        kinds = self._robot.kind, other.kind
        if expected.separation < MIN_SEPARATION * resolution:
            return judge_kind(kinds, move, expected, None, resolution), _measured(expected, None, resolution)
        axis, line = AXES[move.axis], AXES[move.along]
        self._operator.show(
            f"  The platform turns by {math.degrees(move.turn):+.2f}°, moves {move.distance * 1e3:+.2f} mm along "
            f"{line}, and returns."
        )
        rules, start = self._observer.read_rules(), np.array(bench.position)

        def read_mark() -> float:
            now, simulated = self._observer.read_rules(), None
            if now is not None and rules is not None:
                simulated = float(forward(self._robot, start + np.subtract(now, rules))[move.axis])
            return self._observer.ask_mark(axis, simulated)

        try:
            self._move_to(move.first, "Instrument away and hands off?")
            self._operator.show(
                f"  Place the instrument at a mark, pin or ball on the platform, within {MARK_RADIUS_M * 1e3:g} mm of "
                f"its centre, to read along {axis}, rising towards +{axis}. The edge of a turned table is no such mark."
            )
            first, before = np.array(bench.position), read_mark()
            self._move_to(move.second, f"Instrument free of {move.distance * 1e3:+.2f} mm along {line}, and hands off?")
            second, after = np.array(bench.position), read_mark()
            self._move_to(start, "Instrument away and hands off?")
        except DrivesStoppedError as error:
            return Judgement("failed", (str(error),), "repeat the steps of the slider that is named"), {}
        try:
            seen = predict_mark(self._robot, other, first, second, move.axis)
        except KinematicsError as error:  # the measured positions may be just outside the reach of the other kind
            return Judgement("failed", (str(error),), REMEDY), {}
        moved = after - before
        return judge_kind(kinds, move, seen, moved, resolution), _measured(seen, moved, resolution)

    def _move_to(self, target: Array, question: str) -> None:
        """Ask the person, then move all three sliders to `target`, (3,) [m], with the drives enabled only meanwhile.

        The sliders move by the distances that the question names, even if the person pushes them before the answer.
        Raises DrivesStoppedError.
        """
        bench = self._session.bench()
        distances = target - np.array(bench.position)
        longest = float(np.abs(distances).max())
        self._observer.ask_ready(f"Next the sliders move by up to {longest * 1e3:.2f} mm. {question}")
        with bench.power():
            bench.play(moves.plan_joint_move(distances, self._config.limits.slider, bench.period))


def _measured(expected: MarkPrediction, moved: float | None, resolution: float) -> dict[str, Number]:
    return {
        "configured": expected.configured,
        "other": expected.other,
        "unsure": expected.uncertainty,
        "moved": moved,
        "read_to": resolution,
    }
