"""What clients tell of alignments: it is read as it was said, or refused; the largest fits everywhere."""

from __future__ import annotations

from typing import get_args

import msgspec
import pytest
from hypothesis import given
from refusals import refused_as
from trirail.alignment.procedure import AlignmentEnd
from trirail.errors import AlignmentFault, RefusalCode
from trirail.wire import boundary
from trirail.wire.looks import SUCCESSFUL_ENDS, AlignmentLook, LookEnd, SeenMark, alignment_event_text
from trirail.wire.messages import Notice
from trirail.wire.packets import Announcement, EventReport, decode_answer, decode_request, event_packet, message
from trirail.wire.sizes import MAX_MESSAGE, MAX_PACKET
from wire.looks import LARGEST, looks
from wire.looks import told as event


@given(looks)
def test_a_look_is_read_as_it_was_said_and_goes_between_the_processes(look: AlignmentLook) -> None:
    for encoding in (boundary.JSON, boundary.MSGPACK):
        assert boundary.decode(boundary.encode(look, encoding), AlignmentLook, "no look", encoding) == look
    request = Announcement(Notice("alignment", "info", "so it looked", user="ann", alignment=look))
    assert decode_request(message(request)[1:]) == request
    assert decode_answer(event_packet(event(1, look))[1:]) == EventReport(event(1, look))


def test_the_largest_fits_into_a_message_and_a_packet() -> None:
    assert len(boundary.encode(LARGEST)) <= MAX_MESSAGE
    text = alignment_event_text(LARGEST, "w" * 6000)
    notice = Notice("alignment", "warning", text.text, user="u" * 64, alignment=LARGEST, **text.fields)
    assert len(message(Announcement(notice))) <= MAX_PACKET
    assert decode_answer(event_packet(event(1, LARGEST))[1:]) == EventReport(event(1, LARGEST))


ONE = {"id": "a", "purpose": "check", "number": 1}
MARK = {"name": "left", "pixel": [1.0, 2.0]}


@pytest.mark.parametrize(
    "wrong",
    [
        {"id": ""},
        {"id": "a\x1b"},
        {"purpose": "play"},
        {"number": 0},
        {"end": "well"},
        {"more": 1},
        {"words": "x" * 513},
        {"pose": [0.0, 0.0]},
        {"correction": [0.0, 0.0, 1e9]},
        {"seconds": -1.0},
        {"marks": [MARK] * 33},
        {"marks": [MARK | {"name": "a\nb"}]},
        {"marks": [MARK | {"pixel": [1e10, 0.0]}]},
        {"marks": [MARK | {"picture": "…"}]},
        {"marks": [MARK | {"to_go": [float("nan"), 0.0]}]},
        {"noise": float("inf")},
    ],
)
def test_what_is_none_is_refused(wrong: dict[str, object]) -> None:
    boundary.decode(msgspec.json.encode(ONE | {"marks": [MARK]}), AlignmentLook, "no look")
    with refused_as(RefusalCode.MALFORMED):
        boundary.decode(msgspec.msgpack.encode(ONE | wrong), AlignmentLook, "no look", boundary.MSGPACK)


def test_every_way_in_which_an_alignment_ends_can_be_said() -> None:
    assert set(get_args(LookEnd)) == {*AlignmentEnd, *AlignmentFault, "calibrated", "checked", "failed"}
    assert set(SUCCESSFUL_ENDS) - {None} < set(get_args(LookEnd))


def test_a_mark_with_numbers_that_are_none_cannot_be_made() -> None:
    with pytest.raises(ValueError, match="finite"):
        SeenMark("left", (float("nan"), 0.0))
