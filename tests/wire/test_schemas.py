"""The JSON Schemas that are shipped: current, whole, and true of what really goes over Zenoh."""

import json
import threading
from pathlib import Path
from typing import Any

import message_schemas
import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator, ValidationError
from trirail.client import own_service
from trirail.errors import RefusalCode
from trirail.wire import goals, zenoh_session
from trirail.wire.goal_kind import field_description

FINITE = st.floats(allow_nan=False, allow_infinity=False)


def schema(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((message_schemas.FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return found


def validator(name: str) -> Draft202012Validator:
    return Draft202012Validator(schema(name))


def valid(name: str, message: object) -> bool:
    try:
        validator(name).validate(message)
    except ValidationError:
        return False
    return True


def test_the_files_are_what_the_types_say() -> None:
    assert message_schemas.stale() == [], "run python tools/message_schemas.py"
    for name in message_schemas.MESSAGES:
        Draft202012Validator.check_schema(schema(name))


def test_a_file_that_differs_lacks_or_is_too_many_is_noticed(tmp_path: Path) -> None:
    for name, text in message_schemas.schemas().items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert message_schemas.stale(tmp_path) == []
    (tmp_path / "goal.json").write_text("{}", encoding="utf-8")
    (tmp_path / "event.json").unlink()
    (tmp_path / "odd.json").write_text("{}", encoding="utf-8")
    assert message_schemas.stale(tmp_path) == ["event.json", "goal.json", "odd.json"]


def test_every_message_has_a_schema() -> None:
    """A type that is added to the messages is described, in a file of its own or within one."""
    structs = {
        name
        for module in message_schemas.MODULES
        for name, kind in vars(module).items()
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct)
        if kind.__module__ == module.__name__ and not kind.__subclasses__()
    }
    described = {name for file in message_schemas.MESSAGES for name in schema(file)["$defs"]}
    assert structs - described == set()


@pytest.mark.parametrize("field", ["id", "valid_for", "speed", "limits", "blend", "tool", "frame"])
def test_a_field_of_several_kinds_of_goals_means_the_same_in_schema_and_guide(field: str) -> None:
    guide = Path(goals.__file__).parents[2] / "talking.md"
    rows = [row.strip("| ").split(" | ") for row in guide.read_text(encoding="utf-8").splitlines() if row[:3] == "| `"]
    told: dict[str, str] = {}
    for name, of, meaning in rows:
        if name == f"`{field}`":
            told |= dict.fromkeys(of.split(", "), meaning.replace("`", ""))
    of_kind = {str(kind.__struct_config__.tag): kind for kind in goals.KINDS if field in kind.__struct_fields__}
    if "all" in told:
        told = dict.fromkeys(of_kind, told["all"])
    assert told == {kind: field_description(struct, field) for kind, struct in of_kind.items()}
    for kind, struct in of_kind.items():
        assert schema("goal")["$defs"][struct.__name__]["properties"][field]["description"] == told[kind]


def test_the_schema_of_an_error_reply_tells_what_each_code_means() -> None:
    told = {each["const"]: each["description"] for each in schema("error-reply")["$defs"]["RefusalCode"]["oneOf"]}
    assert told == {code: f"{code.meaning}; {code.remedy}" for code in RefusalCode}
    assert valid("error-reply", {"code": "busy", "message": "send fewer"})
    assert not valid("error-reply", {"code": "odd", "message": "send fewer"})


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "kind": st.sampled_from(["pose", "sliders", "velocity", "track", "trajectory", "dance"]),
            "x": FINITE | st.text(max_size=3),
            "y": FINITE,
            "phi": FINITE,
            "id": st.text(max_size=70) | st.none(),
            "speed": FINITE,
            "position": st.lists(FINITE, min_size=2, max_size=4),
            "timeout": FINITE,
            "odd": st.none(),
        },
    )
)
def test_the_service_takes_no_goal_that_the_schema_refuses(goal: dict[str, Any]) -> None:
    try:
        msgspec.json.decode(json.dumps(goal), type=goals.Goal)
    except msgspec.ValidationError:
        return
    assert valid("goal", goal)


@pytest.mark.parametrize(
    "goal",
    [
        {"kind": "pose", "x": 0.02, "y": -0.01, "phi": 0.1, "speed": 0.5, "valid_for": 2.0, "id": "g-17"},
        {"kind": "pose", "x": 0, "y": 0, "phi": 0, "blend": 0.01, "limits": {"velocity": [0.1, 0.1, 0.5]}},
        {"kind": "sliders", "position": [0.01, 0.0, -0.01]},
        {"kind": "velocity", "x": 0.01, "y": 0.0, "phi": 0.0, "timeout": 0.1, "id": "jog-1"},
        {"kind": "track", "x": 0.01, "y": 0, "phi": 0, "velocity": [0.05, 0, 0], "time": 1.8e9, "id": "t-1"},
        {"kind": "trajectory", "points": [{"t": 0, "x": 0, "y": 0, "phi": 0}, {"t": 1, "x": 0.01, "y": 0, "phi": 0}]},
    ],
    ids=lambda goal: goal["kind"],
)
def test_goals_are_valid_and_with_a_wrong_field_are_not(goal: dict[str, Any]) -> None:
    assert valid("goal", goal)
    assert not valid("goal", {**goal, "odd": 1})
    assert not valid("goal", {**goal, "kind": "dance"})
    assert not valid("goal", {name: value for name, value in goal.items() if name != "kind"})


@pytest.mark.slow
def test_real_traffic_is_valid(tmp_path: Path) -> None:
    """What a service says is read here as a stranger would, with Zenoh, JSON and the schemas alone."""
    config, locator = own_service.private(tmp_path)
    published: dict[str, list[Any]] = {"state": [], "event": []}
    arrived = threading.Event()

    def keep(sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        published[name].append(json.loads(sample.payload.to_string()))
        if name == "event" and published[name][-1].get("outcome") == "done":
            arrived.set()

    def ask(key: str, content: object = None) -> tuple[bool, Any]:
        payload = None if content is None else json.dumps(content)
        for reply in session.get(f"trirail/demo/{key}", payload=payload, timeout=60.0):
            answer = reply.ok or reply.err
            assert answer is not None
            return reply.ok is not None, json.loads(answer.payload.to_string())
        raise AssertionError(f"nobody answers on {key}")

    with (
        own_service.service(config, tmp_path / "r.rrd"),
        zenoh_session.open_client(locator) as session,
        session.declare_subscriber("trirail/demo/state", keep),
        session.declare_subscriber("trirail/demo/event", keep),
    ):
        goal = {"kind": "pose", "x": 0.02, "y": 0.0, "phi": 0.1, "speed": 0.2}
        replies = [
            ("info", True, ask("info")),
            ("error-reply", False, ask("goal/me", goal)),  # not enabled
            ("command-reply", True, ask("cmd/me/enable")),
            ("command-reply", True, ask("cmd/me/override", {"percent": 150.0})),
            ("error-reply", False, ask("goal/me", {**goal, "x": 2.0})),  # out of reach
            ("error-reply", False, ask("goal/me", {**goal, "odd": 1})),
            ("goal-reply", True, ask("goal/me", goal)),
        ]
        assert arrived.wait(60.0)
    for name, ok, (was_ok, reply) in replies:
        assert ok == was_ok, reply
        validator(name).validate(reply)
    assert published["state"]
    assert {event["kind"] for event in published["event"]} >= {"mode", "goal"}
    assert any(state["goal"] for state in published["state"])
    for name, all_of_them in published.items():
        for message in all_of_them:
            validator(name).validate(message)
