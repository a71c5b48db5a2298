"""Option --messages FILE: writes each message for people that tests cause, as examples for tools/message_table.py."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from trirail.wire import event_codes
from trirail.wire.event_codes import EventCode, EventText, Params
from trirail_drivers.errors import TrirailError


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--messages", metavar="FILE", help="write the messages for people that tests cause into a file")


def pytest_configure(config: pytest.Config) -> None:
    if file := config.getoption("--messages"):
        _write_into(Path(file))


def _write_into(file: Path) -> None:
    """Write code or class, and text, of each error and event from now on, one JSON array a line."""
    begin = TrirailError.__init__

    def write(code: str, text: str) -> None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(f"{json.dumps([code, text])}\n")

    def begin_error(self: TrirailError, message: str) -> None:
        begin(self, message)
        code = sys._getframe(1).f_locals.get("code")  # of a refusal, which has it as an argument
        write(str(code or type(self).__name__), str(self))

    def event_text(text: str, code: EventCode, params: Params) -> EventText:
        write(str(code), text)
        return EventText(text, code, params)

    TrirailError.__init__ = begin_error  # type: ignore[method-assign]
    event_codes.EventText = event_text  # type: ignore[assignment,misc]
