"""What waits for the gateway: in its order, bounded, and a flood of goals never keeps a stop out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from trirail.processes.inbox import UNREAD, Inbox, Incoming
from trirail.wire import zenoh_session
from trirail.wire.sizes import MAX_MESSAGE, MAX_UNREAD


@pytest.fixture
def refused() -> list[Incoming]:
    return []


@pytest.fixture
def inbox(tmp_path: Path, refused: list[Incoming]) -> Iterator[Inbox]:
    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/z"]) as opened:
        yield Inbox(opened, "demo", refused.append)


def keep(inbox: Inbox, kind: str, payload: bytes = b"") -> None:
    inbox._keep(kind, f"trirail/demo/{kind}", zenoh.ZBytes(payload), "", None)  # type: ignore[arg-type]


def test_messages_are_taken_in_their_order(inbox: Inbox) -> None:
    for number in range(10):
        keep(inbox, "goal", bytes([number]))
    assert [incoming.payload for incoming in inbox.take(4)] == [bytes([n]) for n in range(4)]
    assert [incoming.payload for incoming in inbox.take(100)] == [bytes([n]) for n in range(4, 10)]
    assert list(inbox.take(100)) == []


def test_a_flood_of_goals_is_refused_and_keeps_no_command_out(inbox: Inbox, refused: list[Incoming]) -> None:
    for _ in range(UNREAD + 5):
        keep(inbox, "goal")
    assert len(refused) == 5
    keep(inbox, "cmd")
    assert len(refused) == 5
    *_, last = inbox.take(2 * UNREAD)
    assert last.kind == "cmd"


def test_what_waits_is_bounded_in_bytes(inbox: Inbox, refused: list[Incoming]) -> None:
    for _ in range(MAX_UNREAD // MAX_MESSAGE + 3):
        keep(inbox, "goal", bytes(MAX_MESSAGE))
    assert len(refused) == 3
    assert all(incoming.payload == b"" for incoming in refused)
    taken = list(inbox.take(1000))
    assert sum(len(incoming.payload) for incoming in taken) == MAX_UNREAD
    keep(inbox, "goal", bytes(MAX_MESSAGE))
    assert len(refused) == 3


def test_what_is_too_large_is_not_kept_but_its_size_is(inbox: Inbox) -> None:
    keep(inbox, "goal", bytes(MAX_MESSAGE + 1))
    (incoming,) = inbox.take(10)
    assert (incoming.size, incoming.payload) == (MAX_MESSAGE + 1, b"")
