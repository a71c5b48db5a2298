"""The door for stops among callers of every kind: who is heard, who is refused, and that nobody uses it up."""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest
import zenoh
from certificates import service_port, tls_config, user
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.client import stop_call
from trirail.client.stop_call import Outcome, Outcomes, StopCall, StopOrder, StopPortError
from trirail.config import Config, Zenoh
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes import stop_port
from trirail.processes.session_guard import Guard
from trirail.processes.sockets import Reserve, listen
from trirail.processes.stop_port import Answer
from trirail.wire import tls, zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.messages import CommandReply
from trirail.wire.stop_protocol import MAX_LINE, STOPS, StopAddress, StopRequest, stop_address
from trirail.wire.vocabulary import Command
from waiting import WITHIN, wait_until

DONE = CommandReply("stop", "holding", 1)
PLACES = 64


class Asked:
    """What passed the door; each is answered as it is told to be."""

    def __init__(self) -> None:
        self.requests: list[StopRequest] = []
        self.held: list[Answer] | None = None

    def __call__(self, request: StopRequest, answer: Answer) -> None:
        self.requests.append(request)
        if self.held is None:
            answer(DONE)
        else:
            self.held.append(answer)


@pytest.fixture(autouse=True)
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_port, "MAX_CALLERS", PLACES)


Opened = tuple[str, Asked]
Does = Callable[[socket.socket, int], None]


def opened(config: Config) -> Iterator[Opened]:
    asked = Asked()
    door = Guard(config).stop_port(asked)
    try:
        yield config.zenoh.listen[0], asked
    finally:
        door.close()


@pytest.fixture(params=["tcp", "unixsock-stream"])
def plain(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Opened]:
    where = f"127.0.0.1:{service_port()}" if request.param == "tcp" else f"{tmp_path}/z"
    yield from opened(msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"{request.param}/{where}",))))


@pytest.fixture
def secured(tmp_path: Path) -> Iterator[Opened]:
    yield from opened(tls_config(tmp_path))


def call(
    locator: str, name: str = "stop", user: str = "ann", shown: Path | None = None, content: bytes = b"", **of: str
) -> Outcome:
    """Ask once as a client does, and wait for what comes of it."""
    came: list[Outcome] = []
    stop = StopOrder.create(of.get("robot", "demo"), user, name, content, WITHIN)
    credentials = None if shown is None else Credentials.read(shown)
    calling = stop.at_door(locator, credentials, came.append)
    assert calling is not None
    calling.join()
    return came[0]


def door_of(locator: str) -> StopAddress:
    address = stop_address(locator)
    assert address is not None
    return address


def connected(locator: str) -> socket.socket:
    """Connect to the door and say nothing."""
    address = door_of(locator)
    if not isinstance(address.where, str):
        return socket.create_connection(address.where, WITHIN)
    connection = socket.socket(socket.AF_UNIX)
    connection.settimeout(WITHIN)
    connection.connect(address.where)
    return connection


@pytest.mark.parametrize("name", sorted(STOPS))
def test_a_stop_is_passed_on_with_key_id_and_content_and_answered(plain: Opened, name: str) -> None:
    locator, asked = plain
    assert call(locator, name, content=b'{"odd": 1') == DONE
    (request,) = asked.requests
    assert (request.key, request.content) == (f"trirail/demo/cmd/ann/{name}", '{"odd": 1')
    assert request.id


BUSY = RefusedError(RefusalCode.BUSY, "send fewer")
DENIED = RefusedError(RefusalCode.NOT_ALLOWED, "needs the role viewer")
SILENT = ServiceError("no robot answers")
NO_PORT = StopPortError("no stop port answers")


@pytest.mark.parametrize(
    ("came", "result"),
    [
        ([DONE], DONE),
        ([DENIED], DENIED),  # whatever comes of the other copy
        *(([failure, DONE], DONE) for failure in (BUSY, SILENT, NO_PORT)),
        *(([failure, DENIED], DENIED) for failure in (BUSY, SILENT, NO_PORT)),
        *(([*failures], BUSY) for other in (SILENT, NO_PORT) for failures in itertools.permutations((BUSY, other))),
        *(([*failures], SILENT) for failures in itertools.permutations((SILENT, NO_PORT))),
    ],
)
def test_a_stop_is_confirmed_by_one_copy_and_fails_if_it_is_refused_or_both_copies_fail(
    came: list[Outcome], result: Outcome
) -> None:
    outcomes = Outcomes(2)
    *failures, last = came
    for failure in failures:
        assert outcomes.decide(failure) is None
    if isinstance(result, CommandReply):
        assert outcomes.decide(last) is result
    else:
        with pytest.raises(type(result)) as raised:
            outcomes.decide(last)
        assert raised.value is result


@pytest.mark.parametrize("failure", [BUSY, SILENT, NO_PORT])
def test_the_failure_of_a_stops_only_copy_is_raised(failure: ServiceError | RefusedError) -> None:
    with pytest.raises(type(failure)):
        Outcomes(1).decide(failure)


def test_a_stop_that_is_cancelled_while_it_connects_is_not_sent(plain: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its other copy has been confirmed, and the robot may move again."""
    locator, asked = plain
    connecting, cancelled, connect = threading.Event(), threading.Event(), stop_call._connect

    def connect_slowly(address: StopAddress, within: float) -> socket.socket:
        connecting.set()
        assert cancelled.wait(WITHIN)
        return connect(address, within)

    monkeypatch.setattr(stop_call, "_connect", connect_slowly)
    came: list[Outcome] = []
    calling = StopOrder.create("demo", "ann", "stop", b"", WITHIN).at_door(locator, None, came.append)
    assert calling is not None
    assert connecting.wait(WITHIN)
    calling.cancel()
    cancelled.set()
    calling.join()
    assert isinstance(came[0], StopPortError)
    assert call(locator, "quick_stop") == DONE
    assert [request.key for request in asked.requests] == ["trirail/demo/cmd/ann/quick_stop"]


@pytest.mark.parametrize("name", sorted(set(Command) - STOPS))
def test_nothing_else_is_taken_there(plain: Opened, name: str) -> None:
    locator, asked = plain
    refused = call(locator, name)
    assert isinstance(refused, RefusedError)
    assert refused.code is RefusalCode.UNKNOWN_COMMAND
    assert asked.requests == []


def test_another_robots_door_is_none(plain: Opened) -> None:
    locator, asked = plain
    assert isinstance(call(locator, robot="other"), StopPortError)
    assert asked.requests == []


@pytest.mark.parametrize(
    "line", [b"\n", b"{}\n", b"x" * (MAX_LINE + 1), b"[" * 3000 + b"\n", b'{"key": "a"}\n', b"\xff\n"]
)
def test_junk_is_refused_or_let_go_and_the_next_is_heard(plain: Opened, line: bytes) -> None:
    locator, asked = plain
    with connected(locator) as junk:
        with contextlib.suppress(OSError):
            junk.sendall(line)
        with contextlib.suppress(OSError):
            assert b"reply" not in junk.recv(MAX_LINE)
    assert call(locator) == DONE
    assert len(asked.requests) == 1


@given(cut=st.integers(0, 100), newline=st.booleans())
def test_who_sends_no_more_is_answered_all_the_same(cut: int, newline: bool) -> None:
    """As `nc -N` does. A line without its end is a request as well, if it is whole."""
    request = msgspec.json.encode(StopRequest("trirail/demo/cmd/ann/stop"))
    line = request[: len(request) - cut]
    folder = tempfile.TemporaryDirectory()
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"unixsock-stream/{folder.name}/z",)))
    named = b'/stop"' in line
    with folder, contextlib.contextmanager(opened)(config) as (locator, asked), connected(locator) as calling:
        asked.held = []
        calling.sendall(line + b"\n" * newline)
        calling.shutdown(socket.SHUT_WR)
        if named:
            wait_until(lambda: bool(asked.held))
            asked.held.pop()(DONE)
        answer = calling.recv(MAX_LINE)
    whole = not cut
    assert (b'"reply"' in answer) == whole
    assert (b"malformed" in answer) == (not whole and bool(line or newline))
    assert (b"stop is carried out nevertheless" in answer) == (named and not whole)


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
NO_TEXT = ANY_JSON.filter(lambda value: not isinstance(value, str))
UNKNOWN = st.text(max_size=5).filter(lambda name: name not in ("key", "id", "content"))
BAD_FIELD = st.one_of(
    st.tuples(st.sampled_from(["id", "content"]), NO_TEXT),
    st.tuples(UNKNOWN, ANY_JSON),
    st.sampled_from([("key", None), ("id", "twice"), ("content", "{}")]),  # besides the valid ones: given twice
)
BAD_ENDS = (b"", b"]", b"}}", b', "content": {goal: 5}}', b', "id": NaN}', b', "content": "\xff"}')
LONG_ENDS = (b', "content": ' + b"[" * 3000, b', "content": "' + b"x" * MAX_LINE)


@st.composite
def spoiled_stops(draw: st.DrawFn, key: str) -> bytes:
    """Draw a line with the key of a stop, of which something else is invalid."""
    bad = draw(st.lists(BAD_FIELD, max_size=2))
    end: bytes = draw(st.sampled_from((b"}", *BAD_ENDS, *LONG_ENDS) if bad else BAD_ENDS + LONG_ENDS))
    fields: list[tuple[str, object]] = [("key", key), ("id", "s-1"), ("content", "")]
    fields = draw(st.permutations(fields + [(name, key if name == "key" else value) for name, value in bad]))
    members = b", ".join(msgspec.json.encode(name) + b": " + msgspec.json.encode(value) for name, value in fields)
    return b"{" + members + end


@given(name=st.sampled_from(sorted(STOPS)), data=st.data(), newline=st.booleans())
def test_a_line_with_the_key_of_a_stop_stops_whatever_else_is_wrong_with_it(
    name: str, data: st.DataObject, newline: bool
) -> None:
    line = data.draw(spoiled_stops(key := f"trirail/demo/cmd/ann/{name}"))
    folder = tempfile.TemporaryDirectory()
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"unixsock-stream/{folder.name}/z",)))
    with folder, contextlib.contextmanager(opened)(config) as (locator, asked), connected(locator) as calling:
        calling.sendall(line + b"\n" * newline)
        calling.shutdown(socket.SHUT_WR)
        answer = calling.recv(MAX_LINE)
    assert [(request.key, request.content) for request in asked.requests] == [(key, "")]
    if len(line) <= MAX_LINE:  # of a longer line, the rest may come before the answer
        assert b'"malformed"' in answer
        assert b"; stop is carried out nevertheless" in answer


@pytest.mark.parametrize("name", sorted(set(Command) - STOPS))
def test_nothing_but_a_stop_is_carried_out_of_an_invalid_line(plain: Opened, name: str) -> None:
    locator, asked = plain
    with connected(locator) as calling:
        calling.sendall(b'{"key": "trirail/demo/cmd/ann/%s", "id": 5}\n' % name.encode())
        assert b"unknown_command" in calling.recv(MAX_LINE)
    assert asked.requests == []


def test_an_invalid_line_stops_only_for_who_may(secured: Opened, tmp_path: Path) -> None:
    locator, asked = secured
    context = tls.client(Credentials.read(user(tmp_path, "ann")))
    for name in ("max", "ann"):
        with context.wrap_socket(connected(locator), server_hostname="127.0.0.1") as calling:
            calling.sendall(b'{"key": "trirail/demo/cmd/%s/stop", "content": {"goal": 5}}\n' % name.encode())
            answer = calling.recv(MAX_LINE)
        assert (b"not_allowed" in answer) == (name == "max")
    assert [request.key for request in asked.requests] == ["trirail/demo/cmd/ann/stop"]


def silent(connection: socket.socket, number: int) -> None:
    """Say nothing."""


def half(connection: socket.socket, number: int) -> None:
    """Say the beginning of a request, or of a handshake."""
    with contextlib.suppress(OSError):
        connection.sendall(b'{"key"' if number % 2 else b"\x16\x03\x01\x02\x00\x01")


def hold(held: contextlib.ExitStack, locator: str, does: Does, shown: Path | None = None) -> None:
    """Hold many more connections than there are places, and be heard in between."""
    for number in range(3 * PLACES):
        does(held.enter_context(connected(locator)), number)
        if not number % PLACES:
            assert call(locator, shown=shown) == DONE
    assert call(locator, shown=shown) == DONE


@pytest.mark.parametrize("does", [silent, half])
def test_whoever_comes_anew_is_heard_whatever_others_hold(plain: Opened, does: Does) -> None:
    locator, asked = plain
    with contextlib.ExitStack() as held:
        hold(held, locator, does)
    assert len(asked.requests) == 4


@pytest.mark.parametrize("does", [silent, half])
def test_and_so_is_whoever_has_a_certificate(secured: Opened, tmp_path: Path, does: Does) -> None:
    locator, asked = secured
    with contextlib.ExitStack() as held:
        hold(held, locator, does, user(tmp_path, "ann"))
    assert len(asked.requests) == 4


@pytest.mark.parametrize("name", ["gone", "eva"])
def test_sessions_of_another_certificate_that_say_nothing_keep_nobody_out(
    secured: Opened, tmp_path: Path, name: str
) -> None:
    locator, _ = secured
    context = tls.client(Credentials.read(user(tmp_path, name)))
    with contextlib.ExitStack() as held:

        def shake_hands(connection: socket.socket, _: int) -> None:
            held.enter_context(context.wrap_socket(connection, server_hostname="127.0.0.1"))

        hold(held, locator, shake_hands, user(tmp_path, "ann"))


def test_who_waits_for_his_answer_is_not_pushed_out_by_others(secured: Opened, tmp_path: Path) -> None:
    locator, asked = secured
    asked.held = []
    came: list[Outcome] = []
    stop = StopOrder.create("demo", "ann", "stop", None, WITHIN)
    waiting = stop.at_door(locator, Credentials.read(user(tmp_path, "ann")), came.append)
    assert isinstance(waiting, StopCall)
    with contextlib.ExitStack() as held:
        for _ in range(3 * PLACES):
            held.enter_context(connected(locator))
        eva = [
            stop.at_door(locator, Credentials.read(user(tmp_path, "eva")), came.append)
            for stop in (StopOrder.create("demo", "eva", "stop", None, WITHIN) for _ in range(4))
        ]
        while len({request.id for request in asked.requests}) < 5:
            assert not came
        while asked.held:
            asked.held.pop()(DONE)
        waiting.join()
        for calling in eva:
            assert calling is not None
            calling.cancel()
    assert DONE in came


@pytest.mark.parametrize("flood", ["silent", "half", "handshakes", "stops"])
def test_who_waits_for_an_answer_keeps_the_connection_whatever_others_open(
    secured: Opened, tmp_path: Path, flood: str
) -> None:
    locator, asked = secured
    asked.held = []
    contexts = {name: tls.client(Credentials.read(user(tmp_path, name))) for name in ("ann", "eva")}
    with contextlib.ExitStack() as held:

        def known(name: str) -> socket.socket:
            return held.enter_context(contexts[name].wrap_socket(connected(locator), server_hostname="127.0.0.1"))

        def ask(name: str, number: int) -> socket.socket:
            asking = known(name)
            asking.sendall(
                msgspec.json.encode(StopRequest(f"trirail/demo/cmd/{name}/stop", f"{name}-{number}")) + b"\n"
            )
            return asking

        waiting = ask("ann", 0)
        wait_until(lambda: bool(asked.requests))
        asked.requests.clear()
        for number in range(3 * PLACES + 1):
            match flood:
                case "silent":
                    held.enter_context(connected(locator))
                case "half":  # the beginning of a handshake
                    held.enter_context(connected(locator)).sendall(b"\x16\x03\x01\x02\x00\x01")
                case "handshakes":
                    known("eva")
            if flood == "stops" or number % 16 == 0:
                ask("eva", number)
                wait_until(lambda: bool(asked.requests))  # all earlier ones have been accepted
                asked.requests.clear()
        asked.held[0](DONE)
        assert b'"holding"' in waiting.recv(MAX_LINE)


@pytest.mark.parametrize(
    ("name", "command", "code"),
    [
        ("ann", "stop", None),
        ("ann", "quick_stop", None),
        ("max", "disable", None),
        ("eva", "stop", None),
        ("eva", "quick_stop", RefusalCode.NOT_ALLOWED),
        ("eva", "disable", RefusalCode.NOT_ALLOWED),
        ("una", "stop", RefusalCode.NOT_ALLOWED),
        ("gone", "stop", RefusalCode.NOT_ALLOWED),
    ],
)
def test_it_is_for_the_roles_that_may(
    secured: Opened, tmp_path: Path, name: str, command: str, code: RefusalCode | None
) -> None:
    locator, asked = secured
    outcome = call(locator, command, user=name, shown=user(tmp_path, name))
    assert len(asked.requests) == (code is None)
    assert (outcome.code if isinstance(outcome, RefusedError) else None) is code


def test_nobody_asks_in_anothers_name_or_with_a_certificate_that_is_no_good(secured: Opened, tmp_path: Path) -> None:
    locator, asked = secured
    refused = call(locator, user="ann", shown=user(tmp_path, "max"))
    assert isinstance(refused, RefusedError)
    assert refused.code is RefusalCode.NOT_ALLOWED
    unseen = [
        Credentials(user(tmp_path, name), name, Credentials.read(user(tmp_path, "ann")).expires, ())
        for name in ("foreign", "late")
    ]
    for credentials in unseen:
        came: list[Outcome] = []
        calling = StopOrder.create("demo", "ann", "stop", None, 1.0).at_door(locator, credentials, came.append)
        assert calling is not None
        calling.join()
        assert isinstance(came[0], ServiceError)
    assert asked.requests == []


def test_a_robot_whose_descriptors_are_used_up_hears_it_all_the_same(plain: Opened) -> None:
    locator, asked = plain
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    client = socket.socket(socket.AF_UNIX if locator.startswith("unix") else socket.AF_INET)
    address = door_of(locator)
    taken: list[socket.socket] = []
    try:
        most = max(map(int, os.listdir("/proc/self/fd")))  # of whatever else runs in this process
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, most + 64), hard))
        with pytest.raises(OSError, match="Too many open files"):
            taken.extend(socket.socket() for _ in itertools.count())
        client.settimeout(WITHIN)
        client.connect(address.where)
        client.sendall(msgspec.json.encode(StopRequest("trirail/demo/cmd/ann/stop", "s-1")) + b"\n")
        assert b'"holding"' in client.recv(MAX_LINE)
    finally:
        for one in (*taken, client):
            one.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert [request.id for request in asked.requests] == ["s-1"]


def test_what_is_released_of_a_reserve_is_kept_again(tmp_path: Path) -> None:
    reserve = Reserve(3)
    reserve.release()
    assert len(reserve) == 2
    opened = os.open(tmp_path / "file", os.O_CREAT | os.O_WRONLY)
    reserve.close(opened)
    assert len(reserve) == 3
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.write(opened, b"x")  # it is that of the null device now, for reading
    reserve.end()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(opened)


def test_an_address_that_is_taken_is_told_with_the_remedy_and_the_service_goes_on() -> None:
    port = service_port()
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"tcp/127.0.0.1:{port}",)))
    address = door_of(config.zenoh.listen[0])
    assert not isinstance(address.where, str)
    guard = Guard(config)
    with socket.create_server(address.where):
        door = guard.stop_port(lambda *_: None)
        assert any(f"no stop port at {address}" in warning for warning in guard.warnings())
        door.close()
    guard.stop_port(lambda *_: None).close()
    assert not any("no stop port" in warning for warning in guard.warnings())


def test_why_a_service_cannot_listen_is_said_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(locator: str) -> str:
        with pytest.raises(ServiceError) as refused:
            zenoh_session.open_service([locator]).close()  # type: ignore[no-untyped-call]
        return str(refused.value)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        locator = f"tcp/127.0.0.1:{port}"
        assert f"Address already in use ({locator}); end the other service" in refused(locator)
    assert "Cannot assign requested address" in refused(f"tcp/192.0.2.1:{port}")
    assert f"there is no folder {tmp_path}/none; create it" in refused(f"unixsock-stream/{tmp_path}/none/z")
    denied = {tmp_path}
    monkeypatch.setattr(os, "access", lambda path, _: path not in denied)
    with monkeypatch.context() as as_another_user:
        as_another_user.setattr(zenoh, "open", Mock(side_effect=zenoh.ZError("no")))
        assert f"this user may not write in {tmp_path}; change its rights" in refused(f"unixsock-stream/{tmp_path}/a")
        denied = {tmp_path / "a.lock"}
        (tmp_path / "a.lock").touch()
        assert "a.lock belongs to another user" in refused(f"unixsock-stream/{tmp_path}/a")
        denied = set()
        assert "end the other service that may use it" in refused(f"unixsock-stream/{tmp_path}/a")


def test_a_file_that_is_no_socket_is_kept_and_told_with_the_remedy(tmp_path: Path) -> None:
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"unixsock-stream/{tmp_path}/z",)))
    guard = Guard(config)
    for name in ("z", "z.stop"):
        (tmp_path / name).write_text("notes")
    with pytest.raises(ServiceError, match=r"cannot listen on .*/z: this file exists and is not a socket; move it aw"):
        guard.open()
    guard.stop_port(lambda *_: None).close()
    assert any(f"no stop port at {tmp_path}/z.stop (this file exists" in warning for warning in guard.warnings())
    assert [(tmp_path / name).read_text() for name in ("z", "z.stop")] == ["notes", "notes"]
    for name in ("z", "z.stop"):
        (tmp_path / name).unlink()
        with socket.socket(socket.AF_UNIX) as left:  # by a gateway that was killed
            left.bind(str(tmp_path / name))
    guard.stop_port(lambda *_: None).close()
    assert not any("no stop port" in warning for warning in guard.warnings())
    assert not (tmp_path / "z.stop").exists(), "the file is not left behind"
    with guard.open():
        pass


def test_a_socket_on_which_another_program_listens_is_left_alone(tmp_path: Path) -> None:
    guard = Guard(msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=(f"unixsock-stream/{tmp_path}/z",))))
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(f"{tmp_path}/z.stop")
        other.listen()
        guard.stop_port(lambda *_: None).close()
        assert any(f"no stop port at {tmp_path}/z.stop (address already in use" in said for said in guard.warnings())
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(f"{tmp_path}/z.stop")


ELSEWHERE = "192.0.2.1"


@pytest.mark.parametrize(
    ("addresses", "listened"),
    [
        (("127.0.0.1", ELSEWHERE), 1),
        ((ELSEWHERE, "127.0.0.1", "127.0.0.1"), 1),
        (("127.0.0.1", "127.0.0.2"), 2),
        ((ELSEWHERE,), 0),
    ],
)
def test_a_name_s_addresses_that_this_machine_does_not_have_keep_no_stop_out(
    monkeypatch: pytest.MonkeyPatch, addresses: tuple[str, ...], listened: int
) -> None:
    def resolved(_: str, port: int, type: int) -> list[object]:  # noqa: A002 - the name that it has in socket
        return [(socket.AF_INET, type, 6, "", (address, port)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", resolved)
    address = StopAddress(("robot.example", service_port()), secured=False)
    with contextlib.nullcontext() if listened else pytest.raises(OSError, match="requested address"):
        opened = listen(address)
        assert len(opened) == listened
        with pytest.raises(OSError, match="already in use"):
            listen(address)
        for each in opened:
            each.close()


def test_a_port_that_the_configuration_needs_for_more_is_not_taken() -> None:
    port = service_port()
    listen = (f"tcp/127.0.0.1:{port}",)
    address = door_of(listen[0])
    telemetry = msgspec.structs.replace(CONFIG.telemetry, live_port=int(address.where[1]))
    guard = Guard(msgspec.structs.replace(CONFIG, zenoh=Zenoh(listen=listen), telemetry=telemetry))
    door = guard.stop_port(lambda *_: None)
    assert any("which [telemetry] uses" in warning for warning in guard.warnings())
    door.close()


@pytest.mark.parametrize(("port", "door"), [(1, 1001), (7447, 8447), (64535, 65535), (64536, 63536), (65535, 64535)])
def test_where_the_door_is(port: int, door: int) -> None:
    assert door_of(f"tls/robot.example:{port}") == (("robot.example", door), True)
