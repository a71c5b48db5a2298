"""The page of all messages is that of the source."""

from __future__ import annotations

import ast

import message_table
from message_table import ERRORS, EVENTS, REFUSALS, Message


def test_the_page_has_every_message_of_the_source() -> None:
    written = message_table.PAGE.read_text(encoding="utf-8")
    assert written == message_table.page(message_table.messages(), message_table.kept(written)), (
        "run python tools/message_table.py"
    )


def test_templates_are_found_in_calls_and_variables() -> None:
    source = """
def check(name, value):
    text = f"{name} is {value:g} m: choose less " + f"than {self._limit}"
    if value > 2:
        raise RefusedError(RefusalCode.ABOVE_LIMIT, text, value=value)
    coded("the robot is at rest", EventCode.STANDSTILL)
    text = "of another message"
    raise ConfigError(f"{', '.join(names)} are there twice")
    raise ValueError("part of another message")
    raise DriveError(str(error))
"""
    assert set(message_table.messages_in(ast.parse(source))) == {
        Message(REFUSALS, "above_limit", "{name} is {value} m: choose less than {limit}"),
        Message(EVENTS, "standstill", "the robot is at rest"),
        Message(ERRORS, "ConfigError", "{names} are there twice"),
    }


def test_an_example_is_the_shortest_that_fits_the_template() -> None:
    message = Message(REFUSALS, "above_limit", "{name} is {value} m: choose less")
    caused = [("above_limit", "x is 3 m: choose less"), ("too_fast", "y is 3 m: choose less")]
    assert message_table.example_of(message, caused) == "x is 3 m: choose less"
    assert message_table.example_of(message, caused[1:]) == ""
