"""Steps of a commissioning, which ask, move or measure, and return a judgement."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, NamedTuple, ParamSpec

import numpy as np
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES

from trirail import naming
from trirail.commissioning import moves
from trirail.commissioning.bench import DrivesStoppedError, FollowingStopError
from trirail.commissioning.coupling import MoveObservation, PushObservation, judge_move, judge_push
from trirail.commissioning.judgement import (
    SWITCHES,
    Judgement,
    judge_homing,
    judge_power,
    judge_square,
    judge_switches,
    judge_watchdog,
)
from trirail.commissioning.kind_step import REMEDY, KindStep
from trirail.commissioning.observer import Observer, Reading, subtract
from trirail.commissioning.person import Question, ask_choice
from trirail.commissioning.report import Number
from trirail.commissioning.session import Session, StepOutcome
from trirail.config import geometry
from trirail.errors import KinematicsError
from trirail.kinematics.robot import forward

Arguments = ParamSpec("Arguments")

HOLD_TIME_S = 1.0
"""Time for which a drive holds its slider when it is enabled for the first time [s]."""
PUSH_DISTANCE_M = 0.010
"""Recommended travel of a slider that is pushed by hand [m]."""
INPUT_POLL_S = 0.05
"""Interval at which digital inputs are read while switches are pressed [s]."""


def _hands_on(
    step: Callable[Concatenate[Steps, Arguments], StepOutcome],
) -> Callable[Concatenate[Steps, Arguments], StepOutcome]:
    """Decorate a step in which a person touches the robot. No drive may have power or be silent before and after it.

    Otherwise the step ends as failed. A step that is not ok while a drive has a fault also ends as failed, so that the
    fault is not blamed on the mechanics.
    """

    @wraps(step)
    def run(self: Steps, /, *args: Arguments.args, **keys: Arguments.kwargs) -> StepOutcome:
        bench = self.session.bench()
        try:
            bench.prepare_hands_on()
            outcome = step(self, *args, **keys)
            bench.check_hands_on()
            if outcome[0].verdict != "ok":
                bench.check_without_power()
        except (DrivesStoppedError, DriveError) as error:
            return Judgement("failed", (str(error),), "remove the cause, then repeat this step"), {}
        return outcome

    return run


class Steps:
    """Steps for drives that have been set up. They can be called in any order."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._config = session.environment.config
        self._environment = session.environment
        self._operator = session.environment.operator
        self._labels = session.environment.config.geometry.labels
        self._observer = Observer(session.environment.operator, session.environment.rules, session.idle, self._labels)

    def slider_label(self, name: str) -> str:
        """Return the display name of slider A, B or C."""
        return naming.label(name, self._labels)

    # Without power.

    @_hands_on
    def push(self, name: str) -> StepOutcome:
        """Ask the person to push a slider out and back by hand, without power."""
        bench, index = self.session.bench(), NAMES.index(name)
        resolution = self._observer.ask_rule_resolution()
        label = self.slider_label(name)
        angle = np.degrees(geometry(self._config.geometry).each[index].rail_angle)
        self._operator.show(f"  Put the rule along rail {label}, rising towards {angle:.0f}° (0° is x, 90° is y).")
        start = self._observer.ask_rule(index), bench.position
        end = self._observe_push(
            index,
            PUSH_DISTANCE_M,
            f"Push slider {label} by {PUSH_DISTANCE_M * 1e3:g} mm or more in that direction, and release it.",
        )
        returned = self._observe_push(
            index, -PUSH_DISTANCE_M, f"Push slider {label} back to about its start, and release it."
        )
        (rule, counted), (rule_back, counted_back) = subtract(end, start), subtract(returned, end)
        seen = PushObservation(
            name, rule, counted, rule_back, counted_back, resolution, self._encoder_resolution(name), self._labels
        )
        measured: dict[str, Number] = {"rule": rule, "rule_back": rule_back, "read_to": resolution}
        measured |= dict(zip(NAMES, counted, strict=True))
        measured |= {f"{each}_back": length for each, length in zip(NAMES, counted_back, strict=True)}
        return judge_push(seen, self._config.drives), measured

    def _observe_push(self, index: int, by: float, text: str) -> Reading:
        """Ask the person to push a slider by the distance `by` [m]; return the readings after the push.

        A simulated slider is pushed without a person.
        """
        bench = self.session.bench()
        if self._environment.rules is None:
            self._operator.show(f"  {text}")
        else:
            self._environment.rules.push(index, by)
            bench.wait(HOLD_TIME_S / 10.0)
            self._operator.show(f"  Simulated push of slider {self._labels[index]}: {by * 1e3:+g} mm.")
        return self._observer.ask_rule(index), bench.position

    @_hands_on
    def switches(self, name: str) -> StepOutcome:
        """Ask the person to press the switches of a slider by hand, without power."""
        bench, read = self.session.bench(), self._environment.inputs
        rest = read(name) if read is not None else None
        if read is None or rest is None:
            reason = f"drive {name} does not report its digital inputs (60FDh): check them with the manufacturer's tool"
            return Judgement("skipped", (reason,)), {}
        changed, cycles, slider = 0, 0, f"slider {self.slider_label(name)}"

        def read_switches() -> None:
            nonlocal changed, cycles
            self.session.idle()
            cycles += 1
            if cycles % max(1, round(INPUT_POLL_S / bench.period)) == 0 and (bits := read(name)) is not None:
                changed |= bits ^ rest

        if (press := self._environment.press) is None:
            text = f"Press each limit switch and the home switch of {slider} for a second, then press Enter"
            ask_choice(self._operator, read_switches, Question(text, "done"), {"done": "all were pressed"})
        else:
            self._operator.show(f"  Simulated presses of the switches of {slider}.")
            for bits in (*SWITCHES, 0):
                press(NAMES.index(name), bits)
                for _ in range(round(2.0 * INPUT_POLL_S / bench.period)):
                    read_switches()
        changed_names = [switch for bit, switch in SWITCHES.items() if changed & bit]
        confirmed = self._observer.ask_yes_no(
            f"Switches that changed: {', '.join(changed_names) or 'none'}. Are those all that {slider} has?"
        )
        return judge_switches(name, rest, changed, confirmed, self._labels), {
            "at_rest": rest & 7,
            "changed": changed & 7,
        }

    # With power, one drive alone.

    def power(self, name: str) -> StepOutcome:
        """Enable one drive for HOLD_TIME_S, in which it must hold its slider, and disable it."""
        bench, stopped = self.session.bench(), ""
        try:
            with bench.power(name):
                bench.wait(HOLD_TIME_S)
        except DrivesStoppedError as error:
            stopped = str(error)
        drift = bench.max_errors[NAMES.index(name)]
        return judge_power(name, drift, HOLD_TIME_S, stopped), {"drift": drift}

    @_hands_on
    def move(self, name: str) -> StepOutcome:
        """Move a single enabled drive out and back. The person reports which slider moved, and how far."""
        index, drives = NAMES.index(name), self._config.drives
        resolution = self._observer.ask_rule_resolution()
        try:
            commanded = self._choose_distance(index)
        except ValueError as error:
            return Judgement("failed", (str(error),), "move the slider towards the middle of its travel"), {}
        before = self._observer.ask_rule(index)
        before_all = self._observer.read_rules()
        out = self._move_slider(index, commanded)
        rules = self._observer.read_rules()
        slider = self._observer.ask_moved_slider(before_all, rules)
        measured: dict[str, Number] = {"asked": commanded, "out": out.travel, "slider": slider}
        rule_out = rule_back = travel_back = 0.0
        if slider is not None:
            rule_out = self._observer.ask_travel(name, slider, before, before_all, rules, "move")
        if slider is not None and not out.stopped:
            back = self._move_slider(index, -commanded)
            travel_back = back.travel
            out = out._replace(stopped=back.stopped, following=max(out.following, back.following))
            now = self._observer.read_rules()
            if slider == name:
                rule_back = self._observer.ask_travel(name, slider, before, before_all, now, "move")
            else:
                rule_back = rule_out + self._observer.ask_travel(name, slider, before, rules, now, "move back")
        seen = MoveObservation(
            name,
            commanded,
            out.travel,
            travel_back,
            out.following,
            out.stopped,
            slider,
            rule_out,
            rule_back,
            resolution,
            self._encoder_resolution(name),
            self._labels,
        )
        measured |= {"back": travel_back, "following": out.following, "stopped": out.stopped}
        measured |= {"rule_out": rule_out, "rule_back": rule_back, "read_to": resolution}
        return judge_move(seen, drives), measured

    def home(self, name: str) -> StepOutcome:
        """Home one drive while only this drive is enabled."""
        bench, index = self.session.bench(), NAMES.index(name)
        drive = self._config.drives.each[index]
        homing = drive.homing
        if homing is None:
            return Judgement("ok", ("no homing: its encoder is absolute",)), {}
        stopped, rules = "", self._observer.read_rules()
        try:
            with bench.power(name):
                bench.home(homing.timeout)
                bench.wait(HOLD_TIME_S / 2.0)
        except DrivesStoppedError as error:
            stopped = str(error)
        position = bench.position[index]
        now = self._observer.read_rules()
        # Homing moves the zero of the encoder, so a difference of its readings is not the travel.
        travel = None if rules is None or now is None else now[index] - rules[index]
        confirmed = stopped or self._observer.ask_yes_no(
            f"Did slider {self.slider_label(name)} stop at its home switch?"
        )
        judgement = judge_homing(name, travel, position, drive.offset, bool(confirmed), stopped, self._labels)
        return judgement, {"way": travel, "position": position, "stopped": stopped}

    def watchdog(self, name: str) -> StepOutcome:
        """Enable one drive, and stop sending SYNC and heartbeat. The drive must then switch its power off."""
        bench, heartbeat = self.session.bench(), self._config.drives.heartbeat
        try:
            with bench.power(name):
                bench.wait(HOLD_TIME_S / 2.0)
                # Drives react within three intervals of the heartbeat; see the key drives.heartbeat.
                reaction = bench.provoke_watchdog(3.0 * heartbeat + HOLD_TIME_S)
        except DrivesStoppedError as error:
            return Judgement("failed", (str(error),), "repeat this step"), {}
        judgement = judge_watchdog(name, reaction.seconds, reaction.message, reaction.code)
        return judgement, {"seconds": reaction.seconds, "said": reaction.message}

    # All three.

    def square(self) -> StepOutcome:
        """Move the platform around a small square."""
        bench, stopped, deviation = self.session.bench(), "", 0.0
        robot = geometry(self._config.geometry)
        try:
            bench.check_homed()
            move, path = moves.plan_square(self._config, bench.position)
        except DrivesStoppedError as error:
            return Judgement("failed", (str(error),), "then repeat this step"), {}
        except (KinematicsError, ValueError) as error:
            return Judgement("failed", (str(error),), REMEDY), {}
        half = len(path) // 2
        rules = self._observer.read_rules()
        corner = rules
        try:
            with bench.power():
                first = bench.play(moves.SlowMove(move.position[:half], move.velocity[:half]))
                corner = self._observer.read_rules()
                rest = moves.SlowMove(move.position[half:] - move.position[half - 1], move.velocity[half:])
                second = bench.play(rest)
            poses = forward(robot, np.concatenate([first.position, second.position]))[:, :2]
            # Every fourth commanded pose is enough, since at 5 mm/s and 1 kHz these poses are 20 µm apart.
            distances = np.linalg.norm(poses[:, None, :] - path[None, ::4, :2], axis=2).min(axis=1)
            deviation = float(distances.max())
        except DrivesStoppedError as error:
            stopped = str(error)
        confirmed = bool(stopped) or self._observer.ask_square(move.position[half - 1], rules, corner)
        following = dict(zip(NAMES, bench.max_errors, strict=True))
        judgement = judge_square(deviation, bench.max_errors, confirmed, stopped, self._labels)
        return judgement, {"deviation": deviation, "missed_cycles": bench.missed_cycles, **following}

    @_hands_on
    def kind(self) -> StepOutcome:
        """Check the kind of the mechanism with the measured travel of a mark on the platform."""
        return KindStep(self.session, self._observer).run()

    def _move_slider(self, index: int, distance: float) -> _SliderMotion:
        """Move one slider over `distance` [m]. Only the drive of this slider is enabled, and only during the motion.

        Raises DrivesStoppedError if another problem than a following error stops it.
        """
        bench, stopped = self.session.bench(), ""
        before = bench.position[index]
        try:
            with bench.power(NAMES[index]):
                bench.play(moves.plan_slider_move(index, distance, self._config.limits.slider, self._config.period))
        except FollowingStopError as error:
            stopped = str(error)
        bench.wait(HOLD_TIME_S / 10.0)
        return _SliderMotion(bench.position[index] - before, bench.max_errors[index], stopped)

    def _choose_distance(self, index: int) -> float:
        """Return the signed test distance of a slider [m]. Raises ValueError if its limits leave no room for a test."""
        bench, slider = self.session.bench(), self._config.limits.slider
        limits = slider.positions[index]
        try:
            distance = moves.choose_distance(bench.position[index] if bench.feedback.homed[index] else None, limits)
        except ValueError as error:
            raise ValueError(f"slider {self._labels[index]}: {error} in {slider.keys('position')[index]}") from error
        if abs(distance) < moves.TEST_DISTANCE_M:
            self._operator.show(
                f"  It moves {abs(distance) * 1e3:.2f} mm only, because {slider.keys('position')[index]} = "
                f"[{limits[0]:g}, {limits[1]:g}] leaves no room for {moves.TEST_DISTANCE_M * 1e3:g} mm."
            )
        return distance

    def _encoder_resolution(self, name: str) -> float:
        return 1.0 / self._config.drives.each[NAMES.index(name)].counts_per_metre


class _SliderMotion(NamedTuple):
    """Motion of one slider, as measured by the drive."""

    travel: float
    """Signed travel [m]."""
    following: float
    """Maximum following error [m]."""
    stopped: str
    """Reason why the drives were stopped during the motion; "" if they were not stopped."""
