"""Random sessions of two users who use everything at once: one answer each, one end each, and no fault.

They send goals with marks, pulses, input edges, blends and `valid_for`, repeat ids, renew jogs and tracks too late,
take the lease from each other, check, pause and change the rate, several of these in one cycle, with a late planner.
"""

from __future__ import annotations

import itertools
import random
from collections import Counter
from typing import Literal

import numpy as np
import pytest
from control.sessions import Session, assert_within_limits
from control.test_long_sessions import robots
from control.test_outputs import INPUTS, OUTPUTS, with_outputs
from control_rig import PerfectDrives, carried
from trirail.config import Config
from trirail.control.modes import PAUSED, ModeEvent
from trirail.wire.event_codes import EventCode
from trirail.wire.goals import Goal, MoveGoal, PoseGoal, SlidersGoal, TrackGoal, VelocityGoal
from trirail.wire.marks import Crossing, Mark, StopAt
from trirail.wire.packets import (
    Accepted,
    Checked,
    CheckRequest,
    CommandDone,
    CommandRequest,
    Disturbance,
    GoalRequest,
    Refused,
    Request,
)
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, Mode, ReleaseLease, SetOutput, Stop

STEPS = 80
USERS = ("ann", "bob")
NUMBERS = (1, 1, 1, 2, 3)
"""Requests in one cycle."""
DELAYS = (1, 1, 1, 2, 5, 20, 80)
"""Cycles that the planner thinks about a goal."""
WAITS = (0, 1, 3, 10, 30, 76, 150, 300, 600, 1200)
"""Cycles from one step to the next."""
RATES = (0.0, 0.5, 1.0, 1.0, 1.8)
COMMANDS = {
    Command.STOP: 3,
    Command.PAUSE: 5,
    Command.RESUME: 9,
    Command.OVERRIDE: 8,
    Command.SET_OUTPUT: 4,
    Command.ACQUIRE: 4,
    Command.RELEASE: 3,
    Command.DISABLE: 1,
    Command.QUICK_STOP: 1,
    Command.ENABLE: 1,
    Command.RESET: 1,
}
Asked = GoalRequest | CheckRequest | CommandRequest
INPUT_BIT = INPUTS["part"].bit


class TwoUsers(Session):
    """A session that knows who has asked for what, and judges each cycle."""

    def __init__(self, chance: random.Random, config: Config) -> None:
        self.chance = chance
        self.asked: dict[int, Asked] = {}
        """Requests that have not been answered, by ticket."""
        self.goals: dict[str, GoalRequest] = {}
        """First request of each id."""
        self._serial = itertools.count(1)
        self._judged = 0
        self._seen_lease: str | None = None
        super().__init__(config)

    def cycle(self, request: Request | None = None) -> None:
        was, before = self.control.state, self.kept[-1] if self.kept else None
        self.asked |= {each.ticket: each for each in (*self.more, request) if isinstance(each, Asked)}
        super().cycle(request)
        lease, begins = self.control.lease.user, False
        for answer in self.answers[self._judged :]:
            assert isinstance(answer, Accepted | Checked | CommandDone | Refused)
            asked = self.asked.pop(answer.ticket)  # each is answered once
            if isinstance(answer, Accepted):
                assert isinstance(asked, GoalRequest)
                assert {lease, self._seen_lease} & {None, asked.user}, (asked, lease)
            begins = begins or isinstance(answer, Accepted)
            begins = begins or (isinstance(answer, CommandDone) and answer.name is Command.RESUME)
        self._judged, self._seen_lease = len(self.answers), lease
        if before is not None and was == PAUSED and not begins:
            assert self.mode is not Mode.MOVING
            assert np.abs(self.kept[-1]["commanded_pose"] - before["commanded_pose"]).max() < 1e-12

    def random_request(self) -> Asked:
        chance, ticket, user = self.chance, 1000 + next(self._serial), self.chance.choice(USERS)
        what = chance.random()
        if what < 0.7:
            return self._random_goal(ticket, user)
        if what < 0.73:
            return CheckRequest(ticket, user, random_goal(chance))
        (name,) = chance.choices(tuple(COMMANDS), tuple(COMMANDS.values()))
        return CommandRequest(ticket, user, name, self._random_content(name))

    def _random_goal(self, ticket: int, user: str) -> GoalRequest:
        chance, goal = self.chance, random_goal(self.chance)
        name, current = f"g{ticket}", self.control.ledger.goal
        if current is not None and current.kind.renewed and chance.random() < 0.5:
            name, user = current.id, chance.choice((current.user, user))
            goal = random_renewed(chance) if chance.random() < 0.7 else goal
        elif self.goals and chance.random() < 0.08:
            name = chance.choice(list(self.goals)[-4:])
        age = chance.choice((0.0, 0.0, 0.002, 0.05))
        withdrawn = "stop by ann" if chance.random() < 0.02 else None
        request = GoalRequest(ticket, user, name, goal, round((self.now - age) * 1e9), withdrawn)
        self.goals.setdefault(name, request)
        return request

    def _random_content(self, name: Command) -> CommandContent:
        chance = self.chance
        match name:
            case Command.OVERRIDE:
                return carried(name, chance.choice(RATES))
            case Command.STOP:
                return Stop(chance.choice([None, None, *list(self.goals)[-3:]]))
            case Command.SET_OUTPUT:
                return SetOutput(chance.choice((*OUTPUTS, "pump")), chance.random() < 0.5)
            case Command.ACQUIRE:
                which = chance.choice((None, "a", "b", "c"))
                return AcquireLease(which, chance.choice((0.1, 0.3, 2.0)), chance.random() < 0.4)
            case Command.RELEASE:
                return ReleaseLease(chance.choice((None, None, "a", "b")))
            case _:
                return carried(name)


def random_marks(chance: random.Random) -> tuple[Mark, ...]:
    """Up to three places of outputs, which may be missing on the path."""

    def one() -> Mark:
        output, value = chance.choice(tuple(OUTPUTS)), chance.random() < 0.7
        width = chance.choice((None, None, 0.002, 0.05, 1.0))
        match chance.choice((0, 0, 0, 1, 2, 3, 4, 5)):
            case 0:
                return Mark(output, value, at_path_fraction=chance.random(), pulse_width=width)
            case 1:
                return Mark(output, value, after_start=chance.uniform(0.0, 0.01), pulse_width=width)
            case 2:
                return Mark(output, value, before_target=chance.uniform(0.0, 0.01), pulse_width=width)
            case 3:
                return Mark(output, value, at=Crossing(x=chance.uniform(-0.02, 0.02)), pulse_width=width)
            case 4:
                return Mark(output, value, start=chance.uniform(0.0, 0.005), end=chance.uniform(0.006, 0.01))
            case _:
                return Mark(output, value, start=0.0, increment=chance.choice((0.002, 0.01)), pulse_width=0.003)

    return tuple(one() for _ in range(chance.choice((0, 0, 1, 1, 2, 3))))


def random_renewed(chance: random.Random) -> Goal:
    """A jog or a track, from which the platform soon comes back within its limits."""
    x, y, phi = (chance.uniform(-0.08, 0.08), chance.uniform(-0.08, 0.08), chance.uniform(-0.4, 0.4))
    if chance.random() < 0.5:
        return VelocityGoal(x, y, phi, timeout=chance.choice((0.02, 0.1, 0.3)))
    return TrackGoal(x, y, phi, velocity=(y, x, 0.0), timeout=chance.choice((0.02, 0.1, 0.3)))


def random_goal(chance: random.Random) -> Goal:
    """A goal of any kind, reachable or not, with everything that its kind has."""
    if chance.random() < 0.12:
        return random_renewed(chance)
    pose = chance.uniform(-0.06, 0.06), chance.uniform(-0.06, 0.06), chance.uniform(-0.5, 0.4)
    speed, blend = chance.choice((1.0, 1.0, 0.3)), chance.choice((None, None, 0.0, 0.005, 0.03))
    valid_for = chance.choice((None, None, None, 0.02, 0.2, 2.0))
    marks = random_marks(chance)
    edge = StopAt("part", chance.choice(("rising", "falling"))) if chance.random() < 0.15 else None
    kind = chance.random()
    if kind < 0.5:
        return PoseGoal(*pose, speed=speed, blend=blend, valid_for=valid_for, marks=marks, stop_at=edge)
    if kind < 0.8:
        origin: Literal["commanded", "measured"] = "measured" if chance.random() < 0.2 else "commanded"
        x, y, phi = np.array(pose) / 3.0
        return MoveGoal(
            x,
            y,
            phi,
            origin=origin,
            speed=speed,
            blend=blend,
            valid_for=valid_for,
            marks=marks,
            stop_at=edge,
        )
    sliders = chance.uniform(-0.06, 0.06), chance.uniform(-0.06, 0.06), chance.uniform(-0.06, 0.06)
    return SlidersGoal(sliders, speed=speed, valid_for=valid_for, marks=marks, stop_at=edge)


@pytest.mark.timeout(3600)
@pytest.mark.generated(*range(12))
def test_everything_that_two_users_ask_for_is_answered_once_and_ends_once(seed: int) -> None:
    chance = random.Random(seed)
    session = TwoUsers(chance, with_outputs(chance.choice(list(robots().values()))))
    drives = session.driver
    assert isinstance(drives, PerfectDrives)
    for _ in range(STEPS):
        session.planner.delay = chance.choice(DELAYS)
        for _ in range(chance.choice(NUMBERS)):
            session.more.append(session.random_request())
        if chance.random() < 0.01:
            what = chance.choice((ModeEvent.GATEWAY_LOST, ModeEvent.LATE))
            session.more.append(Disturbance(what.name, "a disturbance"))
        if chance.random() < 0.15:
            drives.inputs = (0, (1 << INPUT_BIT) * chance.randrange(2), 0)
        session.cycles(1 + chance.choice(WAITS))
        bring_back(session)
    session.cycles(20)
    session.order(Command.OVERRIDE, 1.0)
    session.order(Command.STOP)
    session.until(lambda: session.mode in (Mode.HOLDING, Mode.DISABLED, Mode.FAULT), 3000)
    session.until(lambda: not session.asked, 1000)
    judge(session)


def bring_back(session: TwoUsers) -> None:
    """Sometimes bring back a robot that is out of service."""
    if session.chance.random() < 0.5 and session.mode in (Mode.FAULT, Mode.DISABLED):
        name = Command.RESET if session.mode is Mode.FAULT else Command.ENABLE
        session.order(name)
        session.cycles(3)


def judge(session: TwoUsers) -> None:
    """See that the whole session was as it must be."""
    assert_within_limits(session.config, session.records)
    said = {notice.message for notice in session.notices if notice.kind == "fault"}
    assert said <= {f"quick_stop by {user}" for user in USERS}
    ends = [notice for notice in session.notices if notice.kind == "goal"]
    outcomes = Counter(notice.id for notice in ends)
    assert set(outcomes.values()) <= {1}
    assert set(outcomes) == set(session.goals)
    done = {notice.id for notice in ends if notice.outcome == "done" and notice.event_code is EventCode.ARRIVED}
    switches = [switch for notice in session.notices for switch in notice.marks if not switch.closed]
    times = Counter((switch.goal, switch.mark, switch.value) for switch in switches)
    for goal, request in session.goals.items():
        for number, mark in enumerate(request.goal.marks):
            if mark.increment is None:
                assert times[goal, number, mark.value] <= 1, (goal, mark)
            if goal in done and mark.increment is None:
                assert times[goal, number, mark.value] == 1, (goal, mark)
