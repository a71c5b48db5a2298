"""Stops among everything else that comes, in sequences of every kind: who is answered, and which goals begin."""

from __future__ import annotations

import itertools
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.errors import RefusalCode
from trirail.processes.gateway import Gateway
from trirail.processes.inbox import MAX_MERGED_STOPS
from trirail.processes.incoming import Incoming
from trirail.processes.replies import COPIES_KEPT, COPY_WITHIN_S, MARKED_COPY_WITHIN_S, Copies
from trirail.processes.session_guard import Guard
from trirail.wire import packets, zenoh_session
from trirail.wire.call_mark import CallMark
from trirail.wire.messages import CommandReply, ErrorReply, GoalReply
from trirail.wire.packets import Accepted, CommandDone, CommandRequest, GoalRequest, Refused
from trirail.wire.records import DTYPE
from trirail.wire.stop_protocol import STOPS

USERS = ("ann", "bob")
CONTENTS = (b"", b"{}", b'{"goal": "bob-1"}', b"no JSON")


class Goal(NamedTuple):
    """What a user sends; its id is his name and the place among his goals."""

    user: str


class StopSent(NamedTuple):
    """A stop, over Zenoh or at the stop port; with `copy` it has an id, which programs use again."""

    user: str
    name: str
    content: bytes
    copy: str
    at_port: bool = False


class OnZenoh:
    """A query that nobody waits for."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def reply(self, *_: object, **__: object) -> None:
        pass

    reply_err = reply


class Read(NamedTuple):
    """The gateway reads so many."""

    at_most: int


goals = st.builds(Goal, st.sampled_from(USERS))
stops = st.builds(
    StopSent,
    st.sampled_from(USERS),
    st.sampled_from(sorted(STOPS)),
    st.sampled_from(CONTENTS),
    st.sampled_from(["", "", "a", "b"]),
    st.booleans(),
)
sequences = st.lists(goals | stops | stops | st.builds(Read, st.integers(1, 4)), max_size=40)


class Played:
    """A gateway that is sent a sequence, before a loop that does at once what it is told."""

    def __init__(self, opened: zenoh.Session, sequence: list[Goal | StopSent | Read]) -> None:
        self.sent: list[GoalRequest | CommandRequest] = []
        self.answers: dict[int, list[object]] = {}
        """Of each message, by its number."""
        self.messages: dict[int, Goal | StopSent] = {}
        self.goals: dict[str, int] = {}
        """The number of each goal, by id."""
        self._packets: list[bytes] = []
        self._gateway = Gateway(CONFIG, self, lambda: None, opened, Guard(CONFIG))  # type: ignore[arg-type]
        self._gateway._states.records(np.zeros(1, DTYPE))
        number, of = itertools.count(1), Counter[str]()
        for step in (*sequence, Read(1000)):
            if isinstance(step, Read):
                self._read(step.at_most)
            else:
                self._keep(next(number), step, of)
        self._gateway._replies.close()

    def send(self, packet: bytes) -> bool:
        request = packets.decode_request(packet[1:])
        if isinstance(request, GoalRequest):
            self._packets.append(packets.message(Accepted(request.ticket, GoalReply(request.id, 1.0))))
        elif isinstance(request, CommandRequest):
            under_way = getattr(request.content, "goal", None) is None or any(
                isinstance(each, GoalRequest) and each.id == request.content.goal for each in self.sent
            )
            no = Refused(request.ticket, RefusalCode.NO_GOAL, "not under way")
            self._packets.append(
                packets.message(CommandDone(request.ticket, request.name, "holding", 1) if under_way else no)
            )
        else:
            return True
        self.sent.append(request)
        return True

    def _keep(self, number: int, step: Goal | StopSent, of: Counter[str]) -> None:
        self.messages[number] = step
        self.answers[number] = []
        if isinstance(step, Goal):
            of[step.user] += 1
            name = f"{step.user}-{of[step.user]}"
            self.goals[name] = number
            content = json.dumps({"kind": "pose", "x": 0, "y": 0, "phi": 0, "id": name}).encode()
            key, copy = f"trirail/demo/goal/{step.user}", ""
        else:
            content, key, copy = step.content, f"trirail/demo/cmd/{step.user}/{step.name}", step.copy
        kind = "goal" if isinstance(step, Goal) else "cmd"
        query: Any = None if isinstance(step, StopSent) and step.at_port else OnZenoh()
        incoming = Incoming(kind, key, len(content), content, "", query, time.monotonic_ns())
        self._gateway._inbox._keep(incoming._replace(id=copy, at_door=self.answers[number].append))

    def _read(self, at_most: int) -> None:
        for incoming in self._gateway._inbox.next_messages(at_most):
            self._gateway._handle(incoming)
            while self._packets:
                self._gateway._handle_packet(self._packets.pop(0), lambda: None)

    def acted(self) -> list[int]:
        """The numbers of the stops but for copies: each stop has one copy at most, on the other channel."""
        return _acted(self.messages)


def _acted(messages: Mapping[int, object]) -> list[int]:
    alone: set[StopSent] = set()
    """Stops whose copy has not come."""
    first = []
    for number, message in messages.items():
        if not isinstance(message, StopSent):
            continue
        other = message._replace(at_port=not message.at_port)
        if message.copy and other in alone:
            alone.discard(other)
        else:
            first.append(number)
            alone.add(message)
    return first


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[zenoh.Session]:
    folder: Path = tmp_path_factory.mktemp("z")
    with zenoh_session.open_service([f"unixsock-stream/{folder}/z"]) as session:
        yield session


@given(sequence=sequences)
def test_each_message_is_answered_once_and_numbers_decide_which_goals_begin(
    opened: zenoh.Session, sequence: list[Goal | StopSent | Read]
) -> None:
    played = Played(opened, sequence)
    assert all(len(answers) == 1 for answers in played.answers.values()), played.answers
    acted = played.acted()
    commands = [each for each in played.sent if isinstance(each, CommandRequest)]
    assert len(commands) <= len(acted)
    # What begins after a stop had been passed on was sent after it; what was sent after every stop begins.
    of_all = [n for n in acted if played.messages[n].content != CONTENTS[2] or played.messages[n].name != "stop"]  # type: ignore[union-attr]
    for place, sent in enumerate(played.sent):
        if isinstance(sent, GoalRequest) and sent.withdrawn is None:
            before = sum(
                isinstance(each, CommandRequest) and getattr(each.content, "goal", None) is None
                for each in played.sent[:place]
            )
            later = sum(number > played.goals[sent.id] for number in of_all)
            assert before <= len(of_all) - later
    one = {"bob-1"} if len(acted) > len(of_all) else set()
    for sent in played.sent:
        if isinstance(sent, GoalRequest) and played.goals[sent.id] > max(acted, default=0):
            assert sent.withdrawn is None
        if isinstance(sent, GoalRequest) and sent.withdrawn is not None and sent.id not in one:
            assert any(number > played.goals[sent.id] for number in of_all)


@given(sequence=st.lists(stops, max_size=40))
def test_only_what_is_alike_and_came_one_behind_the_other_is_carried_out_as_one(
    opened: zenoh.Session, sequence: list[StopSent]
) -> None:
    alone = [step._replace(copy="", at_port=False) for step in sequence]
    played = Played(opened, list(alone))
    for user in USERS:
        runs = [(key, len(list(same))) for key, same in itertools.groupby(step for step in alone if step.user == user)]
        names = [name for (_, name, *_), length in runs for _ in range(-(-length // MAX_MERGED_STOPS))]
        assert [each.name for each in played.sent if isinstance(each, CommandRequest) and each.user == user] == names


def test_a_late_copy_stops_nothing_and_has_the_answer_of_the_first(opened: zenoh.Session) -> None:
    stop = StopSent("ann", "stop", b"", "a")
    late = stop._replace(at_port=True)
    played = Played(opened, [Goal("bob"), stop, Read(9), Goal("bob"), late, Goal("ann"), Read(9)])
    assert [
        (each.name if isinstance(each, CommandRequest) else each.id, getattr(each, "withdrawn", None))
        for each in played.sent
    ] == [
        ("stop", None),
        ("bob-1", "stop by ann"),
        ("bob-2", None),
        ("ann-1", None),
    ]
    assert played.answers[2] == played.answers[4] == [CommandReply("stop", "holding", 1)]


# A read after each message: a stop that is not the copy of the one before it is passed on before what comes next.
@given(
    sequence=st.lists(
        goals | st.builds(StopSent, st.just("ann"), st.just("stop"), st.just(b""), st.sampled_from("ab"), st.booleans())
    )
)
def test_no_stop_is_confirmed_without_being_carried_out_however_often_its_id_is_used(
    opened: zenoh.Session, sequence: list[Goal | StopSent]
) -> None:
    played = Played(opened, [each for step in sequence for each in (step, Read(1))])
    acted = set(played.acted())
    order = [
        "stop" if isinstance(step, StopSent) else "goal"
        for n, step in played.messages.items()
        if n in acted or isinstance(step, Goal)
    ]
    assert ["stop" if isinstance(each, CommandRequest) else "goal" for each in played.sent] == order
    assert all(len(answers) == 1 for answers in played.answers.values())


def test_a_goal_that_was_not_read_when_it_alone_was_stopped_does_not_begin(opened: zenoh.Session) -> None:
    played = Played(
        opened, [Goal("bob"), Goal("ann"), StopSent("ann", "stop", b'{"goal": "bob-1"}', ""), Read(9), Goal("bob")]
    )
    passed = {each.id: each.withdrawn for each in played.sent if isinstance(each, GoalRequest)}
    assert passed == {"bob-1": "stop by ann", "ann-1": None, "bob-2": None}
    assert isinstance(played.answers[3][0], CommandReply)


def test_a_goal_that_is_sent_after_a_stop_of_its_id_begins(opened: zenoh.Session) -> None:
    played = Played(opened, [Goal("ann"), StopSent("ann", "stop", b'{"goal": "bob-1"}', ""), Goal("bob")])
    passed = {each.id: each.withdrawn for each in played.sent if isinstance(each, GoalRequest)}
    assert passed == {"ann-1": None, "bob-1": None}


def test_a_stop_of_a_goal_that_was_never_sent_is_not_confirmed(opened: zenoh.Session) -> None:
    played = Played(opened, [Goal("bob"), Read(9), StopSent("ann", "stop", b'{"goal": "bob-2"}', "")])
    (answer,) = played.answers[2]
    assert isinstance(answer, ErrorReply)
    assert answer.code is RefusalCode.NO_GOAL


def test_one_that_cannot_be_read_is_carried_out_first_and_refused(opened: zenoh.Session) -> None:
    played = Played(
        opened, [Goal("bob"), *(StopSent("ann", "stop", b"no JSON", "a", at_port) for at_port in (False, True))]
    )
    assert [type(each) for each in played.sent] == [CommandRequest, GoalRequest]
    for number in (2, 3):
        (answer,) = played.answers[number]
        assert isinstance(answer, ErrorReply)
        assert answer.code is RefusalCode.MALFORMED


def stop(name: str, *, at_port: bool = False) -> Incoming:
    query: Any = None if at_port else OnZenoh()
    return Incoming("cmd", "trirail/demo/cmd/ann/stop", 0, b"", "", query, 0, id=name)


@pytest.mark.parametrize("code", [RefusalCode.BUSY, RefusalCode.NO_GOAL])
def test_a_copy_of_what_was_refused_is_carried_out_only_if_there_was_no_room(code: RefusalCode) -> None:
    copies = Copies()
    sent = copies.add(stop("a"))
    assert copies.answered(sent, ErrorReply(code, "no")) is None
    assert copies.first(stop("a", at_port=True)) is (None if code is RefusalCode.BUSY else sent.pair)


def test_a_stop_is_no_copy_of_another_command_or_of_other_content() -> None:
    copies, at_port = Copies(), stop("a", at_port=True)
    sent = copies.add(stop("a"))
    for other in (at_port._replace(key="trirail/demo/cmd/ann/quick_stop"), at_port._replace(payload=b'{"goal": "g"}')):
        assert copies.first(other) is None
    assert copies.first(at_port) is sent.pair


def test_a_refusal_of_an_earlier_stop_with_the_same_id_leaves_the_later_one_its_copy() -> None:
    copies = Copies()
    earlier, later = copies.add(stop("a")), copies.add(stop("a"))
    copies.answered(earlier, ErrorReply(RefusalCode.BUSY, "no"))
    assert copies.first(stop("a", at_port=True)) is later.pair


def test_stops_whose_copy_does_not_come_are_forgotten() -> None:
    now = 0.0
    copies = Copies(lambda: now)
    sent = [copies.add(stop(f"a{number}")) for number in range(COPIES_KEPT + 5)]
    assert copies.first(stop("a4", at_port=True)) is None
    assert copies.first(stop("a5", at_port=True)) is sent[5].pair
    for each in sent:
        copies.answered(each, CommandReply("stop", "holding", 1))
    now = COPY_WITHIN_S + 1.0
    copies.add(stop("b"))
    assert len(copies._pairs) == 1


MARK = CallMark("0" * 12, 1)


@given(late=st.floats(0.0, 30.0), answer_after=st.floats(0.0, 100.0), mark=st.sampled_from([None, MARK]))
def test_a_copy_comes_some_time_after_the_reply(late: float, answer_after: float, mark: CallMark | None) -> None:
    """A marked one may have waited in a link for as long as Zenoh keeps it; another program may use its id again."""
    now = 0.0
    copies = Copies(lambda: now)
    sent = copies.add(stop("a")._replace(mark=mark))
    now = answer_after
    copies.answered(sent, CommandReply("stop", "holding", 1))
    now = answer_after + late
    within = COPY_WITHIN_S if mark is None else MARKED_COPY_WITHIN_S
    assert (copies.first(stop("a", at_port=True)) is sent.pair) == (now - answer_after <= within)
