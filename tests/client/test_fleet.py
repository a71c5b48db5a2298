"""A fleet as its members' summaries tell it: who is alive by age, who needs somebody, and that live in a table."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from trirail.cli import fleet_command, terminal
from trirail.cli.app import app
from trirail.client.fleet import MAX_SILENCE_S, Attention, Fleet, Member
from trirail.wire import zenoh_session
from trirail.wire.state import RobotSummary
from waiting import wait_until

OK = RobotSummary("holding", None, None, 80.0, 0, 0.01, "0.1.0")
FAULT = msgspec.structs.replace(OK, mode="fault", fault="drive B: EMCY 8700")


@given(st.floats(0.0, 10.0), st.floats(0.0, 10.0), st.sampled_from([OK, FAULT]))
def test_a_robot_lives_by_the_age_of_what_its_loop_said(waited: float, age: float, summary: RobotSummary) -> None:
    member = Member("demo", msgspec.structs.replace(summary, age=age), 100.0)
    assert member.age(100.0 + waited) == pytest.approx(waited + age)
    if waited + age > MAX_SILENCE_S + 1e-6:
        assert member.need(100.0 + waited) is Attention.SILENT
    elif waited + age < MAX_SILENCE_S - 1e-6:
        assert member.need(100.0 + waited) is (Attention.FAULT if summary is FAULT else Attention.NOTHING)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[tuple[str, zenoh.Session]]:
    locator = f"unixsock-stream/{tmp_path}/hub"
    with zenoh_session.open_service([locator]) as opened:
        yield locator, opened


def until(condition: object, publish: object) -> None:
    """Publish until something holds."""

    def holds() -> bool:
        publish()  # type: ignore[operator]
        return condition()  # type: ignore[operator,no-any-return]

    wait_until(holds, pause=0.05)


def test_who_needs_somebody_stands_first(hub: tuple[str, zenoh.Session]) -> None:
    locator, service = hub
    now = [100.0]
    with Fleet(locator, "demo", clock=lambda: now[0]) as fleet:

        def publish(robots: dict[str, bytes]) -> None:
            for robot, content in robots.items():
                service.put(f"trirail/{robot}/summary", content, encoding="application/json")

        said = {name: msgspec.json.encode(FAULT if name == "c" else OK) for name in "abcd"}
        said |= {"odd": b"\xff nonsense", "later": b'{"mode": "holding"}'}  # of other versions
        until(lambda: len(fleet.members()) == 6, lambda: publish(said))
        assert [member.robot for member in fleet.members()] == ["c", "later", "odd", "a", "b", "d"]
        last = {"z": msgspec.json.encode(OK)}  # behind all that was said before
        until(lambda: len(fleet.members()) == 7, lambda: publish(last))
        now[0] += MAX_SILENCE_S - 0.5
        again = {name: said[name] for name in ("a", "c", "d", "odd")} | last
        until(lambda: sum(member.heard == now[0] for member in fleet.members()) == 5, lambda: publish(again))
        now[0] += 1.0
        assert [(member.robot, member.need(now[0])) for member in fleet.members()] == [
            ("b", Attention.SILENT),
            ("later", Attention.SILENT),
            ("c", Attention.FAULT),
            ("odd", Attention.UNREADABLE),
            *((name, Attention.NOTHING) for name in "adz"),
        ]


@pytest.mark.long
def test_one_look_as_json(
    hub: tuple[str, zenoh.Session], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    locator, service = hub
    ended = threading.Event()

    def publish() -> None:
        while not ended.wait(0.05):
            service.put("trirail/demo/summary", msgspec.json.encode(FAULT), encoding="application/json")
            service.put("trirail/later/summary", b'{"mode": "holding"}', encoding="application/json")

    publisher = threading.Thread(target=publish)
    publisher.start()
    try:
        monkeypatch.setattr(fleet_command, "SNAPSHOT_S", 3.0)
        words = ["fleet", "--connect", locator, "--json"]
        assert app(words, exit_on_error=False, result_action="return_value") == 0
    finally:
        ended.set()
        publisher.join()
    robot, later = json.loads(capsys.readouterr().out)["robots"]
    assert (robot["robot"], robot["need"], robot["fault"]) == ("demo", "fault", "drive B: EMCY 8700")
    assert (later["robot"], later["need"], later["mode"]) == ("later", "unreadable", None)
    assert later.keys() == robot.keys()


def test_into_a_pipe_each_robot_is_a_line_whenever_it_has_changed(
    hub: tuple[str, zenoh.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    locator, service = hub
    said: list[str] = []
    monkeypatch.setattr(fleet_command, "REFRESH_S", 0.01)
    monkeypatch.setattr(terminal, "print_line", said.append)
    over = threading.Event()
    with Fleet(locator, "demo") as fleet:
        printing = threading.Thread(target=fleet_command._print_changes, args=(fleet, over))
        printing.start()
        try:
            for number, summary in enumerate((OK, FAULT, None), 1):
                publish = partial(service.put, "trirail/demo/summary", msgspec.json.encode(summary))
                until(lambda number=number: len(said) == number, publish)
        finally:
            over.set()
            printing.join()
    assert [line.split("  ", 1)[1] for line in said] == [
        "demo  holding",
        "demo  fault  drive B: EMCY 8700",
        f"demo  {fleet_command.UNREADABLE}",
    ]


def test_a_terminal_that_cannot_redraw_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    printed = []

    def print_changes(*arguments: object) -> None:
        printed.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr("trirail.client.fleet.Fleet", lambda *_: nullcontext())
    monkeypatch.setattr(fleet_command, "_print_changes", print_changes)
    monkeypatch.setattr(terminal, "out", Console(force_terminal=True, _environ={"TERM": "dumb"}))
    assert fleet_command.fleet() == 0
    assert printed


def test_the_table_says_what_each_needs_and_hides_what_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    console = Console(width=150, force_terminal=False)
    monkeypatch.setattr(terminal, "out", console)
    now = time.monotonic()
    members = [Member("a", OK, now - 60.0), Member("b", FAULT, now), Member("c", OK, now), Member("d", None, now)]
    with console.capture() as captured:
        console.print(fleet_command.table(members, now))
    lines = captured.get().splitlines()
    assert "silent for 60 s" in lines[1]
    assert "holding" not in lines[1]
    assert "drive B: EMCY 8700" in lines[2]
    assert "holding" in lines[3]
    assert fleet_command.UNREADABLE in lines[4]
    assert "4 robots, 3 need attention" in lines[-1]
