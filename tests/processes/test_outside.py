"""What strangers, careless clients and accidents send to a whole service: it is answered, and nothing ends."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zenoh
from processes.test_service import SLOWLY, Service, until
from refusals import refused_as
from trirail.client.client import Robot
from trirail.errors import RefusalCode, RefusedError
from trirail.wire import boundary, records
from trirail.wire.goals import TrajectoryGoal, TrajectoryPoint
from trirail.wire.kinds.trajectory import parts
from trirail.wire.messages import Event
from trirail.wire.sizes import MAX_MESSAGE, MAX_POINTS, MAX_TRANSPORT
from trirail.wire.zenoh_session import open_client
from waiting import WITHIN
from warm import trirail

pytestmark = pytest.mark.slow

POSE = {"kind": "pose", "x": 0.0, "y": 0.0, "phi": 0.0}
UNSEEN = ("\x1b[2J", "\x9b31m", "\u202eevil", "a\0b", "forged\ntrirail: line", "a\u2028b", "\u200b", "\ue000")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Service, Robot, zenoh.Session]]:
    """One enabled service, which no test may end; it has the processes afterwards that it had before."""
    with Service(tmp_path_factory.mktemp("shared")) as service:
        service.wait_up()
        names = ("loop", "gateway", "planner", "recorder")
        before = [service.child(name) for name in names]
        with service.robot() as robot, open_client(service.locator) as session:
            robot.enable()
            yield service, robot, session
            assert robot.move_to(x=0.01, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        assert [service.child(name) for name in names] == before, service.log.read_text()
        assert service.end() == 0
        log = service.log.read_text()
        assert "Traceback" not in log
        assert all(line.isprintable() for line in log.splitlines()), log


def asked(session: zenoh.Session, key: str, **what: object) -> list[tuple[str, str]]:
    """Return what is answered: code and message of each error, or "ok" and the content as JSON."""
    found = []
    for reply in session.get(key, timeout=WITHIN, **what):  # type: ignore[call-overload]
        answer = reply.ok or reply.err
        packed = str(answer.encoding) == boundary.MSGPACK
        content = (msgspec.msgpack if packed else msgspec.json).decode(answer.payload.to_bytes())
        found.append(("ok", json.dumps(content)) if reply.ok else (content["code"], content["message"]))
    return found


# ---------------------------------------------------------------------- what cannot be read


@pytest.mark.parametrize(
    ("payload", "encoding", "code", "said"),
    [
        (b'{"a":' * 5000, "", "malformed", "not a goal"),
        (b"[" * 100_000, "", "malformed", "not a goal"),
        (b'{"kind":' * 5000, "", "malformed", "nested too deep"),
        (b"\x91" * 100_000, boundary.MSGPACK, "malformed", "not a goal"),
        (b"\x81\xa1a" * 50_000, boundary.MSGPACK, "malformed", "not a goal"),
        (b" " * (MAX_MESSAGE + 1), "", "too_large", f"exceed the maximum of {MAX_MESSAGE} bytes"),
        (bytes(MAX_TRANSPORT // 2), "", "too_large", f"exceed the maximum of {MAX_MESSAGE} bytes"),
        (json.dumps(POSE), "image/png", "unknown_encoding", "application/json"),
        (json.dumps(POSE | {"speed": 1e-310}), "", "malformed", ">= 0.001"),
        (json.dumps(POSE | {"valid_for": 1e300}), "", "malformed", "<= 86400"),
        (json.dumps(POSE | {"limits": {"jerk": [1e-300, 1, 1]}}), "", "malformed", ">= 0.0001"),
        (json.dumps(POSE | {"x": 1e300}), "", "malformed", "<= 1000"),
        (msgspec.msgpack.encode(POSE | {"x": math.nan}), boundary.MSGPACK, "malformed", ">= -1000"),
        (json.dumps(POSE | {"id": "x" * 65}), "", "malformed", "length <= 64"),
        *((json.dumps(POSE | {"id": name}), "", "malformed", "without control and formatting") for name in UNSEEN),
        (json.dumps(POSE | {"\x1b[2J": 0}), "", "malformed", r"unknown field \x1b[2J"),
    ],
)
def test_a_bad_goal_is_answered_with_what_would_be_right(
    shared: tuple[Service, Robot, zenoh.Session], payload: bytes | str, encoding: str, code: str, said: str
) -> None:
    _, robot, session = shared
    ((found, message),) = asked(session, "trirail/demo/goal/eve", payload=payload, encoding=encoding or None)
    assert found == code
    assert said in message
    assert message.isprintable()
    assert len(message) <= 600
    assert robot.state().mode == "holding"


@pytest.mark.parametrize(
    ("key", "code"),
    [
        ("trirail/demo/goal/*", "wildcard"),
        ("trirail/*/cmd/eve/stop", "wildcard"),
        (f"trirail/demo/goal/{'u' * 65}", "bad_name"),
        (f"trirail/demo/goal/{'u' * 30_000}", "bad_name"),
        ("trirail/demo/goal/a b", "bad_name"),
        ("trirail/demo/cmd/\x1b[2J/stop", "bad_name"),
        ("trirail/demo/cmd/eve/\u202estop", "unknown_command"),
        (f"trirail/demo/cmd/eve/{'s' * 30_000}", "unknown_command"),
    ],
)
def test_a_key_that_names_nobody_is_refused(shared: tuple[Service, Robot, zenoh.Session], key: str, code: str) -> None:
    _, robot, session = shared
    ((found, message),) = asked(session, key, payload=json.dumps(POSE))
    assert found == code
    assert message.isprintable()
    assert robot.state().mode == "holding"


@pytest.mark.parametrize("key", ["**", "trirail/**", "trirail/demo/**", "trirail/*/info", "*/demo/*"])
def test_a_discovery_is_answered(shared: tuple[Service, Robot, zenoh.Session], key: str) -> None:
    _, robot, session = shared
    found = asked(session, key)
    answers = [json.loads(content) for code, content in found if code == "ok"]
    assert [answer["robot"] for answer in answers if "poses" not in answer] == ["demo"]
    assert {code for code, _ in found} <= {"ok", "wildcard"}
    session.put(key, b"junk")
    session.delete(key)
    assert robot.state().mode == "holding"


def test_the_content_of_commands(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, session = shared
    key = "trirail/demo/cmd/eve/{}".format
    for percent in (1e-310, 0.5, -1.0, 201.0, 1e300, "1"):
        ((code, message),) = asked(session, key("override"), payload=json.dumps({"percent": percent}))
        assert (code, message[:16]) == ("malformed", "override accepts")
    assert asked(session, key("override"))[0][0] == "malformed"
    packed = msgspec.msgpack.encode({"percent": 100})
    assert asked(session, key("override"), payload=packed, encoding=boundary.MSGPACK)[0][0] == "ok"
    for content in (b"", b"{}", b"null"):
        assert asked(session, key("stop"), payload=content)[0][0] == "ok"
        until(robot, lambda state: state.mode == "holding")
    assert "accepts no content" in asked(session, key("pause"), payload=b'{"a":' * 5000)[0][1]


@pytest.mark.parametrize(
    ("name", "payload", "encoding", "code"),
    [
        ("stop", b'{"goal": 5}', "", "malformed"),
        ("stop", b'{"a":' * 5000, "", "malformed"),
        ("stop", b"please", "image/png", "unknown_encoding"),
        ("stop", b" " * (MAX_MESSAGE + 1), "", "too_large"),
        ("quick_stop", b"\xff now!", "", "malformed"),
        ("disable", b"true", "", "malformed"),
    ],
)
def test_a_stop_that_cannot_be_read_stops_the_robot_all_the_same(
    shared: tuple[Service, Robot, zenoh.Session], name: str, payload: bytes, encoding: str, code: str
) -> None:
    _, robot, session = shared
    robot.override(100)
    robot.enable()
    goal = robot.move_to(x=0.05 if robot.state().pose[0] < 0.0 else -0.05, y=0.0, phi=0.0, speed=SLOWLY)
    until(robot, lambda state: state.mode == "moving")
    ((found, message),) = asked(session, f"trirail/demo/cmd/eve/{name}", payload=payload, encoding=encoding)
    assert found == code
    assert message.endswith(f"; {name} is carried out nevertheless")
    assert goal.wait(WITHIN).outcome in ("stopped", "faulted")
    until(robot, lambda state: state.mode == {"stop": "holding", "quick_stop": "fault", "disable": "disabled"}[name])
    if name == "quick_stop":
        robot.reset()
    robot.enable()


# ---------------------------------------------------------------------- what is documented


def test_the_longest_trajectory_is_taken_in_every_way(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, session = shared
    x, y, phi = robot.state().commanded.pose
    times = [0.0123456789012345 * n for n in range(MAX_POINTS)]
    still = (0.0, 0.0, 0.0)
    points = [TrajectoryPoint(t, x, y, phi, velocity=still, acceleration=still) for t in times]
    goal = robot.follow(points)
    goal.cancel()
    encoders: tuple[tuple[Callable[[object], bytes], str], ...] = (
        (lambda message: json.dumps(message).encode(), boundary.JSON),
        (msgspec.msgpack.encode, boundary.MSGPACK),
    )
    for encode, encoding in encoders:
        sent = parts(TrajectoryGoal(tuple(points), encoding.replace("/", "-")))
        first, *others = (encode(msgspec.to_builtins(part)) for part in sent)
        for part in others:
            session.put(
                "trirail/demo/goal/ann", part, encoding=encoding, congestion_control=zenoh.CongestionControl.BLOCK
            )
        ((code, content),) = asked(session, "trirail/demo/goal/ann", payload=first, encoding=encoding)
        assert code == "ok", content
        robot.stop()
        until(robot, lambda state: state.mode == "holding")


def test_a_client_refuses_itself_a_trajectory_of_too_many_points(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    _, robot, _ = shared
    points = [TrajectoryPoint(float(n), 0.0, 0.0, 0.0) for n in range(10_000)]
    with refused_as(RefusalCode.MALFORMED):
        robot.follow(points)


def test_what_is_larger_than_the_transport_takes_costs_nobody_else(
    shared: tuple[Service, Robot, zenoh.Session],
) -> None:
    service, robot, _ = shared
    with open_client(service.locator) as greedy:
        for _ in range(3):
            greedy.put("trirail/demo/goal/eve", bytes(3 * MAX_TRANSPORT))
        assert [code for code, _ in asked(greedy, "trirail/demo/info")] == ["ok"]
    assert robot.state().mode == "holding"


def test_an_override_that_is_none_is_refused_in_a_line(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, _ = shared
    for percent in (math.nan, 0.5, 201.0, -1.0):
        with pytest.raises(RefusedError):
            robot.override(percent)
    refused = trirail("override", 0.5, locator=service.locator)
    assert refused.returncode == 2
    assert refused.stderr.startswith(
        "trirail: Invalid value for PERCENT: '0.5' is not an override: use 0, or 1 to 200 %"
    )


# ---------------------------------------------------------------------- each is answered once


@pytest.mark.alone
@pytest.mark.parametrize("clients", [1, 8])
def test_every_goal_of_many_threads_is_answered_once(
    shared: tuple[Service, Robot, zenoh.Session], clients: int
) -> None:
    service, robot, _ = shared
    threads, goals = 8, 500
    answers: Counter[str] = Counter()
    failures: list[Exception] = []
    ended: Counter[str] = Counter()
    heard = threading.Event()

    def listen() -> None:
        for event in robot.events(history=True, timeout=WITHIN):
            heard.set()
            if event.outcome and event.id and event.id.startswith(f"{clients}-"):
                ended[event.id] += 1
                if len(ended) == threads * goals:
                    return

    def send(client: Robot, thread: int) -> None:
        for number in range(goals):
            # two of three are refused at once, the others preempt each other
            x = 0.5 if number % 3 else 0.01 * (number % 5)
            name = f"{clients}-{thread}-{number}"
            try:
                client.move_to(x=x, y=0.0, phi=0.0, id=name)
            except RefusedError:
                pass
            except Exception as error:  # noqa: BLE001 - all of them are to be seen
                failures.append(error)
            answers[name] += 1

    with contextlib.ExitStack() as stack:
        own = [stack.enter_context(Robot("demo", service.locator, user=f"u{n}")) for n in range(clients)]
        listening = threading.Thread(target=listen)
        listening.start()
        assert heard.wait(WITHIN)  # the past at first: it listens
        sending = [threading.Thread(target=send, args=(own[n % clients], n)) for n in range(threads)]
        for thread in sending:
            thread.start()
        for thread in sending:
            thread.join()
        listening.join()
    assert failures == []
    assert len(answers) == threads * goals
    assert set(ended.values()) == {1}
    assert set(ended) == set(answers)
    until(robot, lambda state: state.mode == "holding")


def test_an_asker_that_is_frozen_holds_up_nobody(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, _ = shared
    script = """
import sys
from trirail.wire.zenoh_session import open_client
session = open_client(sys.argv[1])
print("ready", flush=True)
while True:  # asks, and is stopped in the middle of it
    for _ in range(200):
        session.get("trirail/demo/info", lambda reply: None, timeout=30.0)
"""
    with contextlib.ExitStack() as stack:
        frozen = []
        for _ in range(3):
            asker = subprocess.Popen([sys.executable, "-c", script, service.locator], stdout=subprocess.PIPE)
            stack.callback(asker.wait)
            stack.callback(asker.kill)
            assert asker.stdout is not None
            stack.callback(asker.stdout.close)
            assert asker.stdout.readline() == b"ready\n"
            frozen.append(asker)
        for _ in range(3):
            with contextlib.suppress(RefusedError):  # the askers' questions fill the queue of users without a name
                robot.info()
        for asker in frozen:
            os.kill(asker.pid, signal.SIGSTOP)
        for number in range(20):
            with contextlib.suppress(RefusedError):
                robot.move_to(x=0.5, y=0.0, phi=0.0, id=f"beside-{os.getpid()}-{number}")
            robot.stop()
        for _ in itertools.islice(robot.states(2.0), 20):
            pass
    # Later, each connection that times out blocks one of these for 10 s.
    names = [task.read_text() for task in Path(f"/proc/{service.child('gateway')}/task").glob("*/comm")]
    assert sum(name.startswith("rx-") for name in names) >= 8, names


# ---------------------------------------------------------------------- what strangers publish


JUNK = (b"", b"junk", b'{"a":' * 5000, b"\xff" * 1000, b"null", b"[]", b"{}", b"0" * 300_000)


@contextlib.contextmanager
def published(session: zenoh.Session, *messages: tuple[str, bytes]) -> Iterator[None]:
    """Publish messages by key again and again: who listens since when is nobody's to know."""
    over = threading.Event()

    def publish() -> None:
        for key, payload in itertools.cycle(messages):
            session.put(key, payload)
            if over.wait(0.0005):
                return

    publishing = threading.Thread(target=publish)
    publishing.start()
    try:
        yield
    finally:
        over.set()
        publishing.join()


def test_clients_skip_what_is_no_message(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, robot, session = shared
    forged = msgspec.json.encode(
        Event("service", "info", "[/]\x1b[2J\u202e\nforged: a line", seq=10**6, t=1.0, cycle=1, time=2e9)
    )
    junk = [(f"trirail/demo/{key}", each) for each in JUNK for key in ("state", "event", "records")]
    with published(session, *junk, ("trirail/demo/event", forged)):
        status = trirail("status", locator=service.locator)
        moved = trirail("goto", 0.0, 0.01, 0.0, "--wait", locator=service.locator)
        heard: list[bytes] = []
        with robot.records(heard.append):
            assert robot.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        seen = next(event for event in robot.events(timeout=WITHIN) if event.message.startswith("[/]"))
    for ran in (status, moved):
        assert ran.returncode == 0, ran.stderr
        assert "Traceback" not in ran.stderr
        assert len(ran.stderr.splitlines()) <= 1
    assert robot.skipped > 0
    assert heard
    assert all(records.checked(batch) for batch in heard)
    assert seen.seq == 10**6


def test_what_was_forged_is_shown_as_what_it_is(shared: tuple[Service, Robot, zenoh.Session]) -> None:
    service, _, session = shared
    forged = msgspec.json.encode(
        Event("service", "info", "[/] [bold]\x1b[2J\x9b\u202e\nmode: fault", seq=10**7, t=1.0, cycle=1, time=3e9)
    )
    with (
        events(service, "events") as lines,
        events(service, "events", "--json") as json_lines,
        published(session, ("trirail/demo/event", forged)),
    ):
        while "[bold]" not in (line := lines()):
            pass
        while "[bold]" not in (packed := json_lines()):
            pass
    assert r"[/] [bold]\x1b[2J\x9b\u202e\nmode: fault" in line
    assert packed.isascii()
    assert json.loads(packed)["message"].endswith("\nmode: fault")


@contextlib.contextmanager
def events(service: Service, *arguments: str) -> Iterator[Callable[[], str]]:
    """Follow the events on a terminal; gives what reads a line of it."""
    command = [sys.executable, "-m", "trirail", *arguments, "--connect", service.locator]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as shown:
        assert shown.stdout is not None
        try:
            yield lambda: shown.stdout.readline().rstrip("\n") if shown.stdout else ""
        finally:
            shown.send_signal(signal.SIGINT)


# ---------------------------------------------------------------------- careless programs


@pytest.mark.parametrize("how", ["ends", "raises", "waits"])
def test_a_program_that_never_closes_its_robot_ends_all_the_same(
    shared: tuple[Service, Robot, zenoh.Session], how: str
) -> None:
    service, _, _ = shared
    script = f"""
import sys, threading
from trirail.client.client import Robot
robot = Robot("demo", {service.locator!r}, user="careless")
states = robot.states()
next(states)
robot.events(history=True)
kept = robot.records(lambda batch: None)
print("there", flush=True)
if {how!r} == "raises":
    raise SystemExit(3)
if {how!r} == "waits":
    for state in states:
        pass
"""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "there\n"
        if how == "waits":
            program.send_signal(signal.SIGINT)
        try:
            _, said = program.communicate(timeout=WITHIN)
        except subprocess.TimeoutExpired:
            program.kill()
            raise
    assert program.returncode == {"ends": 0, "raises": 3, "waits": -signal.SIGINT}[how], said
    assert ("KeyboardInterrupt" in said) == (how == "waits")
    assert "panicked" not in said
    assert "Fatal" not in said


def test_bad_names_are_said_at_once(tmp_path: Path) -> None:
    for names in ({"name": "de/mo"}, {"name": "*"}, {"name": "demo", "user": "a b"}, {"name": "x" * 65}):
        with refused_as(RefusalCode.BAD_NAME):
            Robot(connect=f"unixsock-stream/{tmp_path}/none", **names)
