"""The gateway and looks of alignments: each becomes an event of whom the key names, and nobody sends too many."""

from __future__ import annotations

import time

import pytest
from conftest import Rig
from hypothesis import given
from refusals import refused_as
from trirail.errors import RefusalCode, RefusedError
from trirail.processes.gateway import ROUTES
from trirail.processes.incoming import Incoming
from trirail.processes.requests import LOOK_BURST, LOOKS_PER_SECOND, Looks
from trirail.wire import boundary
from trirail.wire.looks import SUCCESSFUL_ENDS, AlignmentLook, in_words
from trirail.wire.messages import Notice
from trirail.wire.packets import Announcement
from trirail.wire.text import printable
from wire.looks import LARGEST, looks


class Asked:
    def __init__(self) -> None:
        self.now = 0.0
        self.sent: list[Notice] = []
        self.room = True
        self.looks = Looks(self._send, lambda: self.now)

    def _send(self, notice: Notice) -> bool:
        if self.room:
            self.sent.append(notice)
        return self.room

    def take(self, look: AlignmentLook, key: str = "trirail/demo/alignment/ann") -> AlignmentLook:
        content = boundary.encode(look)
        incoming = Incoming("alignment", key, len(content), content, "", None, time.monotonic_ns())
        _, (user,), sent = ROUTES["alignment"].read(incoming, "demo")
        return self.looks.forward(user, sent)


@given(looks)
def test_a_look_is_passed_on_in_a_line_that_a_terminal_shows(look: AlignmentLook) -> None:
    asked = Asked()
    taken = asked.take(look)
    (sent,) = asked.sent
    assert sent.user == "ann"
    assert sent.alignment == taken
    assert taken.marks == look.marks
    assert sent.level == ("info" if look.end in SUCCESSFUL_ENDS else "warning")
    assert sent.message == printable(sent.message)
    for words in (look.id, look.purpose, look.end or ""):
        assert words in sent.message


def test_the_largest_is_a_line_of_bounded_length() -> None:
    assert len(in_words(LARGEST)) < 6000


LOOK = AlignmentLook("a", "check", 1)


def test_who_sends_too_many_is_refused_until_he_has_waited_and_others_are_not() -> None:
    asked = Asked()
    for _ in range(LOOK_BURST):
        asked.take(LOOK)
    with refused_as(RefusalCode.BUSY):
        asked.take(LOOK)
    asked.take(LOOK, "trirail/demo/alignment/bob")
    asked.now += 1.5 / LOOKS_PER_SECOND
    asked.take(LOOK)
    assert [sent.user for sent in asked.sent] == ["ann"] * LOOK_BURST + ["bob", "ann"]


def test_what_the_loop_does_not_take_is_refused() -> None:
    asked = Asked()
    asked.room = False
    with refused_as(RefusalCode.BUSY):
        asked.take(LOOK)


@pytest.mark.parametrize("key", ["alignment/*", "alignment/a b", "alignment/ann/more", "alignment"])
def test_a_key_that_names_nobody_is_refused(key: str) -> None:
    asked = Asked()
    with pytest.raises(RefusedError):
        asked.take(LOOK, f"trirail/demo/{key}")
    assert asked.sent == []


def test_it_is_told_to_everyone(rig: Rig) -> None:
    rig.cycle(Announcement(Notice("alignment", "warning", "so it looked", user="ann", alignment=LOOK)))
    (notice,) = [notice for notice in rig.notices if notice.kind == "alignment"]
    assert (notice.level, notice.user, notice.message) == ("warning", "ann", "so it looked")
    assert notice.alignment == LOOK
