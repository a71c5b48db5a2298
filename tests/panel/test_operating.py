"""Operators of a whole service: the page in a browser and the pendant in a terminal, and what takes them away."""

from __future__ import annotations

import fcntl
import os
import pty
import shlex
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from chromium import Page, chromium, needs_chromium
from processes.test_service import Service, until
from trirail.client.client import Robot
from trirail.wire.state import State
from waiting import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # a hand's signs of life have to be in time, through a browser

FAR = 0.1
"""Where a jog to the right would be at a limit: far from where one comes that is ended by the dead man [m]."""
RIGHT = "[data-axis=x][data-sign='1']"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Service(tmp_path_factory.mktemp("operated")) as service:
        service.wait_up()
        yield service
        assert service.end() == 0


@pytest.fixture
def robot(service: Service) -> Iterator[Robot]:
    """The robot, enabled, where jogs to the right have a way to go."""
    with service.robot() as robot:
        robot.enable()
        assert robot.move_to(x=-0.1, y=0.0, phi=0.0).wait(20.0).outcome == "done"
        yield robot
        robot.override(100.0)
        until(robot, lambda state: state.mode not in ("moving", "stopping"))


def moving(robot: Robot) -> None:
    until(robot, lambda state: state.mode == "moving" and state.pose[0] > -0.095)


def hold_right(robot: Robot, page: Page, *, touch: bool = False) -> None:
    """Hold the button to the right until the robot has moved by 5 mm.

    As a person would, press the button again if the jog has ended because a sign of life came late.
    """
    press, let_go = (page.touch, page.end_touch) if touch else (page.press, page.let_go)
    start = standing(robot).pose[0]
    press(RIGHT)

    def has_moved(state: State) -> bool:
        if state.mode == "moving" and state.pose[0] > start + 0.005:
            return True
        if not page.evaluate(f"document.querySelector({RIGHT!r}).matches('.held')"):
            let_go()
            press(RIGHT)
        return False

    until(robot, has_moved)


def standing(robot: Robot) -> State:
    return until(robot, lambda state: state.mode == "holding" and state.goal is None)


def still(robot: Robot, cycles: int = 500) -> None:
    """See that the robot stays where it stands, for so many cycles."""
    at = standing(robot)
    later = until(robot, lambda state: state.seq > at.seq + cycles)
    assert later.mode == "holding"
    assert later.commanded.position == at.commanded.position


# ---------------------------------------------------------------------- the page


@contextmanager
def served(service: Service) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run `trirail panel`; yield the page's address and the process."""
    command = [sys.executable, "-m", "trirail", "panel", "--port", "0", "--json", "--connect", service.locator]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            yield msgspec.json.decode(process.stdout.readline())["url"], process
        finally:
            process.kill()


@pytest.fixture
def panel(service: Service) -> Iterator[str]:
    with served(service) as (url, process):
        yield url
        process.terminate()
        assert process.wait(20) == 0


def opened(browser: Page, url: str) -> Page:
    page = browser.another()
    page.open(url)
    page.until(f"!document.querySelector({RIGHT!r}).disabled")
    return page


@pytest.mark.viewer
@needs_chromium
def test_the_robot_is_jogged_and_stopped_by_clicking(service: Service, robot: Robot, browser: Page, panel: str) -> None:
    page = opened(browser, panel)
    hold_right(robot, page)
    page.let_go()
    assert -0.095 < standing(robot).pose[0] < FAR
    goal = robot.move_to(x=0.1, y=0.0, phi=0.2, speed=0.1)
    until(robot, lambda state: state.mode == "moving")
    page.click("#stop")
    assert goal.wait(10.0).outcome == "stopped"
    page.until("document.querySelector('#mode-name').textContent === 'holding'")
    page.until("document.querySelector('#events').innerText.includes('stopped')")
    page.click("[data-command=disable]")
    page.until("document.querySelector('#mode-name').textContent === 'disabled'")
    page.click("[data-command=enable]")
    page.until("document.querySelector('#mode-name').textContent === 'holding'")
    page.close()


@pytest.mark.viewer
@needs_chromium
@pytest.mark.parametrize("gone", ["closed", "killed", "frozen"])
def test_a_tab_that_is_gone_while_a_button_is_held_moves_nothing(
    service: Service, robot: Robot, tmp_path: Path, panel: str, gone: str
) -> None:
    with chromium("chromium", tmp_path, ["--disable-gpu"]) as browser:
        page = opened(browser, panel)
        hold_right(robot, page)
        if gone == "closed":
            page.close()
        else:
            page.signal_renderers(signal.SIGKILL if gone == "killed" else signal.SIGSTOP)
        assert standing(robot).pose[0] < FAR
        if gone == "frozen":
            page.signal_renderers(signal.SIGCONT)
        still(robot)


@pytest.mark.viewer
@needs_chromium
@pytest.mark.parametrize("gone", ["cancelled", "frozen by the browser", "frozen"])
def test_a_finger_that_is_lost_on_a_touch_screen_moves_nothing(
    service: Service, robot: Robot, tmp_path: Path, panel: str, gone: str
) -> None:
    with chromium("chromium", tmp_path, ["--disable-gpu"]) as browser:
        page = opened(browser, panel)
        page.resize(390, 844, phone=True)
        hold_right(robot, page, touch=True)
        if gone == "cancelled":
            page.end_touch("touchCancel")
        elif gone == "frozen":
            page.signal_renderers(signal.SIGSTOP)
        else:
            page.freeze()
        assert standing(robot).pose[0] < FAR
        if gone == "frozen":
            page.signal_renderers(signal.SIGCONT)
        elif gone != "cancelled":
            page.freeze(over=True)
        still(robot)


@pytest.mark.viewer
@needs_chromium
def test_a_file_is_followed_by_who_holds_the_lease_and_the_session_is_listed(
    service: Service, robot: Robot, browser: Page, panel: str
) -> None:
    page = opened(browser, panel)
    page.click("[data-command=acquire]")
    page.until("document.querySelector('#lease').textContent.includes('since')")
    page.click("[data-view=following]")
    page.choose_file("#file", "line.csv", "t,x,y,phi\n0,0,0,0\n1,0.01,0,0\n")
    page.until("!document.querySelector('#file-start').disabled")
    page.click("#file-start")
    until(robot, lambda state: state.settled and abs(state.pose[0]) < 1e-5)
    page.click("#follow")
    page.until("document.querySelector('#file-progress').style.visibility === ''")
    until(robot, lambda state: state.settled and abs(state.pose[0] - 0.01) < 1e-5)
    page.until("document.querySelector('#file-progress').style.visibility === 'hidden'")
    page.click("[data-command=release]")
    page.until("document.querySelector('#lease').textContent.startsWith('Nobody')")
    page.until(f"document.querySelector('#people').textContent.includes({robot.user!r})")
    page.click("[data-view=sessions]")
    page.until("document.querySelector('#sessions a[download]')")
    assert "running" in page.text("#sessions")
    page.close()


@pytest.mark.viewer
@needs_chromium
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_panel_that_is_gone_while_a_button_is_held_moves_nothing(
    service: Service, robot: Robot, browser: Page, number: signal.Signals
) -> None:
    """As where the network is: no renewal reaches the service."""
    with served(service) as (url, process):
        page = opened(browser, url)
        hold_right(robot, page)
        process.send_signal(number)
        assert standing(robot).pose[0] < FAR
        page.until("document.querySelector('#mode-name').textContent === 'no contact'")
        process.send_signal(signal.SIGCONT)
        still(robot)
        page.let_go()
        page.close()


@pytest.mark.viewer
@needs_chromium
def test_two_tabs_both_work_and_either_stops(service: Service, robot: Robot, browser: Page, panel: str) -> None:
    one, other = opened(browser, panel), opened(browser, panel)
    for mover, stopper in ((one, other), (other, one)):
        hold_right(robot, mover)
        stopper.click("#stop")
        still(robot)
        mover.let_go()
    one.close()
    other.close()


@pytest.mark.viewer
@needs_chromium
def test_the_page_comes_back_with_the_service(browser: Page, tmp_path: Path) -> None:
    with Service(tmp_path) as first:
        first.wait_up()
        with served(first) as (url, _):
            page = browser.another()
            page.open(url)
            page.until("document.querySelector('#mode-name').textContent === 'disabled'")
            assert first.end() == 0
            page.until("document.querySelector('#mode-name').textContent === 'no contact'")
            with Service(tmp_path) as second:
                second.wait_up()
                page.until("document.querySelector('#mode-name').textContent === 'disabled'")
                page.click("[data-command=enable]")
                page.until("document.querySelector('#mode-name').textContent === 'holding'")
                page.until("document.querySelector('#events li').innerText.includes('enabled')")
                page.close()
                assert second.end() == 0


# ---------------------------------------------------------------------- the pendant


class Pendant:
    """`trirail jog` on a pseudo-terminal of its own, and the keys of an operator."""

    def __init__(self, service: Service, *, shell: bool = False) -> None:
        command = [sys.executable, "-m", "trirail", "jog", "--connect", service.locator]
        if shell:  # only below a shell with job control can anything be suspended; Enter continues it
            command = ["/bin/bash", "-mc", f"{shlex.join(command)}; read; fg"]
        self.process, self.terminal = pty.fork()
        if self.process == 0:
            os.execv(command[0], command)
        fcntl.ioctl(self.terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
        self.shown = b""
        self._held = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        try:
            while read := os.read(self.terminal, 65536):
                self.shown += read
        except OSError:
            return  # the terminal is closed

    def wait_shown(self, words: str) -> None:
        wait_until(lambda: words.encode() in self.shown, f"{words!r} in {self.shown!r}")

    @contextmanager
    def holding(self, key: bytes) -> Iterator[None]:
        """Repeat a key, as a terminal does while one is held."""
        over = threading.Event()

        def repeat() -> None:
            while not over.wait(0.03):
                os.write(self.terminal, key)

        thread = threading.Thread(target=repeat)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def type(self, key: bytes) -> None:
        os.write(self.terminal, key)

    def code(self) -> int:
        """Wait for its end; its exit code."""
        found: list[int] = []

        def ended() -> bool:
            pid, status = os.waitpid(self.process, os.WNOHANG)
            if pid:
                found.append(os.waitstatus_to_exitcode(status))
            return bool(pid)

        wait_until(ended, "the pendant ends")
        return found[0]


ARROW = b"\x1b[C"


@pytest.fixture
def pendant(service: Service, robot: Robot, request: pytest.FixtureRequest) -> Iterator[Pendant]:
    made = Pendant(service, shell=getattr(request, "param", False))
    made.wait_shown("holding")
    yield made
    try:
        os.kill(made.process, signal.SIGKILL)
        os.waitpid(made.process, 0)
    except (ProcessLookupError, ChildProcessError):
        pass
    os.close(made.terminal)


def test_a_held_key_moves_the_robot_and_space_stops_it(pendant: Pendant, robot: Robot) -> None:
    with pendant.holding(ARROW):
        moving(robot)
    assert standing(robot).pose[0] < FAR
    pendant.wait_shown("mm/s")
    goal = robot.move_to(x=0.1, y=0.0, phi=0.2, speed=0.1)
    until(robot, lambda state: state.mode == "moving" and state.goal is not None and state.goal.id == goal.id)
    pendant.type(b" ")
    assert goal.wait(10.0).outcome == "stopped"
    pendant.type(b"q")
    assert pendant.code() == 0


@pytest.mark.parametrize("gone", [signal.SIGHUP, signal.SIGTERM, signal.SIGKILL, signal.SIGSTOP, "closed", "left"])
def test_a_pendant_that_goes_while_a_key_is_held_moves_nothing(
    pendant: Pendant, robot: Robot, gone: signal.Signals | str
) -> None:
    with pendant.holding(ARROW):
        moving(robot)
        if isinstance(gone, signal.Signals):
            os.kill(pendant.process, gone)
        elif gone == "left":
            pendant.type(b"q")
        assert standing(robot).pose[0] < FAR if gone != "closed" else True
    if gone == "closed":
        os.close(pendant.terminal)
        pendant.terminal = os.open(os.devnull, os.O_RDONLY)
        assert standing(robot).pose[0] < FAR
    if gone is signal.SIGSTOP:  # what was typed meanwhile is from before
        os.kill(pendant.process, signal.SIGCONT)
    still(robot)
    if gone in (signal.SIGHUP, signal.SIGTERM, "left", "closed"):
        assert pendant.code() == 0


@pytest.mark.parametrize("pendant", [True], indirect=True)
def test_a_suspended_pendant_lets_go_and_works_again_afterwards(pendant: Pendant, robot: Robot) -> None:
    with pendant.holding(ARROW):
        moving(robot)
        pendant.type(b"\x1a")
        at = standing(robot).pose[0]
    assert at < FAR
    pendant.type(b"\n")
    still(robot)
    with pendant.holding(ARROW):
        until(robot, lambda state: state.pose[0] > at + 0.005)
    standing(robot)


def test_a_jog_by_keys_needs_a_terminal(service: Service) -> None:
    command = [sys.executable, "-m", "trirail", "jog", "--connect", service.locator]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "needs a terminal" in done.stderr
    assert len(done.stderr.splitlines()) == 1
