"""The gateway among users with certificates, without, and with the wrong ones: what each is told, and what passes."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from certificates import tls_config, user
from control_rig import CONFIG
from ports import free_port
from processes.test_gateway import came
from refusals import refused_as
from trirail.cli import doctor, terminal
from trirail.cli.key_folder import KeyFolder
from trirail.cli.machine import Machine
from trirail.client import connection
from trirail.client.client import Robot
from trirail.config import Config, Tls, Zenoh
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.processes.certificate_expiry import STOP_BEFORE
from trirail.processes.gateway import Gateway
from trirail.processes.session_guard import Guard
from trirail.wire import packets, zenoh_session
from trirail.wire.credentials import Admission, Credentials
from trirail.wire.event_codes import EventCode
from trirail.wire.links import LinkClosed
from trirail.wire.messages import Event, GoalReply
from trirail.wire.packets import Accepted, Announcement, CommandDone, CommandRequest, GoalRequest, Request
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import Command, Stop
from waiting import WITHIN


class Loop:
    """Confirms every command and accepts every goal, and keeps what it was asked."""

    def __init__(self) -> None:
        self.asked: list[Request] = []
        self.answers: list[bytes] = []

    def send(self, packet: bytes) -> bool:
        request = packets.decode_request(packet[1:])
        self.asked.append(request)
        if isinstance(request, CommandRequest):
            self.answers.append(packets.message(CommandDone(request.ticket, request.name, "holding", 1)))
        elif isinstance(request, GoalRequest):
            self.answers.append(packets.message(Accepted(request.ticket, GoalReply(request.id, 1.0))))
        return True


STANDING = np.zeros(1, DTYPE)[0]
"""A record of a robot without power."""
STANDING["homed"] = 1
Served = tuple[Config, Path, Loop, Gateway]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A gateway that serves users of every kind, before a loop that does all it is told."""
    folder = tmp_path_factory.mktemp("tls")
    config, loop, over = tls_config(folder), Loop(), threading.Event()
    guard = Guard(config)
    with guard.open() as opened:
        gateway = Gateway(config, loop, lambda: None, opened, guard)  # type: ignore[arg-type]
        gateway._inbox.declare()

        def serve() -> None:
            while not over.wait(0.001):
                for incoming in gateway._inbox.next_messages(100):
                    gateway._handle(incoming)
                gateway._poses.measure(STANDING)
                gateway._poses.settle()
                while loop.answers:
                    gateway._handle_packet(loop.answers.pop(0), lambda: None)

        serving = threading.Thread(target=serve)
        serving.start()
        try:
            yield config, folder, loop, gateway
        finally:
            over.set()
            serving.join()


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "ROLE_WITHIN", WITHIN)


def robot(served: Served, name: str, **more: str) -> Robot:
    config, folder, *_ = served
    return Robot("demo", config.zenoh.listen[0], tls=user(folder, name), **more)


def pose(robot: Robot) -> None:
    robot.move_to(x=0.01, y=0.0, phi=0.0)


CARRYING = (Command.OVERRIDE, Command.SET_OUTPUT)
"""Commands that need a content."""
DOES: dict[str, Callable[[Robot], object]] = {
    "goal": pose,
    **{name: lambda robot, name=name: robot.command(name) for name in Command if name not in CARRYING},  # type: ignore[misc]
    "override": lambda robot: robot.override(50),
    "set_output": lambda robot: robot.set_output("valve", True),
    "info": lambda robot: robot.info(),
    "poses": lambda robot: robot.poses(),
    "teach": lambda robot: robot.teach("pick"),
    "forget": lambda robot: robot.forget("pick"),
}
NEEDS = {"stop": "viewer", "info": "viewer", "poses": "viewer"} | dict.fromkeys(
    ("reset", "home", "teach", "forget"), "maintainer"
)  # all else: operator
RANK = ["viewer", "operator", "maintainer"]


@pytest.mark.parametrize("does", DOES)
@pytest.mark.parametrize(("name", "role"), [("eva", "viewer"), ("ann", "operator"), ("max", "maintainer")])
def test_a_role_does_what_it_may_and_is_told_of_the_rest(served: Served, name: str, role: str, does: str) -> None:
    loop, needed = served[2], NEEDS.get(does, "operator")
    with robot(served, name) as asking:
        assert asking.user == name
        before = len(loop.asked)
        if RANK.index(role) >= RANK.index(needed):
            DOES[does](asking)
            if does not in ("info", "poses"):
                asked = loop.asked[before]
                assert (asked.notice if isinstance(asked, Announcement) else asked).user == name
            return
        began = time.monotonic()
        with pytest.raises(RefusedError) as caught:
            DOES[does](asking)
        assert time.monotonic() - began < connection.REPLY_WITHIN  # not as late as where nobody answers
        key = {"goal": f"goal/{name}", "teach": f"teach/{name}/pick", "forget": f"forget/{name}/pick"}.get(
            does, f"cmd/{name}/{does}"
        )
        assert caught.value.code is RefusalCode.NOT_ALLOWED
        assert str(caught.value) == f"{name} is {role} at robot demo: {key} needs the role {needed}"
        assert len(loop.asked) == before


@pytest.mark.parametrize("does", ["goal", "stop", "info"])
@pytest.mark.parametrize("name", ["una", "gone"])
def test_who_has_no_role_does_nothing_and_is_told(served: Served, name: str, does: str) -> None:
    with robot(served, name) as asking, pytest.raises(RefusedError) as caught:
        DOES[does](asking)
    assert caught.value.code is RefusalCode.NOT_ALLOWED
    said = f"{name} has no role at robot demo: [zenoh.users] does not list the user, or the user is revoked"
    assert str(caught.value) == said


def test_nobody_sends_in_the_name_of_another(served: Served) -> None:
    config, folder, loop, _ = served
    with refused_as(RefusalCode.NOT_ALLOWED):
        robot(served, "ann", user="max")
    before = len(loop.asked)
    with zenoh_session.open_client(config.zenoh.listen[0], Credentials.read(user(folder, "ann"))) as ann:
        assert list(ann.get("trirail/demo/cmd/max/stop", timeout=5.0)) == []
        assert list(ann.get("trirail/demo/cmd/*/stop", timeout=5.0)) == []
    assert len(loop.asked) == before


def test_a_strangers_event_reaches_nobody_and_the_robots_do_with_their_past(served: Served) -> None:
    config, folder, _, gateway = served
    for number in range(1, 6):
        gateway._publications.event(
            Event("service", "info", f"e{number}", seq=number, t=0.0, cycle=number, time=float(number))
        )
    with (
        robot(served, "eva") as eva,
        zenoh_session.open_client(config.zenoh.listen[0], Credentials.read(user(folder, "max"))) as stranger,
    ):
        heard = eva.events(history=True, timeout=WITHIN)
        assert [next(heard).message for _ in range(5)] == [f"e{number}" for number in range(1, 6)]
        lie = Event("goal", "info", "done: arrived", id="g", outcome="done", seq=99, t=9.0, cycle=9, time=99.0)
        for key in ("trirail/demo/event", "trirail/demo/state"):
            stranger.put(key, msgspec.json.encode(lie), encoding="application/json")
        (reply,) = stranger.get("trirail/demo/role/max", timeout=WITHIN)  # so that what was put has arrived before
        assert reply.ok is not None
        gateway._publications.event(Event("service", "info", "e6", seq=6, t=0.0, cycle=6, time=6.0))
        assert next(heard).message == "e6"
        assert eva.skipped == 0


def test_a_certificate_without_a_name_asks_nothing(served: Served) -> None:
    with pytest.raises(RefusedError, match="is without a common name"):
        robot(served, "nobody")
    config, folder, *_ = served
    with zenoh_session.open_client(config.zenoh.listen[0], Credentials.read(user(folder, "nobody"))) as nobody:
        for key in ("info", "cmd/ann/stop", "goal/ann"):
            assert list(nobody.get(f"trirail/demo/{key}", timeout=5.0)) == []


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("late", "expired on"),
        ("early", "check this machine's clock"),
        ("foreign", "not signed by the authority of ca.pem"),
        ("none", "none/ca.pem: No such file or directory"),
    ],
)
def test_credentials_that_are_no_good_are_told_before_anybody_is_asked(served: Served, name: str, said: str) -> None:
    with pytest.raises(ServiceError, match=said):
        robot(served, name)


@pytest.mark.long
@pytest.mark.parametrize("name", ["late", "early", "foreign"])
def test_the_robot_itself_opens_to_none_of_them(served: Served, name: str) -> None:
    config, folder, *_ = served
    credentials = Credentials(user(folder, name), name, datetime.now(UTC), ())  # not looked at by the client
    with pytest.raises(ServiceError, match=r"no service at tls/.*certificate.*; .*--tls"):
        zenoh_session.open_client(config.zenoh.listen[0], credentials)


@pytest.mark.long
def test_nobody_without_a_certificate_opens_a_session(served: Served) -> None:
    address = served[0].zenoh.listen[0].removeprefix("tls/")
    for protocol in ("tls", "tcp"):
        with pytest.raises(ServiceError, match="no service at"):
            zenoh_session.open_client(f"{protocol}/{address}")


@pytest.mark.long
@pytest.mark.parametrize("name", ["eva", "elsewhere", "foreign"])
def test_nobody_passes_himself_off_as_the_robot(served: Served, tmp_path: Path, name: str) -> None:
    """Neither with a user's certificate, nor with a robot's for another address, nor with another authority's."""
    folder = user(served[1], "eva")
    if name != "eva":
        folder = KeyFolder(tmp_path / name).create("demo", ["192.0.2.1"], 10.0).folder
    endpoint = f"tls/127.0.0.1:{free_port()}"
    trusted = Credentials.read(folder if name == "elsewhere" else user(served[1], "ann"))
    with zenoh_session.open_service([endpoint], Credentials.read(folder)), pytest.raises(ServiceError, match="no serv"):
        zenoh_session.open_client(endpoint, trusted)


def test_the_folder_of_the_user_is_found_by_default(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    config, folder, *_ = served
    place = folder / "config/trirail"
    place.mkdir(parents=True, exist_ok=True)
    if not (place / "demo").exists():
        (place / "demo").symlink_to(user(folder, "ann"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder / "config"))
    with Robot("demo", config.zenoh.listen[0]) as found:
        assert found.user == "ann"
        found.enable()


def test_what_would_not_be_encrypted_takes_no_credentials(served: Served) -> None:
    with pytest.raises(ServiceError, match="connect to tls/HOST:PORT"):
        Robot("demo", "tcp/127.0.0.1:1", tls=user(served[1], "ann"))


def test_who_is_revoked_while_named_is_told_at_the_start(served: Served) -> None:
    guard = Guard(served[0])
    assert guard.warnings() == ("gone is revoked and has no role; remove this user from [zenoh.users]",)
    assert guard.role("gone") is None


def test_a_service_does_not_start_with_certificates_that_are_no_good(tmp_path: Path) -> None:
    zenoh = Zenoh(("tls/127.0.0.1:1",), tls=Tls(str(tmp_path / "none")))
    with pytest.raises(ServiceError, match=r"none/ca\.pem: No such file"):
        Guard(msgspec.structs.replace(CONFIG, zenoh=zenoh))


def test_connections_that_open_no_session_are_counted_also_those_that_have_been_closed(tmp_path: Path) -> None:
    config = tls_config(tmp_path)
    guard, (endpoint,) = Guard(config), config.zenoh.listen
    with guard.open() as opened, zenoh_session.open_client(endpoint, Credentials.read(user(tmp_path, "ann"))):
        assert guard.unopened(guard.links(opened)) == {}
        with contextlib.ExitStack() as held:
            for _ in range(15):
                held.enter_context(socket.create_connection(("127.0.0.1", int(endpoint.rpartition(":")[2]))))
            assert guard.unopened(guard.links(opened)) == {"127.0.0.1": 15}
        left = guard.unopened(guard.links(opened))["127.0.0.1"]
        assert 0 < left <= 15
        while left:  # Zenoh is done with ten a second
            left = guard.unopened(guard.links(opened))["127.0.0.1"]


@pytest.mark.generated(0, 1, 2, 3)
def test_a_gateway_that_is_started_again_has_the_certificates_and_roles_of_the_service_s_start(
    tmp_path: Path, seed: int
) -> None:
    config, chance = tls_config(tmp_path), random.Random(seed)
    assert config.zenoh.tls is not None
    folder = Path(config.zenoh.tls.directory)
    admission = Admission.read(folder, config.zenoh.users)
    names = ["ca.pem", "cert.pem", "key.pem", "revoked.txt"]
    for name in chance.sample(names, chance.randrange(1, len(names) + 1)):
        if chance.random() < 0.3:
            (folder / name).unlink()
        else:
            (folder / name).write_bytes((folder / name).read_bytes()[: chance.randrange(9)])
    guard = Guard(config, admission)
    assert guard.users == admission.users
    assert "gone" not in guard.users
    with guard.open() as opened, contextlib.closing(guard.stop_port(lambda *_: None)):
        opened.declare_queryable("trirail/demo/role/ann", lambda query: query.reply("trirail/demo/role/ann", b"here"))
        with zenoh_session.open_client(config.zenoh.listen[0], Credentials.read(user(tmp_path, "ann"))) as ann:
            (reply,) = ann.get("trirail/demo/role/ann", timeout=WITHIN)
            assert reply.ok is not None


def test_an_open_door_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(("tcp/0.0.0.0:7447",), insecure=True))
    (said,) = Guard(config).warnings()
    assert (
        said == "insecure: anyone who can reach tcp/0.0.0.0:7447 can move the robot; "
        "make certificates with trirail keys init"
    )
    loop = {"lacking": [], "bus_load": 0.1}
    ready: dict[str, dict[str, Any]] = {
        "loop": loop,
        "recorder": {"live": "", "recording": "r"},
        "gateway": {"warnings": [said]},
    }
    terminal.up(config, ready)
    assert f"warning {said}" in capsys.readouterr().out


# ------------------------------------------------------------------ a socket of the machine's

CONNECT = """
import os, sys
from trirail.wire import zenoh_session
os.setgroups([int(sys.argv[3])])
os.setgid(int(sys.argv[3]))
os.setuid(int(sys.argv[2]))
zenoh_session.open_client(sys.argv[1]).close()
"""
OTHER, GROUP = 65_534, 54_321


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
@pytest.mark.long
def test_a_socket_lets_its_owner_and_group_in_and_nobody_else(tmp_path: Path) -> None:
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == os.getuid() and folder.is_relative_to("/tmp/") and folder != Path("/tmp"):
            folder.chmod(0o755)
    os.chown(tmp_path, -1, GROUP)
    tmp_path.chmod(0o2755)  # what is made in there belongs to the folder's group
    endpoint = f"unixsock-stream/{tmp_path}/z"
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh((endpoint,)))
    with Guard(config).open():
        assert stat.S_IMODE((tmp_path / "z").stat().st_mode) == 0o660

        def opens(group: int) -> bool:
            command = (sys.executable, "-c", CONNECT, endpoint, str(OTHER), str(group))
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
            assert done.returncode == 0 or "no service at" in done.stderr, done.stderr
            return done.returncode == 0

        assert opens(GROUP)
        assert not opens(OTHER)


def test_the_doctor_tells_who_can_reach_it(served: Served, tmp_path: Path) -> None:
    def said(zenoh: Zenoh, guard: Guard | str | None = None) -> list[tuple[str, str, str]]:
        config = msgspec.structs.replace(CONFIG, zenoh=zenoh)
        machine = Machine("", True, True, (), None, 0.0, 0, {}, (), None, "", guard=guard)
        return [(check.name, check.verdict, check.found) for check in doctor.network(config, machine)]

    reached = "tcp/127.0.0.1:7447: every user of this machine can command"
    assert said(Zenoh()) == [("network", "ok", reached)]
    assert said(Zenoh(("tcp/0.0.0.0:1",))) == [
        ("network", "warning", "tcp/0.0.0.0:1: everybody in the network can command")
    ]
    socket = "unixsock-stream//run/z"
    assert said(Zenoh((socket,))) == [
        ("network", "ok", f"{socket}: users with write access to the socket's file can command")
    ]
    tls = Zenoh(("tls/0.0.0.0:1",), tls=Tls())
    open_to = ("network", "ok", "tls/0.0.0.0:1: users with a certificate and a role can command")
    assert said(tls, "no certificates") == [open_to, ("certificates", "failure", "no certificates")]
    assert said(tls, Guard(served[0])) == [
        open_to,
        ("users", "ok", "eva viewer, ann operator, max maintainer"),
        ("certificates", "warning", "gone is revoked and has no role; remove this user from [zenoh.users]"),
    ]


class StillLoop(Loop):
    """Sends nothing, and ends when it has been asked for something of the type `awaited`."""

    def __init__(self, awaited: type[Request]) -> None:
        super().__init__()
        self._awaited = awaited
        self._own, self._other = socket.socketpair()

    def fileno(self) -> int:
        return self._own.fileno()

    def packets(self) -> Iterator[bytes]:
        if any(isinstance(request, self._awaited) for request in self.asked):
            raise LinkClosed
        yield from ()

    def receive(self) -> None:
        self._own.close()
        self._other.close()
        raise LinkClosed


@pytest.mark.parametrize("left", [STOP_BEFORE, timedelta(0)])
def test_the_robot_stops_before_its_certificate_expires_because_nobody_could_stop_it_later(
    tmp_path: Path, left: timedelta
) -> None:
    config, loop, now = tls_config(tmp_path), StillLoop(CommandRequest), datetime.now(UTC)
    read = Admission.read(tmp_path / "keys", config.zenoh.users)
    guard = Guard(config, read._replace(credentials=read.credentials._replace(expires=now + left)))
    with guard.open() as opened:
        gateway = Gateway(config, loop, lambda: None, opened, guard)  # type: ignore[arg-type]
        gateway._expiry._clock = lambda: now
        gateway.serve(lambda: None)
        announced, stop = loop.asked
        assert isinstance(announced, Announcement)
        assert (announced.notice.event_code, announced.notice.level) == (EventCode.CERTIFICATE_EXPIRES, "error")
        assert isinstance(stop, CommandRequest)
        assert (stop.name, stop.content) == (Command.STOP, Stop())
        for kind, content in (("goal/ann", b'{"kind": "pose", "x": 0, "y": 0, "phi": 0}'), ("cmd/ann/enable", b"")):
            gateway._handle(came(kind.partition("/")[0], f"trirail/demo/{kind}", content))
        assert not any(isinstance(request, GoalRequest) for request in loop.asked)
        assert [request.name for request in loop.asked if isinstance(request, CommandRequest)] == [Command.STOP]
        gateway._handle(came("cmd", "trirail/demo/cmd/ann/stop", b""))
        assert isinstance(loop.asked[-1], CommandRequest)
        told = len(loop.asked)
        gateway._expiry.poll()
        assert len(loop.asked) == told  # once
        gateway._expiry._clock = lambda: now - timedelta(seconds=1)  # the clock was set back
        gateway._expiry.poll()
        gateway._expiry._clock = lambda: now
        gateway._expiry.poll()
        assert len(loop.asked) == told + 2 * (left == STOP_BEFORE)


def test_a_certificate_that_ends_soon_is_told(tmp_path: Path) -> None:
    KeyFolder(tmp_path / "keys").create("demo", ["localhost"], 10.0)
    config = msgspec.structs.replace(CONFIG, zenoh=Zenoh(("tls/127.0.0.1:1",), tls=Tls(str(tmp_path / "keys"))))
    (said,) = Guard(config).warnings()
    assert said.endswith("keys: expires in 9 days; renew it with: trirail keys renew")
