"""The codes of refusals: each has a meaning and a remedy, is used, and is told in the guide."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import get_args

import msgspec
import pytest
import trirail
from hypothesis import given
from hypothesis import strategies as st
from trirail.client import connection
from trirail.control.ledger import Withdrawal
from trirail.errors import RefusalCode, RefusedError
from trirail.wire.messages import ErrorReply

SOURCE = Path(trirail.__file__).parent
GUIDE = Path(__file__).parents[2] / "service/codes.md"


def test_every_code_has_a_meaning_and_a_remedy_of_one_line() -> None:
    for code in RefusalCode:
        for text in (code.meaning, code.remedy):
            assert 0 < len(text) < 100, code
            assert "\n" not in text, code


def test_the_guide_tells_every_code_in_their_order() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*) \| (.*) \|$", GUIDE.read_text(encoding="utf-8"), re.MULTILINE)
    assert [row for row in rows if row[0] in set(RefusalCode)] == [
        (code.value, code.meaning, code.remedy) for code in RefusalCode
    ]


def test_every_code_is_used_but_the_one_for_those_that_are_not_known() -> None:
    used = {
        node.attr
        for file in SOURCE.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "RefusalCode"
    }
    withdrawn = {RefusalCode(outcome).name for outcome in get_args(Withdrawal)}
    assert {code.name for code in RefusalCode} - used - withdrawn == {"OTHER"}


@pytest.mark.parametrize("code", list(RefusalCode))
def test_a_code_goes_over_the_wire_as_its_word_and_comes_out_as_itself(code: RefusalCode) -> None:
    sent = msgspec.json.encode(ErrorReply(code, "no"))
    assert sent == b'{"code":"%s","message":"no"}' % code.encode()
    refusal = connection.refusal(sent)
    assert isinstance(refusal, RefusedError)
    assert refusal.code is code


@given(st.text())
def test_a_code_of_a_newer_service_is_a_refusal_too(code: str) -> None:
    refusal = connection.refusal(msgspec.json.encode({"code": code, "message": "no"}))
    assert isinstance(refusal, RefusedError)
    assert refusal.code in (code, RefusalCode.OTHER)
    assert str(refusal) == "no"
