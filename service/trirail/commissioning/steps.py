"""The steps of a commissioning: each asks, moves or looks, and returns what is to be thought of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import can
import numpy as np
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import Carriages

from trirail.commissioning import drives_told, moves
from trirail.commissioning.bench import FOLLOWING, Bench, Stopped
from trirail.commissioning.judgement import (
    Judged,
    MoveSeen,
    PushSeen,
    judge_homing,
    judge_move,
    judge_power,
    judge_push,
    judge_square,
    judge_watchdog,
)
from trirail.commissioning.person import Person, Question, choose, number
from trirail.commissioning.report import Number
from trirail.config import Config, geometry
from trirail.errors import KinematicsError
from trirail.kinematics.algebra import Array
from trirail.kinematics.robot import forward

HOLD = 1.0
"""How long a drive holds its slider when it gets power for the first time [s]."""
PUSH = 0.010
"""How far a slider is best pushed by hand [m]."""
SEEN = 0.00005
"""How far a simulated slider must have gone for somebody to see it [m]."""
IDLE = 0.01
"""How often it is looked for an answer while no drive has been set up [s]."""

Done = tuple[Judged, dict[str, Number]]
"""What is to be thought of a step, and what was measured in it."""


class Place(NamedTuple):
    """Where all this happens."""

    config: Config
    bus: can.BusABC
    make_bench: Callable[[], Bench]
    """Sets the drives up and begins their cycle."""
    rules: Carriages | None
    """Where the sliders really are, of simulated drives."""
    person: Person


class Steps:
    """What can be done with the drives, in whatever order."""

    def __init__(self, place: Place) -> None:
        self._config = place.config
        self._place = place
        self._person = place.person
        self._bench: Bench | None = None
        self._told: list[dict[str, object]] = []
        self._read_to: float | None = None

    # Without power.

    def bus(self) -> Done:
        """Ask every drive who it is."""
        drives = self._config.drives
        inspect = PROTOCOLS[drives.protocol].inspect
        if inspect is None:
            words = (f"drives of protocol {drives.protocol} have no objects to be shown; the next step finds them",)
            return Judged("ok", words), {}
        self._told = inspect(self._place.bus, drives, self._config.period, time.monotonic, apply=False)
        lines = tuple(line for each in self._told for line in drives_told.identity(each))
        refused = tuple(f"drive {each['name']}: {each['refused']}" for each in self._told if each["refused"])
        measured: dict[str, Number] = {}
        for each in self._told:
            for key in ("node", "device_type", "vendor", "product", "revision", "serial", "modes", "way"):
                if (value := each.get(key)) is not None:
                    measured[f"{each['name']}.{key}"] = value if isinstance(value, int | str) else str(value)
        if refused:
            remedy = (
                "no answer: supply, wiring, 60 Ω across the unpowered bus, the same bitrate everywhere, node ids; "
                "else what the line says"
            )
            return Judged("wrong", (*lines, *refused), remedy), measured
        return Judged("ok", lines), measured

    def set_up(self) -> Done:
        """Set all drives up, without power, and begin their cycle."""
        self._bench = None
        try:
            self._bench = self._place.make_bench()
        except DriveError as error:
            return Judged("failed", (str(error),), "what the line says; no drive has power"), {}
        self._bench.wait(HOLD / 2.0)
        if (fault := self._bench.feedback.fault) is not None:
            try:
                self._bench.clear()
            except Stopped as stopped:
                return Judged("failed", (str(stopped),), "remove the cause, then repeat this step"), {}
            return Judged("ok", (f"was in fault, and could be reset: {fault.message}",)), {}
        written = sum(len(_differences(each)) for each in self._told)
        words = (f"set up, {written} values written, nothing stored; SYNC runs at {self._config.loop.rate_hz} Hz",)
        return Judged("ok", words), {"written": written}

    def changes_of_set_up(self) -> list[str]:
        """Return what the set-up would change, as lines: what is so of several drives once."""
        of: dict[str, list[str]] = {}
        for each in self._told:
            for line in drives_told.differences(each, applied=False):
                of.setdefault(line.strip(), []).append(str(each["name"]))
        return [f"{', '.join(names)}: {line}" for line, names in of.items()]

    def push(self, name: str) -> Done:
        """Have a slider pushed by hand, without power."""
        bench, index = self._ready(), NAMES.index(name)
        read_to = self._ask_read_to()
        angle = np.degrees(geometry(self._config.geometry).legs[index].rail_angle)
        self._person.tell(
            f"  Put the rule along rail {name}, its numbers rising towards {angle:.0f}° (0° is x, 90° is y)."
        )
        before, counted = self._reading(index), bench.position
        if self._place.rules is None:
            self._person.tell(f"  Push slider {name} by {PUSH * 1e3:g} mm or more, that way, and let it go.")
        else:
            self._place.rules.push(index, PUSH)
            bench.wait(HOLD / 10.0)
            self._person.tell(f"  A simulated hand has pushed slider {name} that way.")
        after = self._reading(index)
        a, b, c = (now - was for now, was in zip(bench.position, counted, strict=True))
        seen = PushSeen(name, after - before, (a, b, c), read_to, self._step(name))
        return judge_push(seen, self._config.drives), {"rule": seen.rule, "A": a, "B": b, "C": c, "read_to": read_to}

    # With power, one drive alone.

    def power(self, name: str) -> Done:
        """Give one drive power, let it hold its slider, and take it off."""
        bench, stopped = self._ready(), ""
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
        read_to = self._ask_read_to()
        asked = self._way(index)
        before = self._reading(index)
        before_all = self._rules()
        there = self._moved(index, asked)
        rules = self._rules()
        slider = self._which(before_all, rules)
        measured: dict[str, Number] = {"asked": asked, "out": there.way, "following": there.following, "slider": slider}
        if slider in (None, name):
            rule_out = self._reading(index) - before if slider else 0.0
        else:
            other = NAMES.index(slider)
            away = f"How far did slider {slider} go, in mm, above 0 in its positive direction?"
            rule_out = self._number(away, rules[other] - before_all[other] if rules and before_all else None)
        rule_back = 0.0
        if slider is not None and not there.stopped:
            back = self._moved(index, -asked)
            there = there._replace(stopped=back.stopped, following=max(there.following, back.following))
            if slider == name:
                rule_back = self._reading(index) - before
        seen = MoveSeen(
            name,
            asked,
            there.way,
            there.following,
            there.stopped,
            slider,
            rule_out,
            rule_back,
            read_to,
            self._step(name),
        )
        measured |= {"rule_out": rule_out, "rule_back": rule_back, "stopped": there.stopped, "read_to": read_to}
        return judge_move(seen, drives), measured

    def home(self, name: str) -> Done:
        """Home one drive, which alone has power."""
        bench, index, homing = self._ready(), NAMES.index(name), self._config.drives.each[NAMES.index(name)].homing
        if homing is None:
            return Judged("ok", ("its encoder is absolute: nothing to home",)), {}
        began, stopped, rules = bench.position[index], "", self._rules()
        try:
            with bench.power(name):
                bench.home(homing.timeout)
                bench.wait(HOLD / 2.0)
        except Stopped as why:
            stopped = str(why)
        position = bench.position[index]
        now = self._rules()
        way = position - began if rules is None or now is None else now[index] - rules[index]
        seen = stopped or self._yes(f"Did slider {name} stop at its home switch?")
        judged = judge_homing(name, way, position, bool(seen), stopped)
        return judged, {"way": way, "position": position, "stopped": stopped}

    def watchdog(self, name: str) -> Done:
        """Let one powered drive hear nothing any more, and see whether it lets go."""
        bench, heartbeat = self._ready(), self._config.drives.heartbeat
        try:
            with bench.power(name):
                bench.wait(HOLD / 2.0)
                silence = bench.silence(3.0 * heartbeat + HOLD)
        except Stopped as why:
            return Judged("failed", (str(why),), "repeat this step"), {}
        judged = judge_watchdog(name, silence.seconds, silence.by, silence.said, heartbeat)
        return judged, {"seconds": silence.seconds, "said": silence.said}

    # All three.

    def square(self) -> Done:
        """Move the platform around a small square."""
        bench, stopped, deviation = self._ready(), "", 0.0
        robot = geometry(self._config.geometry)
        try:
            way, path = moves.square(self._config, bench.position)
        except (KinematicsError, ValueError) as error:
            remedy = "move the sliders, by hand or by their homing, to where the platform is well within its limits"
            return Judged("failed", (str(error),), remedy), {}
        half = len(path) // 2
        rules = self._rules()
        corner = rules
        try:
            with bench.power():
                first = bench.play(moves.Way(way.position[:half], way.velocity[:half]))
                corner = self._rules()
                rest = moves.Way(way.position[half:] - way.position[half - 1], way.velocity[half:])
                second = bench.play(rest)
            poses = forward(robot, np.concatenate([first.measured, second.measured]))[:, :2]
            apart = np.linalg.norm(poses[:, None, :] - path[None, ::4, :2], axis=2).min(axis=1)
            deviation = float(apart.max())
        except Stopped as why:
            stopped = str(why)
        seen = bool(stopped) or self._saw_square(way.position[half - 1], rules, corner)
        following = dict(zip(NAMES, bench.worst, strict=True))
        judged = judge_square(deviation, bench.worst, seen, stopped)
        return judged, {"deviation": deviation, "missed_cycles": bench.missed, **following}

    # What they share.

    def _ready(self) -> Bench:
        if self._bench is None:
            raise RuntimeError("the drives have not been set up")
        return self._bench

    def idle(self) -> None:
        """Wait a little, and keep the drives alive."""
        if self._bench is None:
            time.sleep(IDLE)
        else:
            self._bench.cycle()

    def _moved(self, index: int, way: float) -> _Moved:
        """Move one slider, its drive alone with power; it has none afterwards."""
        bench, stopped = self._ready(), ""
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
        bench = self._ready()
        beyond = bench.position[index] + 2.0 * moves.DISTANCE > self._config.limits.slider.position[1]
        return -moves.DISTANCE if beyond and bench.feedback.homed[index] else moves.DISTANCE

    def _step(self, name: str) -> float:
        return 1.0 / self._config.drives.each[NAMES.index(name)].counts_per_metre

    def _rules(self) -> tuple[float, ...] | None:
        return None if self._place.rules is None else self._place.rules.read()

    def _ask_read_to(self) -> float:
        """Return how finely the rule can be read [m]; asked once."""
        if self._read_to is None:
            text = "To how many mm can you read your rule or indicator? (a steel rule 0.5, a dial indicator 0.01)"
            question = Question(text, None if self._place.rules is None else "0.01")
            self._read_to = number(self._person, self.idle, question, 0.0001, 5.0) / 1e3
        return self._read_to

    def _reading(self, index: int) -> float:
        rules = self._rules()
        text = f"What does the rule at slider {NAMES[index]} read now, in mm?"
        return self._number(text, None if rules is None else rules[index])

    def _number(self, text: str, simulated: float | None) -> float:
        default = None if simulated is None else f"{simulated * 1e3 + 0.0:.2f}"
        return number(self._person, self.idle, Question(text, default)) / 1e3

    def _which(self, before: tuple[float, ...] | None, now: tuple[float, ...] | None) -> str | None:
        """Ask which slider has moved, from what rules read before to what they read now."""
        default, text = None, "Which slider moved: A, B, C, or n for none?"
        if before is not None and now is not None:
            ways = [abs(here - was) for here, was in zip(now, before, strict=True)]
            most = ways.index(max(ways))
            default = NAMES[most] if ways[most] > SEEN else "n"
        choices = {each: f"slider {each}" for each in NAMES} | {"n": "none of them"}
        answer = choose(self._person, self.idle, Question(text, default), choices)
        return None if answer == "n" else answer

    def _yes(self, text: str) -> bool:
        question = Question(f"{text} y/n", None if self._place.rules is None else "y")
        return choose(self._person, self.idle, question, {"y": "yes", "n": "no"}) == "y"

    def _saw_square(self, wanted: Array, began: tuple[float, ...] | None, corner: tuple[float, ...] | None) -> bool:
        """Ask whether the platform went around the square; simulated sliders are compared at its far corner."""
        text = f"Did the platform go {moves.DISTANCE * 1e3:g} mm along x, then along y, then back both? y/n"
        default = None
        if began is not None and corner is not None:
            went = np.array(corner) - np.array(began)
            default = "y" if np.abs(went - wanted).max() < FOLLOWING else "n"
        return choose(self._person, self.idle, Question(text, default), {"y": "yes", "n": "no"}) == "y"


class _Moved(NamedTuple):
    """What a drive said of a way."""

    way: float
    following: float
    stopped: str


def _differences(told: dict[str, object]) -> list[object]:
    found = told.get("differences")
    return found if isinstance(found, list) else []
