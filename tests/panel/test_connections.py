"""Who holds connections to the panel's server, in whatever way and however many, keeps nobody else away."""

from __future__ import annotations

import contextlib
import http.client
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from panel.fake_robot import FakeRobot
from trirail.panel.connections import MAX_REQUESTS, MAX_TABS
from trirail.panel.server import Panel
from trirail.panel.tab_requests import MAX_PENDING
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

pytestmark = pytest.mark.long

PATIENCE = 60.0


class Served(NamedTuple):
    """`trirail panel` in a process of its own."""

    process: subprocess.Popen[bytes]
    url: str

    @property
    def address(self) -> tuple[str, int]:
        parts = urlsplit(self.url)
        return str(parts.hostname), parts.port or 0

    def page(self) -> int:
        """Ask for the page as a browser does; return the status."""
        connection = http.client.HTTPConnection(*self.address, timeout=PATIENCE)
        try:
            connection.request("GET", urlsplit(self.url).path)
            return connection.getresponse().status
        finally:
            connection.close()

    def tab(self) -> ClientConnection:
        return connect(f"{self.url.replace('http', 'ws')}socket", legacy=True)

    def hold(self, way: str) -> socket.socket:
        """Connect, and then say nothing, or not all of it, or read nothing of what was asked for."""
        held = socket.create_connection(self.address, PATIENCE)
        path = urlsplit(self.url).path
        host = f"Host: {self.address[0]}:{self.address[1]}\r\n"
        said = {
            "bare": "",
            "half": f"GET {path} HTTP/1.1\r\n{host}",
            "deaf": f"GET {path}panel.js HTTP/1.1\r\n{host}\r\n",
            "junk": "\x16\x03\x01 no HTTP\r\n\r\n",
        }[way]
        with contextlib.suppress(OSError):  # it may have been told to go at once
            held.sendall(said.encode())
        return held


@contextlib.contextmanager
def served(most: int) -> Iterator[Served]:
    """Run it with so many descriptors."""
    script = Path(__file__).with_name("panel_process.py")
    with subprocess.Popen([sys.executable, script, str(most)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            yield Served(process, msgspec.json.decode(process.stdout.readline())["url"])
        finally:
            process.kill()


@pytest.fixture(scope="module", params=[96, 256])
def panel(request: pytest.FixtureRequest) -> Iterator[Served]:
    """With fewer descriptors than connections take, and with more."""
    with served(request.param) as served_:
        yield served_


@pytest.fixture(scope="module")
def tab(panel: Served) -> Iterator[ClientConnection]:
    with panel.tab() as opened:
        yield opened


def stop(tab: ClientConnection) -> None:
    """Press STOP; be told that it was done."""
    tab.send('{"do": "command", "name": "stop"}')
    while '"done","to":"stop"' not in (said := str(tab.recv(PATIENCE))):
        assert "refused" not in said


WAYS = st.sampled_from(["bare", "half", "deaf", "junk", "let go"])


@settings(max_examples=15)
@given(st.lists(st.tuples(WAYS, st.integers(1, 2 * MAX_REQUESTS)), min_size=1, max_size=6))
def test_whatever_is_held_the_page_is_served_and_an_open_tab_stops(
    panel: Served, tab: ClientConnection, turns: list[tuple[str, int]]
) -> None:
    with contextlib.ExitStack() as held:
        for way, number in turns:
            if way == "let go":
                held.close()
            else:
                for _ in range(number):
                    held.enter_context(contextlib.closing(panel.hold(way)))
            stop(tab)
        assert panel.page() == 200
        stop(tab)
    assert panel.page() == 200


@pytest.mark.parametrize("most", [256, 1024])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_whatever_is_held(number: signal.Signals, most: int) -> None:
    """Long before who says nothing is let go for that."""
    with served(most) as panel, contextlib.ExitStack() as held:
        tabs = [held.enter_context(panel.tab()) for _ in range(3)]
        for n in range(400):
            held.enter_context(contextlib.closing(panel.hold(("bare", "half", "deaf")[n % 3])))
        for tab in tabs:
            stop(tab)
        panel.process.send_signal(number)
        assert panel.process.wait(PATIENCE) == 0


def test_it_serves_again_when_there_are_descriptors_again() -> None:
    """Whoever takes them: here none is to be had for a while, which its limits cannot know beforehand."""
    with served(256) as panel, panel.tab() as tab, contextlib.ExitStack() as held:
        for _ in range(2):
            _, most = resource.prlimit(panel.process.pid, resource.RLIMIT_NOFILE, (3, 256))
            for _ in range(5):
                held.enter_context(contextlib.closing(panel.hold("bare")))
            stop(tab)
            resource.prlimit(panel.process.pid, resource.RLIMIT_NOFILE, (most, most))
            assert panel.page() == 200
            stop(tab)


def test_more_tabs_than_there_may_be_are_refused_in_a_sentence() -> None:
    with Panel(FakeRobot().robot(), 0) as inside, contextlib.ExitStack() as tabs:
        url = f"{inside.url.replace('http', 'ws')}socket"
        opened = [tabs.enter_context(connect(url, legacy=True)) for _ in range(MAX_TABS)]
        with pytest.raises(InvalidStatus) as refusal, connect(url, legacy=True):
            pass
        assert refusal.value.response.status_code == 503
        assert b"close one" in refusal.value.response.body
        for tab in opened:
            stop(tab)
        opened[0].close()
        assert _opens(url)


def _opens(url: str) -> bool:
    """Whether a tab can be opened soon: one that was closed ends a little later."""
    for _ in range(1000):
        with contextlib.suppress(InvalidStatus), connect(url, legacy=True):
            return True
    return False


@pytest.mark.parametrize("name", ["stop", "goto"])
def test_commands_that_nobody_answers_are_bounded_and_hinder_no_stop(name: str) -> None:
    robot = FakeRobot()
    goto = '{"do": "goal", "goal": {"kind": "named", "name": "park"}, "seen": 9999999999999}'
    ask = {"stop": '{"do": "command", "name": "stop"}', "goto": goto}[name]
    with Panel(robot.robot(), 0) as inside, connect(f"{inside.url.replace('http', 'ws')}socket", legacy=True) as tab:
        with robot.hanging({"stop": "stop", "goto": "goal"}[name]):
            for _ in range(3 * MAX_PENDING):
                tab.send(ask)
            refused = 0
            while refused < 2 * MAX_PENDING:
                said = str(tab.recv(PATIENCE))
                refused += '"refused"' in said and "already waiting for replies" in said
            if name == "goto":
                stop(tab)
        answered = 0
        while answered < MAX_PENDING:
            said = str(tab.recv(PATIENCE))
            answered += '"done","to":"stop"' in said or '"accepted","to":"named"' in said
    assert len(robot.gone_to) == (MAX_PENDING if name == "goto" else 0)


@pytest.mark.parametrize("name", ["quick_stop", "disable"])
def test_stops_that_nobody_answers_keep_out_no_other_kind_of_stop(name: str) -> None:
    """A stop is answered only when the robot is at rest, and STOP may be pressed many times until then."""
    robot = FakeRobot()
    with (
        Panel(robot.robot(), 0) as inside,
        connect(f"{inside.url.replace('http', 'ws')}socket", legacy=True) as tab,
        robot.hanging("stop"),
    ):
        for _ in range(2 * MAX_PENDING):
            tab.send('{"do": "command", "name": "stop"}')
        tab.send(f'{{"do": "command", "name": "{name}"}}')
        while f'"done","to":"{name}"' not in (said := str(tab.recv(PATIENCE))):
            assert f'"refused","to":"{name}"' not in said
