"""What is decoded, and in how many threads at once: every type is prepared before there is a second one."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import trirail
from hypothesis import given
from hypothesis import strategies as st
from trirail.wire import boundary, decoding
from trirail.wire.goals import PoseGoal

KEYS = st.text(max_size=3)


@given(
    st.dictionaries(KEYS, st.integers(0, 9), min_size=1, max_size=4), st.integers(0, 3), st.sampled_from(["{}", "[{}]"])
)
def test_a_key_that_stands_twice_is_refused_at_every_door(pairs: dict[str, int], which: int, around: str) -> None:
    decoding.prepare(Any)
    items = [f"{json.dumps(key)}: {value}" for key, value in pairs.items()]
    once: Any = decoding.decoded(around.replace("{}", "{" + ", ".join(items) + "}"), Any)
    assert once == (pairs if around == "{}" else [pairs])
    twice = "{" + ", ".join([*items, items[which % len(items)]]) + "}"
    for content in (around.replace("{}", twice), around.replace("{}", twice).encode()):
        with pytest.raises(msgspec.ValidationError, match="is given twice; give it once"):
            decoding.decoded(content, Any)


SOURCES = sorted(Path(trirail.__file__).parent.rglob("*.py"))
BEFORE_COMPLETE = {"decode", "convert", "Decoder"}
"""Of msgspec: what makes what it knows of a type, if nobody has before."""

FIRST_DECODES = """
import os, sys, threading
from collections import Counter
import msgspec
from trirail.client.client import Robot
from trirail.errors import RefusedError
from trirail.wire import boundary
from trirail.wire.goals import Goal, TrackGoal, TrajectoryGoal
from trirail.wire.messages import CommandReply, ErrorReply, Event, GoalReply, RoleReply
from trirail.wire.state import Info, NamedPoses, RobotSummary, State
from trirail.wire.vocabulary import AcquireLease

def content(kind, tag):
    # The last field first: it is the last that msgspec comes to know of.
    return msgspec.json.encode(tag | dict.fromkeys(reversed(kind.__struct_encode_fields__)))

KINDS = [(kind, content(kind, {})) for kind in (State, Event, Info, GoalReply, NamedPoses, RobotSummary, CommandReply,
                                                ErrorReply, RoleReply)]
KINDS += [(Goal, content(TrackGoal, {"kind": "track"})), (AcquireLease | None, content(AcquireLease, {}))]

def decode(begin, wrong):
    begin.wait()
    for kind, payload in KINDS:
        try:
            boundary.decode(payload, kind, "not that")
        except RefusedError:
            pass  # nulls are no numbers
        except BaseException as error:
            wrong.append(error)

ends = Counter()
for _ in range(int(sys.argv[1])):
    child = os.fork()
    if child == 0:
        sys.setswitchinterval(1e-5)
        begin, wrong = threading.Barrier(3), []
        threads = [threading.Thread(target=decode, args=(begin, wrong)) for _ in range(3)]
        for thread in threads: thread.start()
        for thread in threads: thread.join()
        os._exit(len(wrong))
    ends[os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])] += 1
print(dict(ends))
"""


@pytest.mark.long
def test_no_thread_that_decodes_a_type_for_the_first_time_ends_the_interpreter() -> None:
    children = 100
    program = [sys.executable, "-c", FIRST_DECODES, str(children)]
    told = subprocess.run(program, capture_output=True, text=True, check=True)
    assert (told.stdout.strip(), told.stderr) == (f"{{0: {children}}}", "")


def test_a_type_that_was_not_prepared_is_an_error_wherever_it_is_asked_for() -> None:
    asks: tuple[Callable[[], object], ...] = (
        lambda: boundary.decode(b"1", PoseGoal | int, "not that"),
        lambda: decoding.decoded("1", PoseGoal | int),
        lambda: decoding.converted(1, PoseGoal | int),
    )
    for ask in asks:
        with pytest.raises(LookupError, match="is not prepared"):
            ask()


def of_msgspec(path: Path) -> list[str]:
    """Return the calls in a module by which msgspec comes to know of a type."""
    return [
        ast.unparse(node)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in BEFORE_COMPLETE
        and ast.unparse(node.func.value).split(".")[0] in ("msgspec", "json", "msgpack")
        and (node.func.attr != "decode" or any(keyword.arg == "type" for keyword in node.keywords))
    ]


def test_no_module_decodes_or_converts_but_by_what_is_prepared() -> None:
    found = {path.stem: len(calls) for path in SOURCES if (calls := of_msgspec(path))}
    assert found == {"decoding": 3, "explained": 1}  # explained: a table, within a type that is prepared
