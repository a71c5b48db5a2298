"""Plain English: odd names and sentences are found, and there are none but those with a reason."""

from __future__ import annotations

import ast

import plain_language
import pytest
from plain_language import places_in_guide, places_in_python

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


def test_every_name_and_sentence_is_plain_or_has_a_reason() -> None:
    found = [place for file in plain_language.files() for place in plain_language.places(file)]
    reasons = plain_language.exceptions()
    assert [place for place in found if place.key not in reasons] == []
    assert {place.key for place in found} == set(reasons), "remove the exceptions that are no longer needed"


def test_each_list_finds_what_it_is_for() -> None:
    rules = {rule for _, rule, _ in places_in_python(ODD)}
    names = {"class", "constant", "function", "argument", "variable", "docstring"}
    assert names <= rules
    assert {"goes on, comes to, is to", "idiom", "so much, so many", "told, said, heard"} <= rules
    ast.parse(PLAIN)
    assert list(places_in_python(PLAIN)) == []


@pytest.mark.parametrize("path", ["service/trirail/wires", "./service", "tests"])
def test_a_path_without_files_is_not_plain(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["plain_language.py", "service/trirail/naming.py", path])
    with pytest.raises(SystemExit) as ended:
        plain_language.main()
    assert ended.value.code == 2


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
