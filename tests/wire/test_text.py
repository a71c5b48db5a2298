"""What may be a name or an id, and how text from outside is shown."""

from __future__ import annotations

import json
import re

import pytest
from trirail.wire import text
from trirail.wire.sizes import MAX_NAME, MAX_TEXT

SHOWN = ["g-17", "a", "Zug 4/5", "µm", "\U0001f916", "x" * MAX_NAME]
HIDDEN = ["\x1b[2J", "a\nb", "a\x85", "\u202eabc", "a\u200bb", "a\u2028b", "\ue000", "\ud800"]


@pytest.mark.parametrize("name", ["ann", "Ann-2_b", "0", "x" * MAX_NAME])
def test_a_name_may_be_in_a_key(name: str) -> None:
    assert text.is_name(name)


@pytest.mark.parametrize("name", ["", "x" * (MAX_NAME + 1), "a b", "a/b", "*", "ann\n", "é", *HIDDEN])
def test_what_may_not_be_in_a_key_is_no_name(name: str) -> None:
    assert not text.is_name(name)


@pytest.mark.parametrize("name", SHOWN)
def test_an_id_is_what_can_be_shown(name: str) -> None:
    assert text.is_id(name)
    assert text.printable(name) == text.quoted(name) == text.json_printable(name) == name


@pytest.mark.parametrize("name", ["", "x" * (MAX_NAME + 1), *HIDDEN])
def test_what_cannot_be_shown_is_no_id(name: str) -> None:
    assert not text.is_id(name)


@pytest.mark.parametrize("hidden", HIDDEN)
def test_what_a_terminal_would_obey_is_shown_as_an_escape(hidden: str) -> None:
    assert text.printable(hidden) == text.quoted(hidden) == hidden.encode("unicode_escape").decode("ascii")
    line = text.json_printable(json.dumps({"id": hidden}, ensure_ascii=False))
    assert text.printable(line) == line
    assert json.loads(line) == {"id": hidden}


def test_a_quotation_is_cut_when_it_is_longer_than_a_line_may_be() -> None:
    whole = "x" * MAX_TEXT
    assert text.quoted(whole) == whole
    for longer in (whole + "x", whole + "x" * 1000, "x" * (MAX_TEXT - 1) + "\n"):
        assert text.quoted(longer) == whole[:-1] + "…"


def test_a_time_is_shown_to_milliseconds() -> None:
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.250", text.wall_clock(1.8e9 + 0.25))
