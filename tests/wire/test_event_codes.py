"""The codes of events: each is used with its own parameters, told in the guide, and no event goes without one."""

from __future__ import annotations

import ast
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import trirail
from hypothesis import given
from hypothesis import strategies as st
from trirail.wire.event_codes import MAX_PARAM, EventCode, coded
from trirail.wire.messages import Event, Notice
from trirail.wire.packets import Disturbance

SOURCE = Path(trirail.__file__).parent
GUIDE = Path(__file__).parents[2] / "service/codes.md"
CARRIERS = {kind.__name__ for kind in (Notice, Disturbance)}
"""Messages that become events, and take a code beside their text."""


def functions() -> Iterator[tuple[str, ast.AST]]:
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{file.relative_to(SOURCE)}: {node.name}", node


def calls(function: ast.AST, names: set[str]) -> Iterator[ast.Call]:
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
            yield node


def codes_in(node: ast.AST) -> set[str]:
    return {
        each.attr
        for each in ast.walk(node)
        if isinstance(each, ast.Attribute) and isinstance(each.value, ast.Name) and each.value.id == "EventCode"
    }


def codes_of(argument: ast.expr, function: ast.AST) -> set[str]:
    """Return the codes that an argument may be: its own, or those that its name is given in the function."""
    found = codes_in(argument)
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and ast.unparse(argument) in map(ast.unparse, node.targets):
            found |= codes_in(node.value)
    return found


def test_every_text_of_an_event_has_its_code_and_the_parameters_of_that() -> None:
    used = set()
    for where, function in functions():
        for call in calls(function, {"coded"}):
            found = codes_of(call.args[1], function)
            assert found, f"{where}: {ast.unparse(call)} names no code"
            for name in found:
                assert {keyword.arg for keyword in call.keywords} == set(EventCode[name].params), f"{where}: {name}"
            used |= found
    assert {code.name for code in EventCode} - used == {"OTHER"}


def test_every_message_that_becomes_an_event_takes_its_code_from_a_text() -> None:
    found = 0
    for where, function in functions():
        for call in calls(function, CARRIERS):
            spread = [keyword.value for keyword in call.keywords if keyword.arg is None]
            named = {keyword.arg for keyword in call.keywords}
            spreads_fields = [ast.unparse(each) for each in spread if ast.unparse(each).endswith((".fields", "ended"))]
            assert spreads_fields or "event_code" in named, f"{where}: {ast.unparse(call)}"
            found += 1
    assert found > 20


def test_the_guide_names_every_code_with_its_parameters() -> None:
    section = GUIDE.read_text(encoding="utf-8").partition("\n## Codes of events\n")[2].partition("\n## ")[0]
    told = re.findall(r"`(\w+)`(?: \(([\w, ]+)\))?", section.partition("\n- ")[2])
    assert told == [(code.value, ", ".join(code.params)) for code in EventCode]


def test_every_code_has_a_meaning_of_one_line() -> None:
    for code in EventCode:
        assert 0 < len(code.meaning) < 100, code
        assert "\n" not in code.meaning, code


@given(st.text())
def test_a_code_of_a_newer_service_is_an_event_too(code: str) -> None:
    known = {"kind": "service", "level": "info", "message": "so", "seq": 1, "t": 0.0, "cycle": 1, "time": 0.0}
    event = msgspec.json.decode(msgspec.json.encode(known | {"event_code": code, "params": {"new": 1}}), type=Event)
    assert event.event_code == (code if code in set(EventCode) else EventCode.OTHER)
    assert msgspec.json.decode(msgspec.json.encode(known), type=Event).event_code is None


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 1, 0.5])
@given(text=st.text())
def test_parameters_go_over_the_wire_as_they_are(number: float, text: str) -> None:
    made = coded("so", EventCode.OTHER, number=number, text=text)
    told = Notice("service", "info", made.text, **made.fields)
    for kind in (msgspec.json, msgspec.msgpack):
        assert kind.decode(kind.encode(told), type=Notice) == told
    assert len(str(made.params["text"])) <= MAX_PARAM


def test_file_names_of_another_encoding_go_over_the_wire() -> None:
    file = os.fsdecode(b"Ger\xe4te/robot.rrd")
    event = coded(f"recording to {file}", EventCode.RECORDING, file=file)
    packed = msgspec.msgpack.encode(Notice("service", "info", event.text, **event.fields))
    notice = msgspec.msgpack.decode(packed, type=Notice)
    assert notice.params == {"file": "Ger\\udce4te/robot.rrd"}
    assert notice.message == "recording to Ger\\udce4te/robot.rrd"
