"""Every event that the service can make is in German on the page, with all its values; run by Node.js."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from panel.test_languages import FILES, PAGE
from trirail.errors import RefusalCode
from trirail.wire.event_codes import EventCode
from trirail.wire.looks import LookEnd, LookPurpose
from trirail.wire.messages import Notice, Outcome
from trirail.wire.vocabulary import Command, FaultCause, Mode

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="no Node.js")

ENGLISH = "the service's own sentence"
VOCABULARY: dict[str, tuple[str, ...]] = {
    "command": tuple(Command),
    "outcome": get_args(Outcome),
    "purpose": get_args(LookPurpose),
    "end": get_args(LookEnd),
    "part": ("slider", "platform"),
    "quantity": ("position", "passive position"),
    "cause": (*FaultCause, *("emcy", "fault", "silent", "heartbeat", "state", "timeout", "homing", "frame", "bus")),
}
"""Parameters whose values are words that the page knows."""
TEXTS = {
    *("goal", "user", "before", "name", "slider", "drives", "drive", "error", "warning", "reason", "pose", "file"),
    *("next", "files", "id", "router", "robot"),
}
"""Parameters whose values are names and texts from elsewhere, shown as they are."""

GERMAN_TOO = {"still", "stop", "reset"}
"""Words of VOCABULARY that are German as well."""

PROGRAM = """
import { readFileSync } from "node:fs";
const read = (name) => JSON.parse(readFileSync(name));
const element = { add() {}, addEventListener() {} };
const [getElementById, createElement, querySelectorAll] = [() => element, () => ({}), () => []];
globalThis.document = { getElementById, createElement, querySelectorAll, documentElement: {} };
globalThis.localStorage = { getItem: () => null };
globalThis.Option = class {};
Object.defineProperty(globalThis, "navigator", { value: { languages: [process.argv[3]] } });
const languages = { de: "Deutsch", en: "English" };
const file = (name) => (name === "languages.json" ? languages : read(`${process.argv[2]}/${name}`));
globalThis.fetch = async (name) => ({ json: async () => file(name) });
const { event, obstacle, useLabels } = await import("./service_words.js");
if (process.argv[4]) useLabels([...process.argv[4]]);
const shown = read(0).map((each) => (each.kind ? event(each) : obstacle(each)));
console.log(JSON.stringify(shown.map(({ textContent, title = null }) => [textContent, title])));
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's words, where Node.js takes them for modules."""
    folder = tmp_path_factory.mktemp("page")
    for name in ("words.js", "units.js", "service_words.js"):
        shutil.copy(PAGE / name, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "program.js").write_text(PROGRAM)
    return folder


def shown(
    folder: Path, events: list[dict[str, Any]], language: str = "de", labels: str = ""
) -> list[tuple[str, str | None]]:
    """Return what the page writes for events, and what it shows on hover. `labels` are a letter for each slider."""
    command = ["node", str(folder / "program.js"), str(PAGE), language, labels]
    done = subprocess.run(command, input=json.dumps(events), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return [(text, title) for text, title in json.loads(done.stdout)]


def values(code: EventCode, round_: int) -> dict[str, float | str]:
    """Return parameters of a code: other ones in every round."""
    found: dict[str, float | str] = {}
    for number, name in enumerate(code.params):
        if name in VOCABULARY:
            found[name] = VOCABULARY[name][round_ % len(VOCABULARY[name])]
        elif name == "unit":
            found[name] = ("m", "rad", "m/s")[round_ % 3]
        elif name == "code":
            found[name] = 0x8700 + round_
        else:
            found[name] = f"X{number}-{round_}" if name in TEXTS else (number + 2) * 1.5 + round_
    return found


def event(code: EventCode, params: dict[str, float | str], /, **fields: object) -> dict[str, Any]:
    return {"kind": "service", "message": ENGLISH, "event_code": code, "params": params} | fields


CODES = [code for code in EventCode if code is not EventCode.OTHER]


def test_every_code_is_german_with_each_of_its_values_in_its_form(folder: Path) -> None:
    rounds = range(max(map(len, VOCABULARY.values())))
    cases = [(code, values(code, round_)) for code in CODES for round_ in rounds]
    for (code, params), (text, title) in zip(cases, shown(folder, [event(*case) for case in cases]), strict=True):
        assert title == ENGLISH, (code, text)
        assert text, code
        assert not re.search(r"[{}]|undefined|NaN|null|\d\.\d|^[\s:,]|[\s:,]$|  ", text), (code, text)
        for name, value in params.items():
            if name in VOCABULARY and value not in GERMAN_TOO:
                assert not re.search(rf"\b{value}\b", text), (code, text)
            elif name in TEXTS and "cause" not in params:
                assert str(value) in text, (code, name, text)
    assert {name for code in EventCode for name in code.params if name in TEXTS or name in VOCABULARY} == {
        *TEXTS,
        *VOCABULARY,
    }


def test_every_value_makes_a_difference_to_the_sentence(folder: Path) -> None:
    changed: list[tuple[EventCode, str, dict[str, float | str], dict[str, float | str]]] = []
    for code in CODES:
        params = values(code, 0) | ({"cause": "emcy"} if "cause" in code.params else {})
        changed += [
            (code, name, params, params | {name: 0.0 if name == "on" else values(code, 1)[name]}) for name in params
        ]
    before = shown(folder, [event(code, params) for code, _, params, _ in changed])
    after = shown(folder, [event(code, params) for code, _, _, params in changed])
    same = [(code, name, one) for (code, name, *_), one, two in zip(changed, before, after, strict=True) if one == two]
    assert same == []


def test_numbers_have_the_comma_and_the_unit_of_their_kind(folder: Path) -> None:
    cases = [
        event(EventCode.SETTLED, {"settle": 0.0125}),
        event(EventCode.OVERRIDE, {"percent": 12.5, "user": "ann"}),
        event(EventCode.POSE_TAUGHT, {"pose": "pick", "user": "ann", "x": 0.02, "y": -0.0105, "phi": 0.1}),
        event(EventCode.LEASE_EXPIRED, {"user": "ann", "timeout": 1.5}),
        event(EventCode.DRIVE_FAULT, {"cause": "emcy", "drive": "B", "code": 0x8110}),
    ]
    assert [text for text, _ in shown(folder, cases)] == [
        "eingeschwungen nach 12,5 ms",
        "Override 12,5 %, gestellt von ann",
        "Pose pick gemerkt von ann: x 20,00 mm, y −10,50 mm, φ 5,730°",
        "Die Bedienung von ann ist abgelaufen: 1,5 s kein Lebenszeichen",
        "Antrieb B: EMCY 8110h",
    ]


def kinds() -> tuple[str, ...]:
    return get_args(next(field.type for field in msgspec.structs.fields(Notice) if field.name == "kind"))


def test_every_kind_of_event_is_german_with_every_code(folder: Path) -> None:
    """A goal's end has its outcome, a mode its name, a refusal its code, beside what the event's code says."""
    cases = []
    for kind, code in itertools.product(kinds(), CODES):
        about = {
            "goal": [{"id": "g-7", "outcome": outcome} for outcome in get_args(Outcome)],
            "mode": [{"mode": mode} for mode in Mode] + [{"mode": "moving", "goal": "g-7"}],
        }
        cases += [
            event(code, values(code, 0), kind=kind, user="ann", reason=ENGLISH, **fields)
            for fields in about.get(kind, [{}])
        ]
    for refused in RefusalCode:
        cases.append(event(EventCode.REFUSED, {}, kind="refused", user="ann", code=refused))
        cases.append(event(EventCode.REFUSED, {}, kind="goal", user="ann", code=refused, id="g-7", outcome="rejected"))
    for case, (text, title) in zip(cases, shown(folder, cases), strict=True):
        quotes = case.get("code") in ("malformed", "failed", "internal", "other")
        assert title == ENGLISH, (case, text)
        assert ENGLISH not in text or quotes, (case, text)
        if "outcome" in case:
            assert FILES["de"][f"outcome.{case['outcome']}"] in text
            assert "g-7" in text


@pytest.mark.parametrize("code", [None, "other", "of_a_newer_service"])
def test_an_event_without_a_known_code_is_in_the_service_s_words(folder: Path, code: str | None) -> None:
    ((text, title),) = shown(folder, [{"kind": "service", "message": ENGLISH, "event_code": code, "params": {}}])
    assert (text, title) == (ENGLISH, None)


@pytest.mark.parametrize("labels", ["", "UVW", "BCA"])
def test_a_refusal_names_the_slider_as_the_robot_does(folder: Path, labels: str) -> None:
    refused = {"kind": "refused", "code": RefusalCode.OUT_OF_WORKSPACE, "value": 0.16, "limit": 0.15, "user": "ann"}
    cases = [refused | {"slider": slider, "message": ENGLISH} for slider in "ABC"]
    for label, (text, _) in zip(labels or "ABC", shown(folder, cases, labels=labels), strict=True):
        assert f"Schlitten {label} 160,00 mm" in text


def test_english_is_the_service_s_own_sentence(folder: Path) -> None:
    found = shown(folder, [event(code, values(code, 0), kind=kind) for code in CODES for kind in kinds()], "en")
    assert set(found) == {(ENGLISH, None)}


@pytest.mark.parametrize(
    ("beyond", "unit", "value", "limit"),
    [
        (1e-2, "m", "160,00 mm", "150,00 mm"),
        (3e-6, "m", "150,003 mm", "150,000 mm"),
        (1e-9, "m", "150,000001 mm", "150,000000 mm"),
        (0.0, "m", "150,00 mm", "150,00 mm"),
        (1e-6, "rad", "8,59442°", "8,59437°"),
        (1e-5, "m/s", "0,15001 m/s", "0,15 m/s"),
    ],
)
def test_a_value_and_its_limit_are_shown_with_so_many_decimals_that_they_differ(
    folder: Path, beyond: float, unit: str, value: str, limit: str
) -> None:
    values = {"value": 0.15 + beyond, "limit": 0.15, "unit": unit}
    place = {"part": "platform", "name": "x", "quantity": "position"}
    told = {"message": ENGLISH, "user": "ann", "seq": 1, "time": 1.7e9}
    events = [
        {"kind": "warning", "event_code": EventCode.OUTSIDE_LIMITS, "params": place | values} | told,
        {"code": "platform_position", "what": "x", "message": ENGLISH} | values,
    ]
    if unit == "m":
        refused = {"kind": "refused", "code": RefusalCode.OUT_OF_WORKSPACE, "slider": "A"}
        events.append(refused | values | told)
    for text, _ in shown(folder, events):
        assert f" {value}" in text
        assert f" {limit}" in text
