"""Thousands of goals with sliders that lag, stick and are measured with noise: none is done that is not there.

TRIRAIL_ARRIVALS=10000 pytest --log-cli-level=info tests/control/test_arrivals.py    # the suite takes fewer
"""

from __future__ import annotations

import logging
import math
import os
import random
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from control_rig import CONFIG, ControlRig, PerfectDrives
from trirail.config import geometry
from trirail.errors import KinematicsError
from trirail.kinematics.robot import forward, inverse
from trirail.motion.runs import MotionState
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.messages import Notice
from trirail.wire.packets import Request
from trirail.wire.vocabulary import Command, Mode
from trirail_drivers.interface import Feedback, PowerState, Triple

log = logging.getLogger(__name__)

GOALS = int(os.environ.get("TRIRAIL_ARRIVALS", "300"))
EACH = 30
"""So many goals a robot gets; the next one has other sliders."""
RATE = 200
MOST_CYCLES = 1000
"""No goal takes longer."""
WINDOWS = msgspec.structs.replace(CONFIG.limits.in_position, dwell=0.025, timeout=0.8)
DWELL, TIMEOUT = round(WINDOWS.dwell * RATE), round(WINDOWS.timeout * RATE)
ROBOT = geometry(CONFIG.geometry)
CONFIGURED = msgspec.structs.replace(
    CONFIG,
    loop=msgspec.structs.replace(CONFIG.loop, rate_hz=RATE),
    limits=msgspec.structs.replace(
        CONFIG.limits,
        in_position=WINDOWS,
        slider=msgspec.structs.replace(CONFIG.limits.slider, following_error=0.5),  # lagging is no fault here
    ),
)
OFF, ON = (PowerState.SWITCH_ON_DISABLED,) * 3, (PowerState.OPERATION_ENABLED,) * 3


class Slider:
    """One that is behind, sticks until it is pulled far enough, and is measured with noise."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        lag = chance.choice((0.0, 0.004, chance.uniform(0.0, 0.2)))
        self._share = 1.0 - math.exp(-1.0 / (RATE * lag)) if lag else 1.0
        self._breaks_away = chance.choice((0.0, 0.0, chance.uniform(0.0, 2e-4)))
        self._noise = chance.choice((0.0, chance.uniform(0.0, 3e-5), chance.uniform(0.0, 7e-5)))
        self._sticks = False
        self._place = self.measured = 0.0

    def follow(self, setpoint: float) -> None:
        """Go on by a cycle."""
        gap = setpoint - self._place
        self._sticks = abs(gap) <= self._breaks_away if self._sticks else abs(gap) <= 0.2 * self._breaks_away
        if not self._sticks:
            self._place += self._share * gap
        self.measured = self._place + self._chance.gauss(0.0, self._noise)


class Sliders(PerfectDrives):
    """Three of them, with power and a bus that loses an answer now and then: trirail_drivers.interface.DriveGroup."""

    def __init__(self, chance: random.Random) -> None:
        super().__init__()
        self._chance = chance
        self._sliders = [Slider(chance) for _ in range(3)]
        self._loses = chance.choice((0.0, 0.05))
        self._followed = self._written = (0.0, 0.0, 0.0)
        self._said = Feedback((0.0, 0.0, 0.0), OFF, None)

    def sync(self) -> None:
        """Move, by the setpoints of the cycle before the last one, and measure."""
        position, age = list(self._said.position), list(self._said.age)
        for i, slider in enumerate(self._sliders):
            slider.follow(self._followed[i])
            if self._chance.random() < self._loses and age[i] < 3:
                age[i] += 1
            else:
                position[i], age[i] = slider.measured, 0
        a, b, c = position
        u, v, w = age
        self._said = self._said._replace(position=(a, b, c), age=(u, v, w))
        self._followed = self._written

    def read(self) -> Feedback:
        """See trirail_drivers.interface.DriveGroup."""
        return self._said

    def write(self, position: Triple, velocity: Triple) -> None:
        """See trirail_drivers.interface.DriveGroup."""
        self._written = position

    def enable(self, alone: str | None = None) -> None:
        """Have power at once."""
        assert alone is None
        self._said = self._said._replace(state=ON)


class Target(NamedTuple):
    """Where a goal leads, both ways."""

    sliders: np.ndarray[tuple[int], np.dtype[np.float64]]
    pose: np.ndarray[tuple[int], np.dtype[np.float64]]

    @classmethod
    def of(cls, goal: Goal) -> Target:
        if isinstance(goal, SlidersGoal):
            sliders = np.array(goal.position)
            return cls(sliders, forward(ROBOT, sliders))
        assert isinstance(goal, PoseGoal)
        pose = np.array((goal.x, goal.y, goal.phi))
        return cls(inverse(ROBOT, pose).position, pose)

    def holds(self, measured: Triple) -> bool:
        """Whether what is measured is in every window."""
        try:
            pose = forward(ROBOT, np.array(measured), near=self.pose)
        except KinematicsError:
            return False
        off = np.abs(measured - self.sliders) <= WINDOWS.sliders
        return bool(off.all() and (np.abs(pose - self.pose) <= WINDOWS.pose).all())


class Session(ControlRig):
    """A robot under goals, in simulated time; keeps what was measured and commanded in every cycle."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.measured: list[Triple] = [(0.0, 0.0, 0.0)]
        self.commanded: list[MotionState] = []
        self.ended: dict[str, tuple[Notice, int]] = {}
        self.sent: dict[str, Goal] = {}
        self.since: dict[str, int] = {}
        super().__init__(CONFIGURED, Sliders(self.chance))
        self.commanded.append(self.control.commanded)
        self.enable()

    def cycle(self, request: Request | None = None) -> None:
        """Run one, with a request or without."""
        super().cycle(request)
        self.measured.append(self.control.measured.feedback.position)
        self.commanded.append(self.control.commanded)
        for said in self.notices:
            if said.kind == "goal":
                assert said.id is not None
                assert said.id not in self.ended, f"{said.id} has ended twice"
                self.ended[said.id] = said, self.control.cycles
        self.notices.clear()

    def begin(self, goal: Goal) -> str:
        """Send a goal; return its id."""
        name = f"g{len(self.sent)}"
        self.sent[name] = goal
        self.since[name] = self.control.cycles
        self.post(name, goal)
        return name

    def any_goal(self, blend: float | None = None) -> Goal:
        """Return one near where the robot is."""
        x, y, phi = self.control.commanded.pose
        x, y = (max(-0.03, min(0.03, at + self.chance.uniform(-0.008, 0.008))) for at in (x, y))
        phi = max(-0.2, min(0.2, phi + self.chance.uniform(-0.06, 0.06)))
        if blend is None and self.chance.random() < 0.25:
            a, b, c = inverse(ROBOT, np.array((x, y, phi))).position.tolist()
            return SlidersGoal((a, b, c))
        return PoseGoal(x, y, phi, blend=blend)

    def turn(self) -> None:
        """Send a goal, and let it end: by itself, or by what comes while it moves or settles."""
        chance = self.chance
        kind = chance.random()
        name = self.begin(self.any_goal(blend=0.002 if kind < 0.1 else None))
        if kind < 0.3:
            self.cycles(chance.randrange(1, 120))
        if kind < 0.2:
            name = self.begin(self.any_goal())
        elif kind < 0.3 and name not in self.ended:
            self.order(chance.choice((Command.STOP, Command.PAUSE)))
            self.until(lambda: self.mode is not Mode.STOPPING, MOST_CYCLES)
            self.order(Command.RESUME)
        self.until(lambda: name in self.ended, MOST_CYCLES)


def judged(session: Session) -> Iterator[str]:
    """Judge every end by what was measured; yield how each went."""
    for name, (said, cycle) in session.ended.items():
        goal = session.sent[name]
        if said.residual is None:
            passed = said.outcome == "done" and isinstance(goal, PoseGoal) and goal.blend is not None
            assert passed or said.outcome in ("preempted", "stopped"), said
            yield "passed" if passed else str(said.outcome)
            continue
        target = Target.of(goal)
        end = cycle  # the cycle in which the path ended: since then the robot has been told to stand there
        while session.commanded[end - 1].at_rest and np.allclose(
            session.commanded[end - 1].pose, target.pose, atol=1e-9
        ):
            end -= 1
        end = max(end, session.since[name] + 2)  # where the robot stood before: the way begins once it is planned
        inside = [target.holds(place) for place in session.measured[end + 1 : cycle + 1]]
        streaks = [all(inside[n - DWELL : n]) for n in range(DWELL, len(inside) + 1)]
        if said.outcome == "done":
            assert streaks[-1], f"{name} is not there: {said}"
            assert not any(streaks[:-1]), f"{name} was there before: {said}"
            assert said.settle == pytest.approx((cycle - DWELL + 1 - end) / RATE, abs=1.001 / RATE)
            yield "done" if inside[0] else "done late"
        else:
            assert said.outcome == "unsettled"
            assert not any(streaks), f"{name} was there: {said}"
            assert len(inside) in (TIMEOUT, TIMEOUT + 1)
            yield "unsettled"


def played(seed: int) -> Counter[str]:
    """Play sessions from this seed on, and judge every end; return how many went how."""
    kinds: Counter[str] = Counter()
    sent = 0
    while sent < GOALS:
        session = Session(seed)
        seed += 1
        while len(session.sent) < EACH:
            session.turn()
        sent += len(session.sent)
        assert session.ended.keys() == session.sent.keys()
        kinds += Counter(judged(session))
    log.info("%d goals: %s", sent, ", ".join(f"{count} {kind}" for kind, count in kinds.most_common()))
    assert kinds.total() == sent
    return kinds


@pytest.mark.long
def test_not_one_false_done_and_none_missing() -> None:
    kinds = played(0)
    assert all(kinds[kind] for kind in ("done", "done late", "unsettled", "preempted", "stopped", "passed")), kinds


@pytest.mark.generated(3158591621)
@pytest.mark.long
def test_nor_in_any_other_session(seed: int) -> None:
    played(seed)
