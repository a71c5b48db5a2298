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
    PoseChanged,
    Refused,
    RefusedRequest,
    Request,
    Status,
    Welcome,
)
from trirail.wire.records import DTYPE, FIELDS, HEAD, SIZE, unpack
from trirail.wire.vocabulary import Command


@pytest.mark.parametrize(
    "request_",
    [
        GoalRequest(1, "ann", "g", PoseGoal(x=0.1, y=0.2, phi=0.3, speed=0.5, valid_for=1.0), 5),
        CommandRequest(2, "ann", Command.STOP),
        RefusedRequest("ann", "no"),
        PoseChanged("ann", "pose pick removed by ann"),
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


def test_a_record_begins_with_what_the_loop_writes() -> None:
    """Its head is packed in one piece: field by field, and up to where the control's fields begin."""
    names = [name for name, _, _ in FIELDS]
    head = names[: names.index("mode") + 1]
    numbers = iter(range(1, 1000))
    given = {name: [next(numbers) for _ in range(n)] for name, _, n in FIELDS if name in head}
    buffer = bytearray(SIZE)
    HEAD.pack_into(buffer, 0, *(number for values in given.values() for number in values))
    (row,) = unpack(bytes(buffer))
    for name, values in given.items():
        assert row[name].ravel().tolist() == values
    offset = DTYPE.fields["drive_state"][1]  # type: ignore[index]
    assert HEAD.size == offset
    assert not any(buffer[offset:])
