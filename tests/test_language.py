"""Plain English: each room has as many odd names and sentences as its ceiling allows, and the ceilings only fall."""

from __future__ import annotations

import ast

import plain_language
import pytest
from plain_language import places_in_guide, places_in_python

REMEDY = "list them: python tools/plain_language.py"

ODD = """\
\"\"\"What the module has.\"\"\"
NEAR = 1


class Told:
    \"\"\"Of its frames.\"\"\"

    def tell_busy(self, said: int) -> None:
        \"\"\"Say it if it is time to.\"\"\"
        found = said  # goes on anew
        raise ValueError("whoever sends so much is told")
"""
PLAIN = """\
\"\"\"Contents of a CANopen frame.\"\"\"
POSE_TOLERANCE_M = 1


class FrameReport:
    \"\"\"Result of decoding one frame.\"\"\"

    def report_busy(self, message: int) -> None:
        \"\"\"Emit the summary if its interval has elapsed.\"\"\"
        count = message  # the standard allows one per cycle
        raise ValueError("drive A: 500 mm exceeds the limit of 150 mm")
"""


def test_no_room_and_no_guide_gets_odder() -> None:
    counts, ceilings = plain_language.counts(), plain_language.ceilings()
    assert {room: count for room, count in counts.items() if count > ceilings.get(room, 0)} == {}, REMEDY


def test_ceilings_fall_with_the_counts() -> None:
    counts, ceilings = plain_language.counts(), plain_language.ceilings()
    lower = {room: counts[room] for room, ceiling in ceilings.items() if counts[room] < ceiling}
    assert lower == {}, "run: python tools/plain_language.py --lower"


def test_each_list_finds_what_it_is_for() -> None:
    rules = {rule for _, rule, _ in places_in_python(ODD)}
    names = {"class", "constant", "function", "argument", "variable", "docstring"}
    assert names <= rules
    assert {"goes on, comes to, is to", "idiom", "so much, so many", "told, said, heard"} <= rules
    ast.parse(PLAIN)
    assert list(places_in_python(PLAIN)) == []


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("The robot is told what is wrong.", 1),
        ("Send `what is` in a [message](talking.md#who).", 0),
        ("```sh\nwho is told so much\n```\n", 0),
        ("The gateway rejects the goal.", 0),
    ],
)
def test_a_guide_is_judged_by_its_prose(text: str, number: int) -> None:
    assert len(list(places_in_guide(text))) == number


def test_a_file_belongs_to_one_room() -> None:
    assert plain_language.room("service/trirail/wire/kinds/pose.py") == "service/trirail/wire"
    assert plain_language.room("drivers/trirail_drivers/errors.py") == "drivers/trirail_drivers"
    assert plain_language.room("tools/reports/paper.py") == "tools"
    assert plain_language.room("service/codes.md") == "service/codes.md"
