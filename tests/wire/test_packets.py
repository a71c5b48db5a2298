"""What goes between the processes survives the way."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec import structs
from trirail.errors import RefusalCode
from trirail.wire import packets
from trirail.wire.goals import PoseGoal
from trirail.wire.looks import AlignmentLook
from trirail.wire.messages import Event, GoalReply, Notice
from trirail.wire.packets import (
    Accepted,
    Announcement,
    Answer,
    Checked,
    CheckRequest,
    CommandDone,
    CommandRequest,
    EventReport,
    GoalRequest,
    Kind,
    Refused,
    Request,
    Status,
    Welcome,
)
from trirail.wire.records import DTYPE, FIELDS, HEADER, PART_NAMES, SIZE, last_cycle, unpack
from trirail.wire.sizes import MAX_PACKET
from trirail.wire.vocabulary import Command


@pytest.mark.parametrize(
    "request_",
    [
        GoalRequest(1, "ann", "g", PoseGoal(x=0.1, y=0.2, phi=0.3, speed=0.5, valid_for=1.0), 5),
        CheckRequest(1, "ann", PoseGoal(x=0.1, y=0.2, phi=0.3)),
        CommandRequest(2, "ann", Command.STOP),
        Announcement(Notice("refused", "warning", "no", user="ann", code=RefusalCode.BUSY)),
        Announcement(Notice("pose", "info", "pose pick removed by ann", user="ann")),
        Announcement(Notice("alignment", "info", "a look", user="ann", alignment=AlignmentLook("a", "check", 1))),
        Announcement(Notice("service", "info", "linked to the router tls/192.0.2.9:7447")),
    ],
)
def test_requests(request_: Request) -> None:
    packet = packets.message(request_)
    assert packet[0] == Kind.MESSAGE
    assert packets.decode_request(packet[1:]) == request_


@pytest.mark.parametrize(
    "answer",
    [
        Accepted(1, GoalReply("g", 0.5, queued=True)),
        Checked(1, GoalReply("", 0.5)),
        CommandDone(2, Command.STOP, "holding", 1),
        Refused(3, RefusalCode.OUT_OF_WORKSPACE, "no", "A", 0.4, 0.3),
        EventReport(Event("goal", "info", "goal g done", id="g", outcome="done", seq=1, t=0.5, cycle=500, time=1.0)),
        Status("g", 1.0, None),
        Welcome(("SCHED_FIFO: no",), 0.75),
    ],
)
def test_answers(answer: Answer) -> None:
    packet = packets.message(answer)
    assert packet[0] == Kind.MESSAGE
    assert packets.decode_answer(packet[1:]) == answer


def an_event(text: str) -> Event:
    return Event("goal", "info", text, id="g" * 64, outcome="done", seq=1, t=0.5, cycle=500, time=1.0)


def test_an_event_is_told_whole_up_to_the_size_of_a_packet() -> None:
    """And what does not fit is cut, in each of its words: nobody is told less than to whom it belongs."""
    room = MAX_PACKET - len(packets.message(EventReport(an_event("x" * 60_000)))) + 60_000
    whole = an_event("x" * room)
    packet = packets.event_packet(whole)
    assert len(packet) == MAX_PACKET
    assert packets.decode_answer(packet[1:]) == EventReport(whole)
    cut = packets.decode_answer(packets.event_packet(an_event("x" * (room + 1)))[1:])
    assert isinstance(cut, EventReport)
    assert cut.event.message == f"{'x' * 1000}… ({room + 1} characters)"
    assert structs.replace(cut.event, message="") == an_event("")


def test_whatever_is_long_in_an_event_is_cut() -> None:
    long = "x" * MAX_PACKET
    event = Event("goal", "info", long, id=long, reason=long, goal=long, user=long, seq=1, t=0.5, cycle=500, time=1.0)
    packet = packets.event_packet(event)
    assert len(packet) <= MAX_PACKET
    told = packets.decode_answer(packet[1:])
    assert isinstance(told, EventReport)
    for said in (told.event.message, told.event.id, told.event.reason, told.event.goal, told.event.user):
        assert said is not None
        assert said.startswith("x" * 100)


SCALARS = {"cycle", "deadline_ns", "lateness_ns", "overruns", "mode", "homing", "settled", "progress", "remaining"}


def test_a_record_has_one_number_for_the_robot_three_for_its_sliders_or_pose_and_one_for_each_timed_part() -> None:
    """As clients in other languages read it, and recordings have it: little-endian, whole, in steps of eight bytes."""
    shapes = {name: DTYPE[name].shape for name, _, _ in FIELDS}
    assert DTYPE.names == tuple(shapes)
    assert {name for name, shape in shapes.items() if shape == ()} == SCALARS
    assert shapes.pop("parts_ns") == (len(PART_NAMES),)
    assert all(shape == (3,) for name, shape in shapes.items() if name not in SCALARS)
    assert all(DTYPE.fields[name][1] % DTYPE[name].alignment == 0 for name in shapes)  # type: ignore[index]
    assert SIZE % 8 == 0


def test_records_are_read_one_after_the_other() -> None:
    rows = np.zeros(3, DTYPE)
    rows["cycle"] = 1, 2, 2**40
    assert last_cycle(rows.tobytes()) == 2**40
    assert unpack(rows.tobytes())["cycle"].tolist() == [1, 2, 2**40]


def test_a_record_begins_with_what_the_loop_writes() -> None:
    """Its head is packed in one piece: field by field, and up to where the control's fields begin."""
    names = [name for name, _, _ in FIELDS]
    head = names[: names.index("mode") + 1]
    numbers = iter(range(1, 1000))
    given = {name: [next(numbers) for _ in range(n)] for name, _, n in FIELDS if name in head}
    buffer = bytearray(SIZE)
    HEADER.pack_into(buffer, 0, *(number for values in given.values() for number in values))
    (row,) = unpack(bytes(buffer))
    for name, values in given.items():
        assert row[name].ravel().tolist() == values
    offset = DTYPE.fields["drive_state"][1]  # type: ignore[index]
    assert HEADER.size == offset
    assert not any(buffer[offset:])
