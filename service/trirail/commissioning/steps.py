"""The steps of a commissioning: each asks, moves or looks, and returns what is to be thought of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from trirail_drivers.interface import NAMES

from trirail import naming
from trirail.commissioning import moves
from trirail.commissioning.bench import Stopped
from trirail.commissioning.coupling import MoveSeen, PushSeen, judge_move, judge_push
from trirail.commissioning.judgement import (
    SWITCHES,
    Judged,
    judge_homing,
    judge_power,
    judge_square,
    judge_switches,
    judge_watchdog,
)
from trirail.commissioning.kind_step import REMEDY, KindStep
from trirail.commissioning.observer import Observer, Reading, apart
from trirail.commissioning.person import Question, choose
from trirail.commissioning.report import Number
from trirail.commissioning.session import Done, Session
from trirail.config import geometry
from trirail.errors import KinematicsError
from trirail.kinematics.robot import forward

HOLD = 1.0
"""How long a drive holds its slider when it gets power for the first time [s]."""
PUSH = 0.010
"""How far a slider is best pushed by hand [m]."""
LOOK = 0.05
"""How often digital inputs are read while switches are pressed [s]."""


class Steps:
    """What can be done with drives that have been set up, in whatever order."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._config = session.place.config
        self._place = session.place
        self._person = session.place.person
        self._labels = session.place.config.geometry.labels
        self._see = Observer(session.place.person, session.place.rules, session.idle, self._labels)

    def labelled(self, name: str) -> str:
        """Return what people call the slider A, B or C."""
        return naming.label(name, self._labels)

    # Without power.

    def push(self, name: str) -> Done:
        """Have a slider pushed there and back by hand, without power."""
        bench, index = self.session.bench(), NAMES.index(name)
        read_to = self._see.read_to()
        label = self.labelled(name)
        angle = np.degrees(geometry(self._config.geometry).each[index].rail_angle)
        self._person.show(
            f"  Put the rule along rail {label}, its numbers rising towards {angle:.0f}° (0° is x, 90° is y)."
        )
        before = self._see.reading(index), bench.position
        there = self._pushed(index, PUSH, f"Push slider {label} by {PUSH * 1e3:g} mm or more, that way, and let it go.")
        back = self._pushed(index, -PUSH, f"Push slider {label} back to about where it was, and let it go.")
        (rule, ways), (rule_back, ways_back) = apart(before, there), apart(there, back)
        seen = PushSeen(name, rule, ways, rule_back, ways_back, read_to, self._step(name), self._labels)
        measured: dict[str, Number] = {"rule": rule, "rule_back": rule_back, "read_to": read_to}
        measured |= dict(zip(NAMES, ways, strict=True))
        measured |= {f"{each}_back": way for each, way in zip(NAMES, ways_back, strict=True)}
        return judge_push(seen, self._config.drives), measured

    def _pushed(self, index: int, by: float, text: str) -> Reading:
        """Have a slider pushed; where the rule and the drives then say that it is."""
        bench = self.session.bench()
        if self._place.rules is None:
            self._person.show(f"  {text}")
        else:
            self._place.rules.push(index, by)
            bench.wait(HOLD / 10.0)
            self._person.show(f"  A simulated hand has pushed slider {self._labels[index]} {by * 1e3:+g} mm that way.")
        return self._see.reading(index), bench.position

    def switches(self, name: str) -> Done:
        """Have the switches of a slider pressed by hand, without power."""
        bench, read = self.session.bench(), self._place.inputs
        rest = read(name) if read is not None else None
        if read is None or rest is None:
            told = f"drive {name} does not tell its digital inputs (60FDh): look at them with its maker's tool"
            return Judged("skipped", (told,)), {}
        changed, turned, slider = 0, 0, f"slider {self.labelled(name)}"

        def read_switches() -> None:
            nonlocal changed, turned
            self.session.idle()
            turned += 1
            if turned % max(1, round(LOOK / bench.period)) == 0:
                changed |= (read(name) or 0) ^ rest

        if (press := self._place.press) is None:
            text = f"Press each limit switch and the home switch of {slider} for a second; Enter when that is done"
            choose(self._person, read_switches, Question(text, "done"), {"done": "all were pressed"})
        else:
            self._person.show(f"  A simulated hand presses the switches of {slider}.")
            for bits in (*SWITCHES, 0):
                press(NAMES.index(name), bits)
                for _ in range(round(2.0 * LOOK / bench.period)):
                    read_switches()
        found = [switch for bit, switch in SWITCHES.items() if changed & bit]
        seen = self._see.yes(f"Seen were: {', '.join(found) or 'none'}. Are those all that {slider} has?")
        return judge_switches(name, rest, changed, seen, self._labels), {"at_rest": rest & 7, "changed": changed & 7}

    # With power, one drive alone.

    def power(self, name: str) -> Done:
        """Give one drive power, let it hold its slider, and take it off."""
        bench, stopped = self.session.bench(), ""
        try:
            with bench.power(name):
                bench.wait(HOLD)
        except Stopped as why:
            stopped = str(why)
        drift = bench.worst[NAMES.index(name)]
        return judge_power(name, drift, HOLD, stopped), {"drift": drift}

    def move(self, name: str) -> Done:
        """Move one slider there and back, its drive alone with power; a person looks what has moved, and how far."""
        index, drives = NAMES.index(name), self._config.drives
        read_to = self._see.read_to()
        asked = self._way(index)
        before = self._see.reading(index)
        before_all = self._see.rules()
        there = self._moved(index, asked)
        rules = self._see.rules()
        slider = self._see.which(before_all, rules)
        measured: dict[str, Number] = {"asked": asked, "out": there.way, "slider": slider}
        rule_out = rule_back = back_way = 0.0
        if slider is not None:
            rule_out = self._see.gone(name, slider, before, before_all, rules, "go")
        if slider is not None and not there.stopped:
            back = self._moved(index, -asked)
            back_way = back.way
            there = there._replace(stopped=back.stopped, following=max(there.following, back.following))
            now = self._see.rules()
            if slider == name:
                rule_back = self._see.gone(name, slider, before, before_all, now, "go")
            else:
                rule_back = rule_out + self._see.gone(name, slider, before, rules, now, "go back")
        seen = MoveSeen(
            name,
            asked,
            there.way,
            back_way,
            there.following,
            there.stopped,
            slider,
            rule_out,
            rule_back,
            read_to,
            self._step(name),
            self._labels,
        )
        measured |= {"back": back_way, "following": there.following, "stopped": there.stopped}
        measured |= {"rule_out": rule_out, "rule_back": rule_back, "read_to": read_to}
        return judge_move(seen, drives), measured

    def home(self, name: str) -> Done:
        """Home one drive, which alone has power."""
        bench, index = self.session.bench(), NAMES.index(name)
        homing = self._config.drives.each[index].homing
        if homing is None:
            return Judged("ok", ("its encoder is absolute: nothing to home",)), {}
        began, stopped, rules = bench.position[index], "", self._see.rules()
        try:
            with bench.power(name):
                bench.home(homing.timeout)
                bench.wait(HOLD / 2.0)
        except Stopped as why:
            stopped = str(why)
        position = bench.position[index]
        now = self._see.rules()
        way = position - began if rules is None or now is None else now[index] - rules[index]
        seen = stopped or self._see.yes(f"Did slider {self.labelled(name)} stop at its home switch?")
        judged = judge_homing(name, way, position, bool(seen), stopped, self._labels)
        return judged, {"way": way, "position": position, "stopped": stopped}

    def watchdog(self, name: str) -> Done:
        """Let one powered drive hear nothing any more, and see whether it lets go."""
        bench, heartbeat = self.session.bench(), self._config.drives.heartbeat
        try:
            with bench.power(name):
                bench.wait(HOLD / 2.0)
                silence = bench.silence(3.0 * heartbeat + HOLD)
        except Stopped as why:
            return Judged("failed", (str(why),), "repeat this step"), {}
        judged = judge_watchdog(name, silence.seconds, silence.by, silence.said, silence.code)
        return judged, {"seconds": silence.seconds, "said": silence.said}

    # All three.

    def square(self) -> Done:
        """Move the platform around a small square."""
        bench, stopped, deviation = self.session.bench(), "", 0.0
        robot = geometry(self._config.geometry)
        try:
            way, path = moves.square(self._config, bench.position)
        except (KinematicsError, ValueError) as error:
            return Judged("failed", (str(error),), REMEDY), {}
        half = len(path) // 2
        rules = self._see.rules()
        corner = rules
        try:
            with bench.power():
                first = bench.play(moves.SlowMove(way.position[:half], way.velocity[:half]))
                corner = self._see.rules()
                rest = moves.SlowMove(way.position[half:] - way.position[half - 1], way.velocity[half:])
                second = bench.play(rest)
            poses = forward(robot, np.concatenate([first.measured, second.measured]))[:, :2]
            apart = np.linalg.norm(poses[:, None, :] - path[None, ::4, :2], axis=2).min(axis=1)
            deviation = float(apart.max())
        except Stopped as why:
            stopped = str(why)
        seen = bool(stopped) or self._see.square(way.position[half - 1], rules, corner)
        following = dict(zip(NAMES, bench.worst, strict=True))
        judged = judge_square(deviation, bench.worst, seen, stopped, self._labels)
        return judged, {"deviation": deviation, "missed_cycles": bench.missed, **following}

    def kind(self) -> Done:
        """Tell whether the robot is of the configured kind, by a mark that is measured from outside."""
        return KindStep(self.session, self._see).run()

    def _moved(self, index: int, way: float) -> _Moved:
        """Move one slider, its drive alone with power; it has none afterwards."""
        bench, stopped = self.session.bench(), ""
        before = bench.position[index]
        try:
            with bench.power(NAMES[index]):
                bench.play(moves.of_slider(index, way, self._config.limits.slider, self._config.period))
        except Stopped as why:
            stopped = str(why)
        bench.wait(HOLD / 10.0)
        return _Moved(bench.position[index] - before, bench.worst[index], stopped)

    def _way(self, index: int) -> float:
        """Return how far to move a slider [m]: away from the limit of its travel, where it is known where it is."""
        bench = self.session.bench()
        beyond = bench.position[index] + 2.0 * moves.DISTANCE > self._config.limits.slider.positions[index][1]
        return -moves.DISTANCE if beyond and bench.feedback.homed[index] else moves.DISTANCE

    def _step(self, name: str) -> float:
        return 1.0 / self._config.drives.each[NAMES.index(name)].counts_per_metre


class _Moved(NamedTuple):
    """What a drive said of a way."""

    way: float
    following: float
    stopped: str
