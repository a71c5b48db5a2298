"""What goes between the processes survives the way."""

from __future__ import annotations

import pytest
from trirail.errors import RefusalCode
from trirail.wire import packets
from trirail.wire.messages import Event, PoseGoal
from trirail.wire.packets import (
    Accepted,
    Answer,
    CommandRequest,
    Confirmed,
    GoalRequest,
    Happened,
    Kind,
    Refused,
    RefusedRequest,
    Request,
    Status,
    Welcome,
)
from trirail.wire.records import FIELDS, LAYOUT, Record, pack_into, unpack
from trirail.wire.vocabulary import Command


@pytest.mark.parametrize(
    "request_",
    [
        GoalRequest(1, "ann", "g", PoseGoal(x=0.1, y=0.2, phi=0.3, speed=0.5, valid_for=1.0), 5),
        CommandRequest(2, "ann", Command.STOP),
        RefusedRequest("ann", "no"),
    ],
)
def test_requests(request_: Request) -> None:
    packet = packets.message(request_)
    assert packet[0] == Kind.MESSAGE
    assert packets.decode_request(packet[1:]) == request_


@pytest.mark.parametrize(
    "answer",
    [
        Accepted(1, "g", 0.5, 1.0, False, True),
        Confirmed(2, Command.STOP, "holding"),
        Refused(3, RefusalCode.OUT_OF_WORKSPACE, "no", "A", 0.4, 0.3),
        Happened(Event(1, 0.5, 500, 1.0, "goal", "info", "goal g done", id="g", outcome="done")),
        Status("g", 1.0, None),
        Welcome(("SCHED_FIFO: no",), 0.75, 1.0),
    ],
)
def test_answers(answer: Answer) -> None:
    packet = packets.message(answer)
    assert packet[0] == Kind.MESSAGE
    assert packets.decode_answer(packet[1:]) == answer


def test_a_record_has_its_fields_where_readers_look_for_them() -> None:
    """Packed by name, read by name: each field holds what was put into it, and nothing else."""
    sizes = {name: n for name, _, n in FIELDS}
    assert tuple(sizes) == Record._fields
    numbers = iter(range(1, 1000))
    given = {name: next(numbers) if n == 1 else [next(numbers) for _ in range(n)] for name, n in sizes.items()}
    buffer = bytearray(5 + LAYOUT.size)
    pack_into(buffer, 5, Record(**given))  # type: ignore[arg-type]
    (row,) = unpack(bytes(buffer[5:]))
    for name, value in given.items():
        assert row[name].tolist() == value
