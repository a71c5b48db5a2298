"""Keys, payloads, encodings and packets: each becomes a value or a refusal in one printable line, never an error."""

from __future__ import annotations

import contextlib
import json
import time
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from conftest import Rig
from control_rig import CONFIG
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.client.outgoing import goal_messages
from trirail.errors import RefusedError
from trirail.processes.gateway import ROUTES, Gateway
from trirail.processes.incoming import Incoming
from trirail.processes.memory_budget import OVERHEAD
from trirail.processes.replies import Refusals
from trirail.processes.session_guard import Guard
from trirail.wire import boundary, links, packets, records, text, zenoh_session
from trirail.wire.goals import Goal, PoseGoal, TrajectoryGoal
from trirail.wire.goals import TrajectoryPoint as Point
from trirail.wire.links import Port, TooLarge
from trirail.wire.messages import CommandReply, Event, Notice
from trirail.wire.packets import Accepted, Announcement, EventReport, GoalRequest
from trirail.wire.records import DTYPE, SIZE
from trirail.wire.sizes import (
    MAX_BESIDE,
    MAX_MESSAGE,
    MAX_NAME,
    MAX_PACKET,
    MAX_PART,
    MAX_POINTS,
    MAX_SHARED,
    MAX_UNREAD_OF_ONE,
)
from trirail.wire.state import Info, State
from trirail.wire.vocabulary import Mode, Override, Stop

KINDS: tuple[Any, ...] = (Goal, Stop | None, Override, State, Event, Info, CommandReply)
ENCODINGS = ("", "zenoh/bytes", "application/json;v=1", boundary.JSON, boundary.MSGPACK)
OPENINGS = (b"[", b'{"a":', b'{"kind":', b"\x91", b"\x81\xa1a")
NUMBERS = ("x", "y", "phi", "speed", "timeout", "blend", "valid_for", "stretch", "z")
HIDDEN = {"Cc", "Cf", "Cs", "Co", "Zl", "Zp"}

numbers = st.floats() | st.sampled_from((0.0, 1e-310, 1e-17, 1e-3, 0.5, 1.0, 1e17, 1e300)) | st.integers()
values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=100),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=20), inner, max_size=5),
)
goals = st.fixed_dictionaries(
    {"kind": st.sampled_from(("pose", "named", "sliders", "velocity", "track", "trajectory", "dance"))},
    optional=dict.fromkeys(
        ("x", "y", "phi", "speed", "timeout", "blend", "valid_for", "stretch", "z"), numbers | values
    )
    | {
        "position": st.lists(numbers, max_size=4),
        "velocity": st.lists(numbers, min_size=2, max_size=4),
        "time": numbers,
        "limits": st.dictionaries(st.sampled_from(("velocity", "jerk")), st.lists(numbers, max_size=4)),
        "points": st.lists(st.fixed_dictionaries(dict.fromkeys(("t", "x", "y", "phi"), numbers)), max_size=3),
        "id": st.text(max_size=70),
        "name": st.text(max_size=70) | st.sampled_from(("pick", "nowhere")),
    },
)


def packed(value: object) -> bytes:
    """Write a value as msgpack, where it can be: integers of more than 64 bits cannot."""
    try:
        return msgspec.msgpack.encode(value)
    except (OverflowError, UnicodeEncodeError):
        return b""


payloads = (
    st.binary(max_size=300)
    | (goals | values).map(lambda value: json.dumps(value).encode())
    | (goals | values).map(packed)
    | st.builds(
        bytes.__mul__, st.sampled_from((b"[", b'{"a":', b'{"kind":', b"\x91", b"\x81\xa1a")), st.integers(0, 9999)
    )
)
keys = st.text(max_size=60) | st.lists(
    st.sampled_from(
        ("trirail", "demo", "goal", "cmd", "teach", "forget", "eve", "stop", "*", "**", "", "$*", "a b", "x" * 65)
    ),
    max_size=7,
).map("/".join)


def shown(line: str) -> bool:
    """Whether a terminal shows it as it is."""
    return not any(unicodedata.category(character) in HIDDEN for character in line)


def refusal(call: Callable[[], object]) -> str:
    """Return in which words a call is refused; nothing where it is not."""
    try:
        call()
    except RefusedError as error:
        return str(error)
    return ""


# ---------------------------------------------------------------------- what is read


@given(payload=payloads, kind=st.sampled_from(KINDS), encoding=st.sampled_from(ENCODINGS) | st.text(max_size=20))
@example(payload=b'{"kind":' * 5000, kind=Goal, encoding="")
@example(payload=bytes(MAX_MESSAGE + 1), kind=State, encoding="")
def test_any_payload_is_a_message_or_a_refusal(payload: bytes, kind: Any, encoding: str) -> None:
    said = refusal(lambda: boundary.decode(payload, kind, "not that", encoding))
    assert shown(said)
    assert len(said) < 700


@given(goal=goals)
def test_a_goal_that_is_taken_has_only_numbers_that_can_be_planned_with(goal: dict[str, Any]) -> None:
    for payload, encoding in ((json.dumps(goal).encode(), ""), (packed(goal), boundary.MSGPACK)):
        with contextlib.suppress(RefusedError):
            taken: Goal = boundary.decode(payload, Goal, "not a goal", encoding)
            assert taken.id is None or (0 < len(taken.id) <= MAX_NAME and shown(taken.id))
            for name, low, high in (("speed", 1e-3, 1.0), ("timeout", 0.01, 10.0), ("valid_for", 1e-3, 86_400.0)):
                value = getattr(taken, name, None)
                assert value is None or low <= value <= high
            for value in (value for name, value in msgspec.to_builtins(taken).items() if name != "time"):
                assert not isinstance(value, float) or abs(value) <= 1e5
            request = GoalRequest(1, "ann", "g", taken, 1)
            assert packets.decode_request(packets.message(request)[1:]) == request


@given(key=keys, wanted=st.sampled_from((("user",), ("user", "command"))))
def test_any_key_names_somebody_or_is_refused(key: str, wanted: tuple[str, ...]) -> None:
    said = refusal(lambda: boundary.names(key, "trirail/demo/goal", wanted))
    assert shown(said)
    if not said:
        user, *rest = boundary.names(key, "trirail/demo/goal", wanted)
        assert text.is_name(user)
        assert key == "/".join(("trirail/demo/goal", user, *rest))


@given(words=st.text())
def test_whatever_is_printed_is_shown_and_not_obeyed(words: str) -> None:
    assert shown(text.printable(words))
    assert len(text.quoted(words * 100)) <= 512
    if not any(unicodedata.category(character) == "Cs" for character in words):
        line = text.json_printable(msgspec.json.encode(words).decode())
        assert shown(line)
        assert json.loads(line) == words


@given(payload=st.binary(max_size=2 * SIZE) | st.binary(min_size=SIZE, max_size=SIZE))
def test_any_bytes_are_records_or_refused(payload: bytes) -> None:
    with contextlib.suppress(RefusedError):
        assert len(records.checked(payload)) % SIZE == 0


def test_records_are_taken_as_records() -> None:
    rows = np.zeros(3, DTYPE)
    rows["cycle"] = 5, 6, 7
    assert records.checked(rows.tobytes()) == rows.tobytes()
    rows["cycle"] = 5, 7, 8
    with pytest.raises(RefusedError):
        records.checked(rows.tobytes())


# ---------------------------------------------------------------------- the gateway


class FakeLink:
    """Takes what the gateway sends to the loop."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, packet: bytes) -> bool:
        assert len(packet) <= MAX_PACKET
        self.sent.append(packet)
        return True


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Gateway, FakeLink]]:
    folder = tmp_path_factory.mktemp("zenoh")
    link = FakeLink()
    with zenoh_session.open_service([f"unixsock-stream/{folder}/z"]) as opened:
        yield Gateway(CONFIG, link, lambda: None, opened, Guard(CONFIG)), link  # type: ignore[arg-type]


@given(
    kind=st.sampled_from(sorted(ROUTES)),
    key=keys,
    payload=payloads,
    encoding=st.sampled_from(ENCODINGS),
)
def test_the_gateway_takes_any_message(
    gateway: tuple[Gateway, FakeLink], kind: str, key: str, payload: bytes, encoding: str
) -> None:
    served, link = gateway
    served._refusals = Refusals(link, served._replies)  # type: ignore[arg-type]  # announces every refusal
    link.sent.clear()
    served._handle(Incoming(kind, key, len(payload), payload, encoding, None, time.monotonic_ns()))
    for packet in link.sent:
        request = packets.decode_request(packet[1:])
        said = request.notice if isinstance(request, Announcement) else request
        assert said.user == "" or text.is_name(str(said.user))
        if isinstance(said, Notice):
            assert shown(said.message)
            assert "internal error" not in said.message


@given(packet=st.binary(min_size=1, max_size=300) | st.builds(bytes.__add__, st.sampled_from((b"\1", b"\2")), payloads))
def test_the_gateway_outlives_any_packet(gateway: tuple[Gateway, FakeLink], packet: bytes) -> None:
    served, _ = gateway
    served._handle_packet(packet, lambda: None)


# ---------------------------------------------------------------------- what goes between the processes


def test_the_largest_message_of_a_goal_fits_into_a_packet() -> None:
    triple = (-0.12345678901234567,) * 3
    points = tuple(Point(n + 0.1, *triple, velocity=triple, acceleration=triple) for n in range(MAX_PART))
    goal = TrajectoryGoal(points, id="\U0001f916" * MAX_NAME, stretch=True, valid_for=1234.5678)
    request = GoalRequest(2**63, "u" * MAX_NAME, "\U0001f916" * MAX_NAME, goal, 2**63, withdrawn="w" * 512)
    assert len(packets.message(request)) <= MAX_PACKET
    assert len(packets.message(packets.ControlInput(2**63, 2**63, 2**63, request))) <= MAX_PACKET
    assert len(json.dumps(msgspec.to_builtins(goal), indent=2)) <= MAX_MESSAGE


def test_the_longest_trajectory_of_a_client_fits_into_its_users_memory() -> None:
    """Zenoh has a query's payload as well as the gateway."""
    triple = (-0.12345678901234567,) * 3
    points = tuple(Point(1e4 + n + 0.1, *triple, velocity=triple, acceleration=triple) for n in range(MAX_POINTS))
    sent = goal_messages(TrajectoryGoal(points, stretch=True, valid_for=1234.5678), "\U0001f916" * MAX_NAME)
    assert sum(2 * len(part) + OVERHEAD + MAX_BESIDE for part in sent) < MAX_UNREAD_OF_ONE


def test_a_packet_of_any_size_arrives_whole_or_is_refused_by_its_sender(tmp_path: Path) -> None:
    port = Port(links.listen(tmp_path / "port"))
    link = links.connect(tmp_path / "port")
    port.accept()
    with pytest.raises(TooLarge, match=f"exceed the maximum between processes, {MAX_SHARED}"):
        link.send(bytes(MAX_SHARED + 1))
    assert not port.send(bytes(MAX_SHARED + 1))
    assert port.dropped == 1
    assert port.connected
    sent = [bytes(size) for size in (MAX_PACKET, MAX_PACKET + 1, 1, MAX_SHARED)]
    assert all(map(port.send, sent))
    assert [link.receive() for _ in sent] == sent
    link.close()
    port.close()


@given(length=st.integers(0, 100_000))
@example(length=100_000)
def test_an_event_always_fits_into_a_packet(length: int) -> None:
    event = Event(
        "goal", "info", "\U0001f916" * length, id="i" * length, user="u" * length, seq=1, t=1.0, cycle=1, time=1.0
    )
    packet = packets.event_packet(event)
    assert len(packet) <= MAX_PACKET
    told = packets.decode_answer(packet[1:])
    assert isinstance(told, EventReport)
    assert told.event.message.startswith(event.message[:1000])


# ---------------------------------------------------------------------- what is taken can be driven


@settings(max_examples=30)
@given(
    x=st.sampled_from((0.0, 1e-310, 1e-17, 1e-9, 0.01, -0.02)),
    speed=st.sampled_from((1e-3, 0.5, 1.0)),
    blend=st.sampled_from((None, 0.0, 1e-310, 1e-9, 0.01, 1e3)),
    limit=st.sampled_from((None, 1e-4, 1e-2, 0.1)),
    percent=st.sampled_from((0.0, 1.0, 50.0, 200.0)),
)
def test_the_floors_and_ceilings_can_be_driven(
    x: float, speed: float, blend: float | None, limit: float | None, percent: float
) -> None:
    limits = {"velocity": [limit] * 3} if limit else None
    goal = {"kind": "pose", "x": x, "y": 0.0, "phi": 0.0, "speed": speed, "blend": blend, "limits": limits}
    taken: PoseGoal = boundary.decode(json.dumps(goal).encode(), Goal, "not a goal")
    rig = Rig()
    rig.enable()
    rig.command("override", percent / 100.0)
    assert isinstance(rig.send("g", taken), Accepted)
    rig.cycles(100)
    assert rig.mode in (Mode.MOVING, Mode.HOLDING), rig.control.fault
    rig.bus.shutdown()
