"""Who may ask the panel: only who has its token, on this machine's loopback, from the panel's own page."""

from __future__ import annotations

import http.client
import logging
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote, unquote, urlsplit

import made
import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from panel.fake_robot import FakeRobot
from trirail.client import trajectory
from trirail.client.async_client import AsyncRobot
from trirail.config import SIM, load
from trirail.errors import ServiceError
from trirail.panel import feed
from trirail.panel.recordings import Recordings
from trirail.panel.server import MAX_MESSAGE, Panel, refused
from trirail.telemetry.recorder import Recorder
from trirail.wire import zenoh_session
from trirail.wire.messages import CommandReply, RoleReply
from trirail.wire.state import Info, NamedPoses
from trirail.wire.stop_protocol import STOPS
from trirail.wire.vocabulary import Command
from waiting import WITHIN, wait_until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

TOKEN = "a-token"
PATH = f"/{TOKEN}/index.html"


@pytest.mark.parametrize(
    "host", ["127.0.0.1:9880", "localhost:9880", "localhost", "127.0.0.1:80", "[::1]:9880", "LOCALHOST:1"]
)
def test_who_has_the_token_on_the_loopback_may(host: str) -> None:
    """Whatever the port: ssh -L has another at its other end."""
    assert refused(TOKEN, PATH, [host], []) is None
    assert refused(TOKEN, f"/{TOKEN}/socket", [host], [f"http://{host}"]) is None


@pytest.mark.parametrize(
    "hosts",
    [
        [],
        [""],
        ["evil.example:9880"],
        ["127.0.0.1.evil.example:9880"],
        ["evil.example@127.0.0.1@evil.example"],
        ["192.168.1.7:9880"],
        ["127.0.0.1:9880", "evil.example"],
        ["[::1"],
        ["127.0.0.1\x00.evil.example"],
    ],
)
def test_a_name_of_elsewhere_is_refused(hosts: list[str]) -> None:
    """So is a page whose name was made to lead here after it was loaded."""
    assert refused(TOKEN, PATH, hosts, []) is not None


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "", "https://127.0.0.1:9880", "http://127.0.0.1:3000", "http://localhost:9880"],
)
def test_a_page_of_another_origin_is_refused(origin: str) -> None:
    assert refused(TOKEN, PATH, ["127.0.0.1:9880"], [origin]) is not None
    assert refused(TOKEN, PATH, ["127.0.0.1:9880"], ["http://127.0.0.1:9880", origin]) is not None


@given(st.text())
def test_no_other_token_opens(path: str) -> None:
    for asked in (path, f"/{path}", f"/{path}/{TOKEN}", f"//{TOKEN}/{path}", f"/{TOKEN}{path}"):
        may = re.match(rf"/?{TOKEN}(/|$)", asked) is not None
        assert (refused(TOKEN, asked, ["localhost"], []) is None) == may


# ---------------------------------------------------------------------- the same, asked of the server


@pytest.fixture(scope="module")
def panel() -> Iterator[Panel]:
    with Panel(FakeRobot().robot(), 0) as panel:
        yield panel


def ask(panel: Panel, path: str, **headers: str) -> http.client.HTTPResponse:
    parts = urlsplit(panel.url)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=WITHIN)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def test_the_page_is_served_with_what_keeps_it_to_itself(panel: Panel) -> None:
    answer = ask(panel, urlsplit(panel.url).path)
    assert answer.status == 200
    assert b"STOP" in answer.read()
    policy = str(answer.headers["Content-Security-Policy"])
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["Referrer-Policy"] == "no-referrer"
    assert answer.headers["Cache-Control"] == "no-store"


def test_nothing_is_served_without_the_token_or_under_another_name(panel: Panel) -> None:
    path = urlsplit(panel.url).path
    for asked, headers in (
        ("/", {}),
        ("/panel.js", {}),
        ("/wrong-token/", {}),
        (path, {"Host": "evil.example"}),
        (path, {"Origin": "http://evil.example"}),
    ):
        answer = ask(panel, asked, **headers)
        assert answer.status == 403
        assert path.strip("/") not in answer.read().decode()


def test_only_the_page_s_own_files_are_served(panel: Panel) -> None:
    path = urlsplit(panel.url).path
    for asked in ("../server.py", "%2e%2e/server.py", "../../../../../../etc/passwd", "nothing", "index.html/", "?x"):
        answer = ask(panel, f"{path}{asked}")
        assert answer.status == (200 if asked == "?x" else 404)


def test_regular_files_of_the_folder_of_recordings_are_sent_and_nothing_that_leads_elsewhere(tmp_path: Path) -> None:
    folder, secret = tmp_path / "recordings", tmp_path / "secret.rrd"
    folder.mkdir()
    secret.write_bytes(b"secret")
    (folder / "own.rrd").write_bytes(b"own")
    (folder / "link.rrd").symlink_to(secret)
    (folder / "near.rrd").symlink_to("own.rrd")
    (folder / "loop.rrd").symlink_to("loop.rrd")
    (folder / "folder.rrd").mkdir()
    os.mkfifo(folder / "fifo.rrd")

    def sent(name: str) -> bytes:
        here, browser = socket.socketpair()
        with browser:
            with here:
                opened: Any = SimpleNamespace(socket=here)
                Recordings("demo", lambda: str(folder)).send_file(opened, name, {})
            return browser.makefile("rb").read()

    assert sent("own.rrd").endswith(b"\r\n\r\nown")
    assert {sent(f"{name}.rrd") for name in ("link", "near", "loop", "folder", "fifo", "none")} == {b""}


def hear(panel: Panel, *, nothing: bool = False) -> None:
    """Wait until the panel has a state of the service; with `nothing`, until the service is silent."""
    with panel._feed.changed:
        assert panel._feed.changed.wait_for(lambda: (panel._feed.state is None) is nothing, WITHIN)


def test_the_recordings_are_those_of_the_service_that_runs_now(tmp_path: Path) -> None:
    """It may have been started again with another folder while the panel was open."""
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel:
        hear(panel)
        robot.silent.set()
        robot.told = msgspec.structs.replace(robot.told, recordings=str(tmp_path))
        hear(panel, nothing=True)
        robot.silent.clear()
        hear(panel)
        listed = msgspec.json.decode(ask(panel, f"{urlsplit(panel.url).path}sessions").read())
    assert listed == {"folder": str(tmp_path), "here": False, "sessions": [], "trouble": ""}


@pytest.mark.parametrize("later", [1.0, -1.0])
def test_a_service_that_starts_again_without_a_silence_is_described_again(later: float) -> None:
    """As where states are rare, or the panel was suspended meanwhile: the new service may have run for longer."""
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel:
        hear(panel)
        robot.told = msgspec.structs.replace(robot.told, version="99.9")
        robot.began += later
        with panel._feed.changed:
            assert panel._feed.changed.wait_for(lambda: b'"version":"99.9"' in panel._feed.messages["robot"], WITHIN)


def test_a_service_that_is_asked_before_it_can_answer_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that has just started publishes states, but its first answer may be late or lost."""
    robot, asked = FakeRobot(), threading.Event()

    def too_early() -> Info:
        asked.set()
        raise ServiceError("no answer")

    monkeypatch.setattr(feed, "USERS_PERIOD_S", 0.02)
    with Panel(robot.robot(), 0) as panel:
        hear(panel)
        robot.silent.set()
        hear(panel, nothing=True)
        robot.told = msgspec.structs.replace(robot.told, version="99.9")
        with monkeypatch.context() as starting:
            starting.setattr(robot, "info", too_early)
            robot.silent.clear()
            assert asked.wait(WITHIN)
        with panel._feed.changed:
            assert panel._feed.changed.wait_for(lambda: b'"version":"99.9"' in panel._feed.messages["robot"], WITHIN)


def test_named_poses_stay_where_a_question_for_them_is_not_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    robot, asked = FakeRobot(), threading.Event()

    def no_answer() -> None:
        asked.set()
        raise ServiceError("no answer")

    with Panel(robot.robot(), 0) as panel:
        hear(panel)
        monkeypatch.setattr(robot, "poses", no_answer)
        robot.teach("pick")
        robot.say("the last event")
        assert asked.wait(WITHIN)
        with panel._feed.changed:
            assert panel._feed.changed.wait_for(lambda: b"the last event" in panel._feed.events(0)[-1][1], WITHIN)
            assert msgspec.json.decode(panel._feed.messages["poses"])["names"] == ["park"]


def test_no_program_in_the_folder_of_recordings_is_run(tmp_path: Path) -> None:
    """Such as one beside the recordings that reads them, and has the name of a package."""
    recorder = Recorder(load(SIM), tmp_path, live=False, sidecars=True)
    recorder.records(made.records(0.1).tobytes())
    recorder.close()
    for name in ("msgspec", "csv"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit")
    recordings = Recordings("demo", lambda: str(tmp_path))
    (session,) = recordings.listed()["sessions"]
    assert session.session in str(recordings.report(session.session))


@pytest.mark.long
def test_recordings_of_a_service_on_another_machine_are_not_looked_for_here(tmp_path: Path) -> None:
    """The same folder here may contain recordings of another robot with the same name."""
    recorder = Recorder(load(SIM), tmp_path, live=False, sidecars=True)
    recorder.records(made.records(0.1).tobytes())
    recorder.close()
    robot = FakeRobot()
    path = f"recording/{recorder.path.name}", f"report/{recorder.path.stem}"
    for machine, here in (("another", False), (robot.told.machine, True), ("", True)):
        robot.told = msgspec.structs.replace(robot.told, recordings=str(tmp_path), machine=machine)
        with Panel(robot.robot(), 0) as panel:
            begin = urlsplit(panel.url).path
            listed = msgspec.json.decode(ask(panel, f"{begin}sessions").read())
            assert (listed["here"], bool(listed["sessions"])) == (here, here)
            assert [ask(panel, f"{begin}{each}").status for each in path] == [200 if here else 404] * 2


def test_a_report_says_which_file_of_the_session_is_left_out(tmp_path: Path) -> None:
    recorder = Recorder(load(SIM), tmp_path, live=False, sidecars=True)
    recorder.records(made.records(0.1).tobytes())
    recorder.close()
    (tmp_path / f"{recorder.path.stem}-part2.rrd").touch()
    report = str(Recordings("demo", lambda: str(tmp_path)).report(recorder.path.stem))
    assert f"{recorder.path.stem}-part2.rrd: cut off in its header: the recording is empty" in report
    assert "100 at 1000 Hz" in report


@pytest.mark.parametrize("name", ["best run.rrd", "Prüfung (2).rrd", 'a"b\r\nc.rrd', "%41.rrd", ".rrd"])
def test_a_recording_is_sent_whatever_its_user_has_called_it(name: str, tmp_path: Path) -> None:
    """It is in the list, as `trirail sessions` has it."""
    (tmp_path / name).write_bytes(b"own")
    robot = FakeRobot()
    robot.told = msgspec.structs.replace(robot.told, recordings=str(tmp_path))
    with Panel(robot.robot(), 0) as panel:
        sent = ask(panel, f"{urlsplit(panel.url).path}recording/{quote(name, safe='')}")
        assert (sent.status, sent.read()) == (200, b"own")
        disposition = str(sent.headers["Content-Disposition"])
        assert unquote(disposition.removeprefix("attachment; filename*=UTF-8''")) == name
        assert ask(panel, f"{urlsplit(panel.url).path}recording/..%2F{tmp_path.name}%2F{quote(name)}").status == 404


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_no_other_page_opens_the_socket(panel: Panel, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refusal, connect(socket_of(panel), origin=Origin(origin), legacy=True):
        pass
    assert refusal.value.response.status_code == 403


def socket_of(panel: Panel) -> str:
    return f"{panel.url.replace('http', 'ws')}socket"


def test_each_start_has_a_token_of_its_own(panel: Panel) -> None:
    with Panel(FakeRobot().robot(), 0) as other:
        tokens = {urlsplit(each.url).path for each in (panel, other)}
    assert len(tokens) == 2
    assert all(len(token) > 20 for token in tokens)


def test_it_listens_on_the_loopback_alone(panel: Panel) -> None:
    port = urlsplit(panel.url).port
    listening = Path("/proc/net/tcp").read_text() + Path("/proc/net/tcp6").read_text()
    found = re.findall(rf"^\s*\d+: ([0-9A-F]+):{port:04X} \S+ 0A ", listening, re.MULTILINE)
    assert found == ["0100007F"]


@pytest.mark.parametrize("port", [-1, 65536, 99999])
def test_what_is_no_port_is_told(port: int) -> None:
    with pytest.raises(ServiceError, match=f"port {port}: cannot listen"):
        Panel(FakeRobot().robot(), port)


def test_a_port_that_is_taken_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(ServiceError, match="cannot listen"):
        Panel(FakeRobot().robot(), taken.getsockname()[1])


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"[" * 3000,
        b'{"do": "fly"}',
        b'{"do": "hold"}',
        b'{"do": "hold", "velocity": [NaN, 0, 0], "seen": 1}',
        b'{"do": "hold", "velocity": [1e9, 0, 0], "seen": 1}',
        b'{"do": "command", "name": "reboot"}',
        b'{"do": "goal", "goal": {"kind": "pose", "x": NaN, "y": 0, "phi": 0}}',
        b'{"do": "goal", "goal": {"kind": "velocity", "x": 0.01, "y": 0, "phi": 0}}',
        b'{"do": "seen", "stamp": "x"}',
        b'{"do": "command", "name": "stop", "name": "enable"}',
        b'{"do": "command", "name": "stop", "n\\u0061me": "enable"}',
        b'{"do": "release", "do": "release"}',
    ],
)
def test_what_is_no_message_is_refused_and_the_tab_goes_on(panel: Panel, message: bytes) -> None:
    with connect(socket_of(panel), legacy=True) as opened:
        opened.send(message, text=True)
        opened.send('{"do": "command", "name": "pause"}')
        said: list[str] = []
        while not said or "done" not in said[-1]:
            said.append(str(opened.recv(WITHIN)))
    assert any("not a message of this page" in text for text in said)


BAD_VALUE = st.none() | st.text(max_size=5) | st.floats(0.1, 0.9) | st.lists(st.integers(), max_size=2)


@given(
    name=st.sampled_from(sorted(STOPS)),
    bad=st.tuples(st.just("seen"), BAD_VALUE)
    | st.tuples(st.sampled_from(["", "x", "stamp"]), BAD_VALUE | st.integers()),
    twice=st.booleans(),
)
def test_a_stop_stops_whatever_else_is_wrong_with_its_message(name: str, bad: tuple[str, object], twice: bool) -> None:
    message = msgspec.json.encode({"do": "command", "name": name, bad[0]: bad[1]}).decode()
    if twice:
        message = f'{{"do": "command", "seen": 1, "seen": 1, "name": "{name}"}}'
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:
        opened.send('{"do": "command", "name": "enable", "seen": "x"}')
        opened.send(message)
        opened.send('{"do": "end"}')
        told: list[dict[str, Any]] = []
        while len(told) < 4:
            if (said := msgspec.json.decode(opened.recv(WITHIN)))["tell"] in ("refused", "done"):
                told.append(said)
    assert sorted(said["tell"] for said in told) == ["done", *3 * ["refused"]]
    assert robot.commands == [name]


@pytest.mark.parametrize("end", ["released", "closed"])
def test_a_tab_keeps_the_lease_while_it_is_open_and_no_longer(end: str) -> None:
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:

        def done(name: str) -> None:
            opened.send(f'{{"do": "command", "name": "{name}", "seen": {10**15}}}')
            while f'"done","to":"{name}"' not in (said := str(opened.recv(WITHIN))):
                assert "refused" not in said

        done("acquire")
        deadline = time.monotonic() + WITHIN
        while robot.commands.count("acquire") < 4:  # signs of life, by nobody at the page
            assert time.monotonic() < deadline
            time.sleep(0.002)
        assert "release" not in robot.commands
        if end == "released":
            done("release")
        else:
            opened.close()
        while "release" not in robot.commands:
            assert time.monotonic() < deadline
            time.sleep(0.002)
        signs = robot.commands.count("acquire")
        assert robot.holder is None
    assert robot.commands.count("acquire") == signs


@pytest.mark.parametrize("second", ["takeover", "acquire", "release"])
def test_what_is_pressed_while_the_lease_is_being_taken_leaves_one_lease_to_give_back(second: str) -> None:
    """So a takeover by a double click, during which the service may take its time to stop the robot."""
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:

        def press(name: str) -> None:
            what = {"do": name} if name == "takeover" else {"do": "command", "name": name}
            opened.send(msgspec.json.encode(what | {"seen": 10**15}).decode())

        done: list[str] = []

        def until_done(*names: str) -> None:
            while not all(any(f'"done","to":"{name}"' in said for said in done) for name in names):
                done.append(str(opened.recv(WITHIN)))

        with robot.hanging("acquire"):
            press("takeover")
            press(second)
            press("pause")
            until_done("pause")
        until_done("takeover", second)
        if second != "release":
            press("release")
            until_done("release")
        assert (robot.holder, robot.forced) == (None, [True])


def test_the_last_override_counts_however_slow_the_answers_are() -> None:
    """So of a slider that is moved by keys: each press is a command, of which the first may be under way."""
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:

        def until(said: str) -> None:
            while said not in str(opened.recv(WITHIN)):
                pass

        with robot.hanging("override"):
            for percent in (95, 90, 85):
                opened.send(
                    f'{{"do": "command", "name": "override", "content": {{"percent": {percent}}}, "seen": {10**15}}}'
                )
            opened.send('{"do": "command", "name": "pause"}')
            until('"done","to":"pause"')
        until('"override":0.85')
        assert robot.commands == ["override", "pause", "override"]


def test_override_0_waits_for_no_other_override() -> None:
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:

        def override(percent: int) -> None:
            content = f'"content": {{"percent": {percent}}}, "seen": {10**15}'
            opened.send(f'{{"do": "command", "name": "override", {content}}}')

        with robot.hanging("override"):
            for percent in (50, 40, 0):
                override(percent)
            wait_until(lambda: robot.commands == ["override", "override"])  # 50 and 0
            override(30)
        while '"override":0.3' not in str(opened.recv(WITHIN)):
            pass
        assert len(robot.commands) == 3


@pytest.mark.parametrize("request_", [{"name": "override", "content": {"percent": 0.0}}, {"name": "release"}])
def test_what_reduces_motion_is_sent_however_many_requests_are_not_answered(request_: dict[str, Any]) -> None:
    robot = FakeRobot()
    goal = {"do": "goal", "goal": {"kind": "named", "name": "park"}, "seen": 10**15}
    with robot.hanging("goal"), Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:
        for message in [*[goal] * 9, {"do": "command"} | request_]:
            opened.send(msgspec.json.encode(message).decode())
        said = ""
        while f'"to":"{request_["name"]}"' not in said:
            said = str(opened.recv(WITHIN))
        assert '"tell":"done"' in said


@pytest.mark.parametrize("name", ["stop", "quick_stop", "disable"])
def test_a_stop_waits_for_no_call_that_a_congested_link_holds_up(name: str) -> None:
    free, held = threading.Event(), threading.Event()

    async def send() -> None:
        held.set()
        free.wait()  # as Zenoh's own send does, in the thread of the event loop

    with Panel(FakeRobot().robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:
        try:
            panel._loop.start(send())
            assert held.wait(WITHIN)
            opened.send(f'{{"do": "command", "name": "{name}"}}')
            while f'"done","to":"{name}"' not in str(opened.recv(WITHIN)):
                pass
            assert not free.is_set()
        finally:
            free.set()


def test_a_stop_that_fails_in_an_unexpected_way_is_answered_too(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = FakeRobot()

    def fail(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(robot, "command", fail)
    with Panel(robot.robot(), 0) as panel:
        (refused,) = replies(panel, robot, [], 0)
        assert (refused["tell"], refused["to"]) == ("refused", "stop")
        assert "can't start new thread" in refused["message"]


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[list[str]]:
    """Goals and commands that reach the robot demo at a socket in `tmp_path`, each of which is confirmed."""
    found: list[str] = []

    def answer(query: zenoh.Query) -> None:
        kind, *names = str(query.key_expr).split("/")[2:]
        if kind in ("goal", "cmd"):
            found.append("/".join((kind, *names[1:])))
        fixed = {"info": FakeRobot().info(), "role": RoleReply("ann", "maintainer"), "poses": NamedPoses(())}
        with query:
            query.reply(query.key_expr, msgspec.json.encode(fixed.get(kind) or CommandReply(names[-1], "holding", 1)))

    with zenoh_session.open_service([f"unixsock-stream/{tmp_path}/zenoh"]) as session:
        _declared = session.declare_queryable("trirail/demo/**", zenoh.handlers.Callback(answer, indirect=False))
        yield found


@pytest.mark.parametrize(("request_", "stop"), [("follow", "stop"), ("follow", "pause"), ("enable", "disable")])
def test_what_was_pressed_before_a_stop_is_not_sent_after_it(
    request_: str, stop: str, asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, free, parse = threading.Event(), threading.Event(), trajectory.parse

    def hold(*arguments: Any) -> Any:
        held.set()
        assert free.wait(WITHIN)
        return parse(*arguments)

    async def send() -> None:
        held.set()
        free.wait()  # as Zenoh's own send does, where a link is congested

    monkeypatch.setattr(trajectory, "parse", hold)
    robot = AsyncRobot("demo", f"unixsock-stream/{tmp_path}/zenoh", "ann")
    with Panel(robot, 0) as panel, connect(socket_of(panel), legacy=True) as opened:

        def until(said: str) -> str:
            while said not in (text := str(opened.recv(WITHIN))):
                pass
            return text

        if request_ == "follow":
            path = b"t,x,y,phi\n0,0,0,0\n1,0.01,0,0\n"
            opened.send(f'{{"do": "upload", "file": 1, "name": "path.csv", "size": {len(path)}}}')
            opened.send(path)
            opened.send(f'{{"do": "follow", "file": 1, "seen": {10**15}}}')
        else:
            panel._loop.start(send())
            assert held.wait(WITHIN)
            opened.send(f'{{"do": "command", "name": "{request_}", "seen": {10**15}}}')
        assert held.wait(WITHIN)
        opened.send(f'{{"do": "command", "name": "{stop}"}}')
        until(f'"done","to":"{stop}"')
        free.set()
        assert '"code":"stopped"' in until(f'"refused","to":"{request_}"')
        assert asked == [f"cmd/{stop}"]


REDUCES = {"disable", "stop", "quick_stop", "pause", "release"}
"""Commands that only reduce motion."""
ACTS: list[dict[str, Any]] = [
    {"do": "goal", "goal": {"kind": "move", "x": 0.001, "y": 0.0, "phi": 0.0}},
    {"do": "goal", "goal": {"kind": "pose", "x": 0.0, "y": 0.0, "phi": 0.0}},
    {"do": "goal", "goal": {"kind": "named", "name": "park"}},
    {"do": "follow", "file": 0},
    *({"do": "command", "name": name} for name in Command if name not in REDUCES),
    {"do": "command", "name": "override", "content": {"percent": 50.0}},
    {"do": "command", "name": "set_output", "content": {"output": "valve", "value": True}},
    {"do": "takeover"},
    {"do": "teach", "name": "here"},
    {"do": "forget", "name": "park"},
]
"""Messages that do more than reduce motion, so the operator must have seen the robot as it is."""


def replies(panel: Panel, robot: FakeRobot, messages: list[dict[str, Any]], age_ms: int) -> list[dict[str, Any]]:
    """Send messages of a page whose newest state has an age, and STOP after them; return the replies."""
    seen = feed.now() - age_ms
    found: list[dict[str, Any]] = []
    with connect(socket_of(panel), legacy=True) as opened:
        for message in messages:
            opened.send(msgspec.json.encode(message | {"seen": seen}).decode())
        opened.send(msgspec.json.encode({"do": "command", "name": "stop", "seen": seen}).decode())
        while len(found) < len(messages) + 1:
            said = msgspec.json.decode(opened.recv(WITHIN))
            if said["tell"] in ("refused", "done", "accepted"):
                found.append(said)
    return found


@pytest.mark.parametrize("message", ACTS, ids=lambda message: str(message.get("name") or message["do"]))
def test_what_does_more_than_stop_is_refused_with_words_where_the_page_is_late(message: dict[str, Any]) -> None:
    """So is a press that a slow connection has held up. A stop is sent however late it is."""
    robot = FakeRobot()
    with Panel(robot.robot(), 0) as panel:
        refused, stopped = replies(panel, robot, [message], round(feed.MAX_STATE_AGE_S * 1000) + 1000)
        assert (refused["tell"], refused["code"]) == ("refused", "outdated")
        kinds = {"goal": message.get("goal", {}).get("kind"), "command": message.get("name")}
        assert refused["to"] == kinds.get(message["do"], message["do"])
        assert "press again" in refused["message"]
        assert (stopped["tell"], stopped["to"]) == ("done", "stop")
        done = [*robot.commands, *robot.gone_to, *robot.moved_to, *robot.followed, *robot.forced, *robot.named]
        assert done == ["stop", "park"]


@pytest.mark.parametrize("name", [*sorted(REDUCES), "override"])
def test_no_stop_is_refused_however_late_it_is(name: str) -> None:
    robot = FakeRobot()
    content = {"content": {"percent": 0.0}} if name == "override" else {}
    with Panel(robot.robot(), 0) as panel:
        replies(panel, robot, [{"do": "command", "name": name} | content], 10**9)
        assert name in robot.commands


def test_a_jog_of_a_late_page_is_refused_once_until_the_button_is_released() -> None:
    robot = FakeRobot()
    robot.mode = "holding"
    with Panel(robot.robot(), 0) as panel, connect(socket_of(panel), legacy=True) as opened:
        hold = {"do": "hold", "velocity": (0.01, 0.0, 0.0)}
        for age_ms in (10**6, 10**6, 0):
            opened.send(msgspec.json.encode(hold | {"seen": feed.now() - age_ms}).decode())
        opened.send('{"do": "command", "name": "pause"}')
        said: list[str] = []
        while not said or '"tell":"done"' not in said[-1]:
            said.append(str(opened.recv(WITHIN)))
        assert sum('"tell":"ended"' in text and "press again" in text for text in said) == 1
        assert robot.sent == []
        opened.send('{"do": "release"}')
        opened.send(msgspec.json.encode(hold | {"seen": feed.now()}).decode())
        wait_until(lambda: bool(robot.sent), "it jogs")


@pytest.mark.parametrize("end", ["cut off", "too large", "closed"])
def test_a_tab_that_goes_in_whatever_way_is_no_error(panel: Panel, end: str, caplog: pytest.LogCaptureFixture) -> None:
    before = set(threading.enumerate())
    opened = connect(socket_of(panel), legacy=True)
    opened.recv(WITHIN)
    serving = [thread for thread in threading.enumerate() if thread not in before and thread.name == "connection"]
    assert serving
    if end == "cut off":
        opened.socket.shutdown(socket.SHUT_RDWR)
    elif end == "too large":
        opened.send("x" * (MAX_MESSAGE + 1))
    else:
        opened.close()
    for thread in serving:
        thread.join(WITHIN)
        assert not thread.is_alive()
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_a_service_of_another_version_is_told_in_one_line() -> None:
    robot = FakeRobot()
    robot.told = msgspec.structs.replace(robot.told, limits={"platform": {}})
    with pytest.raises(ServiceError, match="another version"):
        Panel(robot.robot(), 0)


def test_a_state_that_was_delayed_has_its_own_time() -> None:
    """Whether ticks were missed meanwhile or not, and however the clocks of the two machines drift."""
    delay, state = feed.Delay(), FakeRobot().state()

    def came(at: float, delayed: float, overruns: int = 0) -> float:
        loop = msgspec.structs.replace(state.loop, overruns=overruns)
        sent = (at - delayed) * 1.0001
        return (
            delay.subtract(at * 1e3, msgspec.structs.replace(state, t=sent - overruns / loop.rate_hz, loop=loop)) / 1e3
        )

    for number in range(1, 5_000):
        assert abs(came(number * 2.0, 0.03) - number * 2.0) < 3e-3
    assert abs(came(10_001.0, 0.03, overruns=2000) - 10_001.0) < 2e-3
    for number in range(20):
        assert abs(came(10_002.0 + number * 0.2, 2.03, overruns=2000) - (10_000.0 + number * 0.2)) < 0.03
