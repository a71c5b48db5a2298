"""The lease: one holder at most, whose goals and commands alone move the robot; what ends it stops the robot."""

from __future__ import annotations

import itertools
import random
from collections import Counter
from typing import Literal, NamedTuple

import msgspec
import pytest
from control_rig import CONFIG, ControlRig, carried
from trirail.config import ControlTable
from trirail.control.lease import REMEMBERED_IDS, LeaseArbiter
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.goals import Goal, PoseGoal, VelocityGoal
from trirail.wire.packets import Accepted, Answer, CommandDone, CommandRequest, GoalRequest, Refused, Request
from trirail.wire.vocabulary import AcquireLease, Command, CommandContent, LeasePolicy, Mode, ReleaseLease

REQUIRED = msgspec.structs.replace(CONFIG, control=ControlTable(lease="required"))
EVERYBODYS = {"stop", "quick_stop", "disable", "acquire", "release"}
FAR = PoseGoal(x=0.05, y=0.0, phi=0.0)
JOG = VelocityGoal(x=0.01, y=0.0, phi=0.0, timeout=10.0)
HELD = 1000
"""Cycles of a lease's usual time-out."""


def said_with(name: str, lease: str | None, timeout: float, force: bool) -> CommandContent:
    """What a command carries that may be about a lease."""
    if name == Command.ACQUIRE:
        return AcquireLease(lease, timeout, force=force)
    return ReleaseLease(lease) if name == Command.RELEASE else carried(name)


class Users:
    """Several users of one robot; each request is answered before the next."""

    def __init__(self, rig: ControlRig) -> None:
        self.rig = rig
        self._tickets = itertools.count(10_000)

    def tell(
        self, user: str, name: str, lease: str | None = None, *, timeout: float = 1.0, force: bool = False
    ) -> Answer:
        ticket = next(self._tickets)
        self.rig.cycle(CommandRequest(ticket, user, Command(name), said_with(name, lease, timeout, force)))
        return self._answer(ticket)

    def send(self, user: str, name: str, goal: Goal = FAR) -> Answer:
        ticket = next(self._tickets)
        self.rig.cycle(GoalRequest(ticket, user, name, goal, round(self.rig.now * 1e9)))
        return self._answer(ticket)

    def _answer(self, ticket: int) -> Answer:
        def found() -> list[Answer]:
            return [answer for answer in self.rig.answers if getattr(answer, "ticket", None) == ticket]

        self.rig.until(lambda: bool(found()))
        return found()[0]


@pytest.fixture
def rig() -> ControlRig:
    return ControlRig()


@pytest.fixture
def users(rig: ControlRig) -> Users:
    rig.enable()
    return Users(rig)


def code(answer: Answer) -> RefusalCode | None:
    return answer.code if isinstance(answer, Refused) else None


def leases(rig: ControlRig) -> list[tuple[str, str | None]]:
    return [(said.message, said.user) for said in rig.notices if said.kind == "lease"]


def begun(rig: ControlRig) -> list[str | None]:
    return [said.goal for said in rig.notices if said.mode == Mode.MOVING]


def test_only_its_holders_goals_move_the_robot(users: Users) -> None:
    assert isinstance(users.tell("ann", "acquire", "l"), CommandDone)
    refused = users.send("bob", "g1")
    assert code(refused) is RefusalCode.LEASED
    assert isinstance(users.send("ann", "g2"), Accepted)
    assert begun(users.rig) == ["g2"]
    assert ("g1", "rejected") in users.rig.outcomes()


@pytest.mark.parametrize("name", Command)
def test_every_command_is_its_holders_but_what_stops_the_robot(users: Users, name: Command) -> None:
    rig = users.rig
    users.tell("ann", "acquire", "l")
    users.send("ann", "g", JOG)
    mode = rig.mode
    answer = users.tell("bob", name)
    if name in ("acquire", "release"):
        assert rig.control.lease.user == "ann"
    elif name in EVERYBODYS:
        assert isinstance(answer, CommandDone)
        assert rig.mode is not Mode.MOVING
    else:
        assert code(answer) is RefusalCode.LEASED
        assert rig.mode is mode
        assert rig.control.override == 1.0


@pytest.mark.parametrize("name", Command)
def test_where_it_is_required_nothing_else_is_taken_without_it(name: Command) -> None:
    users = Users(ControlRig(REQUIRED))
    said = code(users.tell("ann", name))
    assert (said is RefusalCode.NO_LEASE) == (name not in EVERYBODYS - {"release"})
    goal = code(users.send("ann", "g"))
    assert goal is (RefusalCode.NOT_ENABLED if name is Command.ACQUIRE else RefusalCode.NO_LEASE)


def test_without_signs_of_life_the_robot_stops_and_the_lease_is_free(users: Users) -> None:
    rig = users.rig
    users.tell("ann", "acquire", "l")
    users.send("ann", "g", JOG)
    for _ in range(5):
        rig.cycles(HELD // 2)
        assert isinstance(users.tell("ann", "acquire", "l"), CommandDone)
    assert rig.mode is Mode.MOVING
    assert leases(rig) == [("lease acquired by ann", "ann")]
    waited = rig.until(lambda: rig.control.lease.user is None)
    assert abs(waited - HELD) <= 2
    assert leases(rig)[1:] == [("lease of ann has expired: it was not renewed within 1 s", None)]
    rig.until(rig.holds)
    assert ("g", "stopped") in rig.outcomes()
    assert code(users.tell("ann", "acquire", "l")) is RefusalCode.LEASE_OVER
    assert isinstance(users.send("bob", "h"), Accepted)


@pytest.mark.parametrize("ending", ["released", "taken over", "silent"])
def test_whatever_ends_it_stops_what_its_holder_has_under_way_and_what_waits(users: Users, ending: str) -> None:
    rig = users.rig
    users.tell("ann", "acquire", "l")
    users.send("ann", "g0", msgspec.structs.replace(FAR, blend=0.001, speed=0.1))
    users.send("ann", "g1", PoseGoal(x=0.0, y=0.02, phi=0.0))
    assert len(rig.control.ledger.goals) == 2
    if ending == "released":
        assert isinstance(users.tell("ann", "release", "l"), CommandDone)
        assert rig.mode is Mode.HOLDING
    elif ending == "taken over":
        assert code(users.tell("bob", "acquire", "m")) is RefusalCode.LEASED
        assert isinstance(users.tell("bob", "acquire", "m", force=True), CommandDone)
        assert leases(rig)[-1] == ("lease taken over by bob from ann", "bob")
        assert code(users.send("ann", "g2")) in (RefusalCode.LEASED, RefusalCode.STOPPED)
        late = users.tell("ann", "acquire", "l")
        assert code(late) is RefusalCode.LEASE_OVER
        assert isinstance(late, Refused)
        assert late.message == "lease taken over by bob from ann: acquire a new lease"
    else:
        rig.until(lambda: rig.control.lease.user is None)
    rig.until(rig.holds)
    assert {("g0", "stopped"), ("g1", "stopped")} <= set(rig.outcomes())


@pytest.mark.parametrize("under_way", ["goal", "jog", "paused", "homing"])
def test_who_acquires_it_stops_what_others_have_under_way(under_way: str, users: Users) -> None:
    rig = users.rig
    users.send("bob", "g", JOG if under_way == "jog" else FAR)
    if under_way == "paused":
        users.tell("bob", "pause")
    users.tell("ann", "acquire", "l")
    rig.until(rig.holds)
    assert ("g", "stopped") in rig.outcomes()
    assert code(users.tell("ann", "resume")) is RefusalCode.NOT_PAUSED
    assert isinstance(users.send("ann", "h"), Accepted)


def test_what_one_has_under_way_oneself_goes_on_when_one_acquires_it(users: Users) -> None:
    users.send("ann", "g")
    assert isinstance(users.tell("ann", "acquire", "l"), CommandDone)
    assert users.rig.mode is Mode.MOVING
    users.rig.until(users.rig.holds)
    assert ("g", "done") in users.rig.outcomes()


def test_a_goal_that_is_being_planned_when_another_acquires_it_does_not_begin(users: Users) -> None:
    rig = users.rig
    now_ns = round(rig.now * 1e9)
    rig.control.handle(GoalRequest(1, "bob", "g0", FAR, now_ns), now_ns)
    rig.control.handle(GoalRequest(2, "bob", "g1", FAR, now_ns), now_ns)
    rig.cycle()  # the planner has the first, the second waits
    users.tell("ann", "acquire", "l")
    rig.cycles(50)
    assert begun(rig)[1:] == []
    assert [answer.code for answer in rig.answers if isinstance(answer, Refused)][-1] is RefusalCode.LEASED


@pytest.mark.parametrize("ending", ["released", "silent", "taken over"])
def test_goals_that_have_not_begun_when_the_lease_of_their_user_ends_never_begin(ending: str) -> None:
    rig = ControlRig(delay=20)
    rig.enable()
    users = Users(rig)
    users.tell("bob", "acquire", "l")
    if ending == "silent":
        rig.cycles(HELD - 5)
    now_ns = round(rig.now * 1e9)
    for number in range(2):
        rig.control.handle(GoalRequest(number, "bob", f"g{number}", FAR, now_ns), now_ns)
    rig.cycle()  # the planner has the first, the second waits
    if ending == "taken over":
        users.tell("ann", "acquire", "m", force=True)
    elif ending == "released":
        users.tell("bob", "release", "l")
    rig.until(lambda: rig.control.lease.user != "bob", 10)
    rig.cycles(100)
    assert begun(rig) == []
    outcome = "rejected" if ending == "taken over" else "stopped"
    assert rig.outcomes() == [("g0", outcome), ("g1", outcome)]


def test_a_lease_of_another_client_of_the_same_user_is_not_taken_in_silence(users: Users) -> None:
    users.tell("ann", "acquire", "l")
    for user, holder in (("ann", "another client of the same user"), ("bob", "ann")):
        refused = users.tell(user, "acquire", "m")
        assert isinstance(refused, Refused)
        words = f"{holder} holds the lease: wait until it is free, or take it over"
        assert (refused.code, refused.message) == (RefusalCode.LEASED, words)
        refused = users.tell(user, "release", "m")
        assert isinstance(refused, Refused)
        words = f"{holder} holds the lease: only the holder can release it"
        assert (refused.code, refused.message) == (RefusalCode.LEASED, words)
    assert users.rig.control.lease.user == "ann"
    users.tell("ann", "release")  # whichever it is
    assert users.rig.control.lease.user is None


def test_who_does_not_hold_the_lease_releases_nothing_and_is_told_so(users: Users) -> None:
    def said(answer: Answer) -> tuple[RefusalCode, str] | None:
        return (answer.code, answer.message) if isinstance(answer, Refused) else None

    nobody = RefusalCode.NO_LEASE, "no user holds the lease: there is nothing to release"
    assert said(users.tell("bob", "release")) == nobody
    users.tell("ann", "acquire", "l")
    other = RefusalCode.LEASED, "ann holds the lease: only the holder can release it"
    assert said(users.tell("bob", "release")) == other
    assert said(users.tell("bob", "release", "l")) == other
    assert users.rig.control.lease.user == "ann"
    assert isinstance(users.tell("ann", "release", "l"), CommandDone)
    over = RefusalCode.LEASE_OVER, "lease released by ann: there is nothing to release"
    assert said(users.tell("ann", "release", "l")) == over
    assert said(users.tell("ann", "release")) == nobody


def test_ids_of_leases_that_are_over_are_remembered_each_users_own_and_not_for_ever() -> None:
    lease = LeaseArbiter("optional", 0.001)
    for number in range(REMEMBERED_IDS + 1):
        lease.acquire("ann", AcquireLease(f"l{number}"), 0)
        lease.release("ann", ReleaseLease())
    with pytest.raises(RefusedError) as refused:
        lease.acquire("ann", AcquireLease("l1"), 0)
    assert refused.value.code is RefusalCode.LEASE_OVER
    lease.acquire("bob", AcquireLease("l1"), 0)
    lease.release("bob", ReleaseLease())
    lease.acquire("ann", AcquireLease("l0"), 0)
    assert lease.user == "ann"


# ------------------------------------------------------------------ eight clients at random

CLIENTS = [f"u{number}" for number in range(8)]
SLOW = msgspec.structs.replace(CONFIG, loop=msgspec.structs.replace(CONFIG.loop, rate_hz=100))
TIMEOUT = 0.2
Act = Literal["acquire", "sign", "force", "release", "goal", "jog", "stop", "die", "wait"]
ACTS: tuple[Act, ...] = (
    "acquire", "sign", "force", "release", "goal", "goal", "goal", "jog", "stop", "die", "wait", "wait",
)  # fmt: skip


class Expected(NamedTuple):
    """Who is to hold the lease, by what was asked alone."""

    user: str
    id: str
    until: int


class Model:
    """What should be, from the requests and the number of the cycle: written once more, by hand."""

    def __init__(self) -> None:
        self.holds: Expected | None = None
        self.over: set[str] = set()

    def ask(self, act: str, user: str, lease: str, cycle: int) -> None:
        until, holds = cycle + round(TIMEOUT * 100), self.holds
        if act == "release":
            if holds is not None and (holds.user, holds.id) == (user, lease):
                self.over.add(lease)
                self.holds = None
        elif lease in self.over or (holds is not None and act != "force" and holds.id != lease):
            return
        else:
            if holds is not None and holds.id != lease:
                self.over.add(holds.id)
            self.holds = Expected(user, lease, until)

    def pass_time(self, cycle: int) -> None:
        if self.holds is not None and cycle > self.holds.until:
            self.over.add(self.holds.id)
            self.holds = None


class Crowd:
    """Eight clients at one robot, which act at random; after every cycle all is looked at."""

    def __init__(self, seed: int, policy: LeasePolicy) -> None:
        self.rnd, self.policy = random.Random(seed), policy
        self.rig = ControlRig(msgspec.structs.replace(SLOW, control=ControlTable(lease=policy)))
        self.model = Model()
        self.seen: Counter[str] = Counter()
        self._numbers = itertools.count(1)
        self._sender: dict[str, str] = {}
        self._last = dict.fromkeys(CLIENTS, "none")
        """The id of each client's last lease, whether it still holds it or not."""
        self._alive = dict.fromkeys(CLIENTS, True)

    def enable(self) -> None:
        self._last["u0"] = "first"
        self._acquire("u0")
        self._command("u0", Command.ENABLE)
        while self.rig.mode is not Mode.HOLDING:
            self._acquire("u0")

    def act(self) -> None:
        user, act = self.rnd.choice(CLIENTS), self.rnd.choice(ACTS)
        self._alive[user] = act != "die"
        match act:
            case "acquire" | "force":
                self._last[user] = f"l{next(self._numbers)}"
                self._acquire(user, force=act == "force")
            case "sign":
                self._acquire(user)
            case "release":
                self._command(user, Command.RELEASE, self._last[user])
            case "goal":
                x, y = self.rnd.uniform(-0.02, 0.02), self.rnd.uniform(-0.02, 0.02)
                self._goal(user, PoseGoal(x=x, y=y, phi=0.0, blend=self.rnd.choice((None, 0.005))))
            case "jog":
                self._goal(user, VelocityGoal(x=self.rnd.choice((-0.005, 0.005)), y=0.0, phi=0.0, timeout=5.0))
            case "stop":
                self._command(user, Command.STOP)
            case "wait":
                self._wait(self.rnd.randrange(12))

    def _wait(self, cycles: int) -> None:
        """Let time pass; who holds the lease and lives gives signs of it."""
        for number in range(cycles):
            holder = self.model.holds
            if number % 5 == 0 and holder is not None and self._alive[holder.user]:
                self._command(holder.user, Command.ACQUIRE, holder.id)
            else:
                self._cycle()

    def _acquire(self, user: str, *, force: bool = False) -> None:
        self._command(user, Command.ACQUIRE, self._last[user], force=force)

    def _command(self, user: str, name: Command, lease: str = "", *, force: bool = False) -> None:
        request = CommandRequest(next(self._numbers), user, name, said_with(name, lease, TIMEOUT, force))
        if name in (Command.ACQUIRE, Command.RELEASE):
            act = "force" if force else str(name)
            self.model.ask(act, user, lease, self.rig.control.cycles + 1)
        self._cycle(request)

    def _goal(self, user: str, goal: Goal) -> None:
        if self.model.holds is not None and self.rnd.random() < 0.8:
            user = self.model.holds.user
        name = f"g{next(self._numbers)}"
        self._sender[name] = user
        self._cycle(GoalRequest(next(self._numbers), user, name, goal, round(self.rig.now * 1e9)))

    def _cycle(self, request: Request | None = None) -> None:
        rig, noted, answered = self.rig, len(self.rig.notices), len(self.rig.answers)
        rig.cycle(request)
        assert rig.mode is not Mode.FAULT, rig.control.fault
        self.model.pass_time(rig.control.cycles)
        holder = self.model.holds.user if self.model.holds is not None else None
        free = holder is None and self.policy == "optional"
        assert rig.control.lease.user == holder
        for said in rig.notices[noted:]:
            if said.kind == "lease":
                self.seen["changes"] += 1
                assert said.user == holder
        for answer in rig.answers[answered:]:
            if isinstance(answer, Accepted):
                self.seen["accepted"] += 1
                assert free or self._sender[answer.reply.id] == holder
        self.seen["held"] += holder is not None
        assert free or all(goal.user == holder for goal in rig.control.ledger.goals)


@pytest.mark.parametrize("policy", ["optional", "required"])
@pytest.mark.generated(0, 1)
def test_never_two_holders_and_never_a_goal_of_another(seed: int, policy: LeasePolicy) -> None:
    """2500 acts of eight clients that come, hold, take over, die and send goals; four times."""
    crowd = Crowd(seed, policy)
    crowd.enable()
    for _ in range(2500):
        crowd.act()
    assert min(crowd.seen[what] for what in ("changes", "accepted", "held")) > 100, crowd.seen  # else nothing was tried
