"""What waits for the gateway: by user, bounded, and a flood of one never keeps out another, nor a stop."""

from __future__ import annotations

import math
import queue
import random
import select
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from rigs import Clock
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.gateway import ROUTES
from trirail.processes.inbox import MAX_MERGED_STOPS, MAX_MESSAGES, MAX_MESSAGES_OF_USER, Inbox, _incoming
from trirail.processes.incoming import BURST, RATE, FairQueue, Incoming, Pace
from trirail.processes.memory_budget import OVERHEAD
from trirail.wire import zenoh_session
from trirail.wire.call_mark import CallMark, new_connection
from trirail.wire.messages import ErrorReply
from trirail.wire.sizes import MAX_BESIDE, MAX_MESSAGE, MAX_TRANSPORT, MAX_UNREAD, MAX_UNREAD_OF_ONE
from trirail.wire.stop_protocol import StopRequest
from trirail.wire.vocabulary import Command
from waiting import WITHIN, wait_until

KEYS = {kind: len(route.names) for kind, route in ROUTES.items()}


@pytest.fixture
def refused() -> list[Incoming]:
    return []


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def inbox(tmp_path: Path, refused: list[Incoming], clock: Clock) -> Iterator[Inbox]:
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        yield Inbox(opened, "demo", KEYS, lambda incoming, _: refused.append(incoming), clock)


def readable(inbox: Inbox) -> bool:
    return bool(select.select([inbox], [], [], 0.0)[0])


def keep(inbox: Inbox, kind: str, payload: bytes = b"", user: str = "ann", name: str = "") -> None:
    key = "/".join(filter(None, ("trirail/demo", kind, user, name)))
    inbox._keep(_incoming(kind, key, zenoh.ZBytes(payload), "", None))


def test_messages_are_taken_in_their_order(inbox: Inbox) -> None:
    for number in range(10):
        keep(inbox, "goal", bytes([number]))
    assert [incoming.payload for incoming in inbox.next_messages(4)] == [bytes([n]) for n in range(4)]
    assert [incoming.payload for incoming in inbox.next_messages(100)] == [bytes([n]) for n in range(4, 10)]
    assert list(inbox.next_messages(100)) == []


def test_a_flood_of_goals_is_refused_and_keeps_no_command_out(inbox: Inbox, refused: list[Incoming]) -> None:
    for number in range(MAX_MESSAGES + 5):
        keep(inbox, "goal", user=f"u{number % 8}")
    assert len(refused) == 5
    keep(inbox, "cmd", name="enable")
    assert len(refused) == 5
    *_, last = inbox.next_messages(9)
    assert last.kind == "cmd"  # the ninth user's turn


def test_the_flood_of_one_leaves_room_for_the_others(inbox: Inbox, refused: list[Incoming]) -> None:
    for _ in range(MAX_MESSAGES_OF_USER + 5):
        keep(inbox, "goal", user="eve")
    assert [incoming.user for incoming in refused] == ["eve"] * 5
    keep(inbox, "goal")
    assert len(refused) == 5
    assert [incoming.user for incoming in inbox.next_messages(3)] == ["eve", "ann", "eve"]


@pytest.mark.generated(0, 1, 2)
def test_no_flood_of_other_messages_keeps_out_a_stop(inbox: Inbox, refused: list[Incoming], seed: int) -> None:
    """Whether it fills the memory, the number of messages, or what one user may have."""
    chance = random.Random(seed)
    users = [f"u{number}" for number in range(chance.choice((1, 4, 20)))]
    size = chance.choice((0, 0, 100_000))
    for _ in range(3 * MAX_MESSAGES):
        kind, name = chance.choice((("cmd", "enable"), ("cmd", "override"), ("goal", "")))
        keep(inbox, kind, bytes(size), chance.choice(users), name)
    assert refused
    before = len(refused)
    for number, name in enumerate(("stop", "quick_stop", "disable") * 5):
        keep(inbox, "cmd", b"{}", (*users, "ann")[number % (len(users) + 1)], name)
        inbox.stop_at_port(StopRequest(f"trirail/demo/cmd/ann/{name}", "", ""), lambda _: None)
    assert len(refused) == before


@pytest.mark.parametrize("name", Command)
def test_what_stops_the_robot_for_everybody_comes_first(inbox: Inbox, name: Command) -> None:
    for kind in ("goal", "cmd"):
        keep(inbox, kind, user="eve", name="enable" * (kind == "cmd"))
    keep(inbox, "cmd", name=name)
    overtakes = name in ("stop", "quick_stop", "disable")
    taken = list(inbox.next_messages(3))
    assert (taken[0].user == "ann") == overtakes
    assert sorted(incoming.number for incoming in taken) == [1, 2, 3]
    assert max(taken, key=lambda incoming: incoming.number).user == "ann"


@pytest.mark.parametrize("content", [b"{}", b'{"goal": "g"}', b"no JSON", bytes(MAX_MESSAGE + 1)])
def test_a_stop_comes_first_whatever_it_holds(inbox: Inbox, content: bytes) -> None:
    keep(inbox, "goal", b"{}")
    keep(inbox, "cmd", content, name="stop")
    assert [incoming.kind for incoming in inbox.next_messages(2)] == ["cmd", "goal"]


def test_who_sends_more_than_his_pace_waits_and_nobody_else(inbox: Inbox, clock: Clock) -> None:
    for _ in range(BURST + 10):
        keep(inbox, "goal", user="eve")
    assert len(list(inbox.next_messages(10_000))) == BURST
    assert not readable(inbox)
    assert 0.0 < inbox.due() <= 1.0 / RATE
    keep(inbox, "goal")
    assert readable(inbox)
    assert inbox.due() == 0.0
    assert [incoming.user for incoming in inbox.next_messages(10)] == ["ann"]
    keep(inbox, "cmd", user="eve", name="stop")  # a stop of hers has its own
    assert inbox.due() == 0.0
    assert [incoming.kind for incoming in inbox.next_messages(10)] == ["cmd"]
    for _ in range(10):
        assert list(inbox.next_messages(10)) == []
        clock.now += inbox.due() + 1e-9
        assert [incoming.user for incoming in inbox.next_messages(10)] == ["eve"]
    assert inbox.due() == math.inf
    clock.now += BURST / RATE
    for _ in range(BURST + 1):
        keep(inbox, "goal", user="eve")
    assert len(list(inbox.next_messages(10_000))) == BURST


def test_goals_wait_behind_the_earlier_stops_of_their_own_user_alone(inbox: Inbox) -> None:
    keep(inbox, "goal", b"early", user="eve")
    for number in range(BURST + 10):
        keep(inbox, "cmd", b"%d" % number, "eve", "stop")  # equal ones would be one
    keep(inbox, "cmd", user="eve", name="enable")
    for user in ("eve", "ann"):
        keep(inbox, "goal", user=user)
    taken = [(incoming.user, incoming.kind) for incoming in inbox.next_messages(BURST + 20)]
    assert taken == [("eve", "cmd")] * BURST + [("eve", "goal"), ("ann", "goal"), ("eve", "cmd")]
    assert inbox.due() > 0.0


def test_a_message_of_any_user_that_came_before_a_stop_is_known_until_it_is_read(inbox: Inbox) -> None:
    keep(inbox, "goal", user="eve")
    keep(inbox, "cmd", name="stop")
    keep(inbox, "goal")
    (stop,) = inbox.next_messages(1)
    assert inbox.earlier(stop.number)
    assert [incoming.user for incoming in inbox.next_messages(1)] == ["eve"]
    assert not inbox.earlier(stop.number)


def test_equal_stops_with_another_message_between_them_are_two(inbox: Inbox) -> None:
    for name in ("stop", "stop", "enable", "stop"):
        keep(inbox, "cmd", name=name)
    taken = [(incoming.number, len(incoming.alike)) for incoming in inbox.next_messages(9)]
    assert taken == [(1, 1), (4, 0), (3, 0)]


def test_a_stop_whose_content_is_too_large_to_be_kept_is_equal_to_no_other(inbox: Inbox) -> None:
    for content in (b"", bytes(MAX_MESSAGE + 1), bytes(MAX_MESSAGE + 1), b""):
        keep(inbox, "cmd", content, name="stop")
    assert [len(incoming.alike) for incoming in inbox.next_messages(9)] == [0, 0, 0, 0]


def test_not_more_equal_stops_are_one_than_may_be(inbox: Inbox) -> None:
    for _ in range(MAX_MERGED_STOPS + 5):
        keep(inbox, "cmd", name="stop")
    assert [1 + len(incoming.alike) for incoming in inbox.next_messages(9)] == [MAX_MERGED_STOPS, 5]


def test_what_is_more_than_was_taken_stays_readable(inbox: Inbox) -> None:
    for _ in range(3):
        keep(inbox, "goal")
    assert len(list(inbox.next_messages(2))) == 2
    assert readable(inbox)
    assert len(list(inbox.next_messages(2))) == 1
    assert not readable(inbox)


def test_users_who_have_their_whole_burst_again_are_forgotten() -> None:
    pace = Pace()
    for number in range(5000):
        pace.count(f"u{number}", number * 0.1)
    assert len(pace._full_at) <= 1001


@pytest.mark.generated(0, 1, 2)
def test_what_waits_is_bounded_in_bytes_of_each_user_and_in_total(
    inbox: Inbox, refused: list[Incoming], seed: int
) -> None:
    chance = random.Random(seed)
    users = [f"u{number}" for number in range(chance.randrange(1, 9))]
    held: Counter[str] = Counter()
    for _ in range(6 * MAX_UNREAD // MAX_MESSAGE):
        kind, user = chance.choice(("goal", "cmd", "role")), chance.choice(users)
        keep(inbox, kind, bytes(chance.choice((0, 100, MAX_MESSAGE))), user, "enable" * (kind == "cmd"))
    waiting = list(inbox._others)
    for incoming in waiting:
        held[incoming.user] += incoming.held
    assert refused
    assert "" in held
    assert inbox._budget.held == held.total() <= 2 * MAX_UNREAD
    assert max(held.values()) <= 2 * MAX_UNREAD_OF_ONE
    goals = Counter(
        {user: sum(one.held for one in waiting if one.user == user and one.kind == "goal") for user in users}
    )
    assert max(goals.values()) <= MAX_UNREAD_OF_ONE
    del incoming
    waiting.clear()
    inbox._others = FairQueue()
    assert inbox._budget.held == 0


@pytest.mark.generated(0, 1, 2, 3)
def test_what_is_too_large_is_refused_when_it_comes_and_its_memory_is_not_held(tmp_path: Path, seed: int) -> None:
    chance, locator = random.Random(seed), f"unixsock-stream/{tmp_path}/z"
    refused: queue.SimpleQueue[tuple[Incoming, ErrorReply]] = queue.SimpleQueue()
    large = bytes(chance.randrange(MAX_MESSAGE + MAX_BESIDE, MAX_TRANSPORT - MAX_BESIDE))
    with zenoh_session.open_service([locator]) as opened, zenoh_session.open_client(locator) as client:
        inbox = Inbox(opened, "demo", KEYS, lambda incoming, error: refused.put((incoming, error)))
        inbox.declare()
        for name in chance.sample(["role/u0", "goal/eve", "cmd/eve/stop", "cmd/eve/reset", "info"], 5):
            content, attached = (large, None) if chance.random() < 0.5 else (None, large)
            before = inbox._budget.held
            client.get(f"trirail/demo/{name}", zenoh.handlers.FifoChannel(1), payload=content, attachment=attached)
            incoming, error = refused.get(timeout=WITHIN)
            assert (incoming.payload, error.code) == (b"", RefusalCode.TOO_LARGE)
            assert ("stop is carried out nevertheless" in error.message) == (name == "cmd/eve/stop")
            assert inbox._budget.held - before == OVERHEAD * (name == "cmd/eve/stop")
        (stop,) = inbox.next_messages(9)
        assert stop.key == "trirail/demo/cmd/eve/stop"
        assert stop.query is None
        with pytest.raises(RefusedError, match="exceed the maximum"):  # so: without content
            stop.content(type(None), "")


@pytest.mark.parametrize("end", ["", ".1", ".a-b_c"])
def test_calls_are_read_from_requests_and_from_both_copies_of_a_stop(tmp_path: Path, end: str) -> None:
    """`end`: what another program may write after the mark instead of what the client writes."""
    locator, mark = f"unixsock-stream/{tmp_path}/z", CallMark(new_connection(), 12_345)
    name = f"{mark}{end}" if end else mark.new_id()
    with zenoh_session.open_service([locator]) as opened, zenoh_session.open_client(locator) as client:
        inbox = Inbox(opened, "demo", KEYS, lambda incoming, error: None)
        inbox.declare()
        sent = (("goal/ann", str(mark)), ("cmd/ann/stop", name), ("cmd/ann/enable", "else"), ("cmd/ann/reset", None))
        for key, attached in sent:
            client.get(f"trirail/demo/{key}", zenoh.handlers.FifoChannel(1), attachment=attached)
        inbox.stop_at_port(StopRequest("trirail/demo/cmd/ann/quick_stop", name), lambda answer: None)
        marked: dict[str, tuple[str, CallMark | None]] = {}
        wait_until(
            lambda: (
                marked.update((one.key.split("/", 2)[2], (one.id, one.mark)) for one in inbox.next_messages(9))
                or len(marked) == 5
            )
        )
    assert marked == {
        "goal/ann": ("", mark),
        "cmd/ann/stop": (name, mark),
        "cmd/ann/enable": ("", None),
        "cmd/ann/reset": ("", None),
        "cmd/ann/quick_stop": (name, mark),
    }


def test_what_is_too_large_is_not_kept_but_its_size_is(inbox: Inbox) -> None:
    keep(inbox, "goal", bytes(MAX_MESSAGE + 1))
    (incoming,) = inbox.next_messages(10)
    assert (incoming.size, incoming.payload) == (MAX_MESSAGE + 1, b"")
