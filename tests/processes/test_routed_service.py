"""Whole services behind a router that is a program of its own: seen and stopped through it, whatever becomes of it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes.test_service import Service, until, wait_readable
from refusals import refused_as
from trirail.client.client import Robot
from trirail.client.fleet import Attention, Fleet, Member
from trirail.errors import RefusalCode, ServiceError
from trirail.processes.operating_system import python
from trirail.wire.event_codes import EventCode
from waiting import WITHIN
from warm import trirail

pytestmark = pytest.mark.slow


class Hub:
    """A router for the robot demo, of what `trirail router` prints."""

    def __init__(self, folder: Path) -> None:
        self.locator = f"unixsock-stream/{folder}/hub"
        self._file = folder / "router.toml"
        self._file.write_text(f'robots = ["demo"]\nstate_hz = 5.0\n[zenoh]\nlisten = ["{self.locator}"]\n')
        self.start()

    def start(self) -> None:
        """Start it, and wait until it says that it routes."""
        settings = trirail("router", self._file).stdout
        route = f"import zenoh; router = zenoh.open(zenoh.Config.from_json5({settings!r})); print('routing'); input()"
        self.process = subprocess.Popen(
            python("-u", "-c", route), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "routing\n"

    def kill(self) -> None:
        """Kill it at once."""
        self.process.kill()
        self.process.wait()
        for pipe in filter(None, (self.process.stdin, self.process.stdout)):
            pipe.close()


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    made = Hub(tmp_path)
    yield made
    made.kill()


@pytest.fixture
def service(hub: Hub, tmp_path: Path) -> Iterator[Service]:
    locator = f"unixsock-stream/{tmp_path}/zenoh"
    changes = {f'listen = ["{locator}"]': f'listen = ["{locator}"]\nconnect = ["{hub.locator}"]'}
    with Service(tmp_path, **changes) as made:
        made.wait_up()
        yield made


def seen(fleet: Fleet, condition: Callable[[Member, float], bool], service: Service) -> None:
    """Wait until the robot is seen so."""
    deadline = time.monotonic() + WITHIN
    while not any(condition(member, time.monotonic()) for member in fleet.members()):
        assert time.monotonic() < deadline, fleet.members()
        wait_readable(service.process, 0.02)


def through(hub: Hub) -> Robot:
    """A client that is there once the robot is behind the router."""
    deadline = time.monotonic() + WITHIN
    while True:
        try:
            robot = Robot("demo", hub.locator, user="ann")
            robot.info()
        except ServiceError:
            assert time.monotonic() < deadline
        else:
            return robot


def past_of_link(robot: Robot) -> list[str]:
    """The past events of the link to the router."""
    events = robot.events(history=True, timeout=1.0)
    return [event.message for event in events if "the router" in event.message]


@pytest.mark.alone  # a stalled machine loses events
def test_a_robot_is_seen_and_driven_through_its_router_which_may_come_and_go(hub: Hub, service: Service) -> None:
    with through(hub) as robot, Fleet(hub.locator, "demo") as fleet:
        robot.enable()
        assert robot.move_to(x=0.01, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        seen(fleet, lambda member, _: member.summary is not None and member.summary.mode == "holding", service)
        robot.quick_stop()
        seen(fleet, lambda member, now: member.need(now) is Attention.FAULT, service)
        robot.reset()
    hub.kill()
    with service.robot() as robot:  # local control does not need it
        robot.enable()
        moving = robot.move_to(x=-0.02, y=0.0, phi=0.0)
        lost = (
            f"no link to the router {hub.locator}: connection refused; the connection is retried, and local control "
            "continues"
        )
        assert next(state for state in robot.states(WITHIN) if state.warnings).warnings == (lost,)
        hub.start()
        assert moving.wait(WITHIN).outcome == "done"
        assert not next(state for state in robot.states(WITHIN) if not state.warnings).warnings
        linked = f"linked to the router {hub.locator}"
        # On a busy machine, zenoh may leave out the oldest past events; then they are asked for again.
        assert any(past_of_link(robot)[:3] == [linked, lost, linked] for _ in range(5))
    with through(hub) as robot:
        until(robot, lambda state: state.mode == "holding")
        robot.disable()


def test_a_second_service_of_the_same_name_moves_nothing_and_is_told_until_one_is_gone(
    hub: Hub, service: Service, tmp_path: Path
) -> None:
    folder = tmp_path / "second"
    folder.mkdir()
    listen = f'listen = ["unixsock-stream/{folder}/zenoh"]'
    with Service(folder, **{listen: f'{listen}\nconnect = ["{hub.locator}"]'}) as second, through(hub) as robot:
        second.wait_up()
        with refused_as(RefusalCode.NAME_IN_USE):
            robot.enable()
        for each in (service, second):
            with each.robot() as local:
                with refused_as(RefusalCode.NAME_IN_USE):
                    local.enable()
                told = (event for event in local.events(history=True) if event.event_code is EventCode.NAME_IN_USE)
                assert next(told).level == "error"
                until(local, lambda state: any("another service" in warning for warning in state.warnings))
                local.stop()
    with service.robot() as robot:
        until(robot, lambda state: not state.warnings)
        robot.enable()


def test_a_robot_that_is_killed_is_silent_to_the_fleet(hub: Hub, service: Service) -> None:
    with Fleet(hub.locator, "demo") as fleet:
        seen(fleet, lambda member, now: member.need(now) is Attention.NOTHING, service)
        processes = [service.child(name) for name in ("gateway", "loop", "recorder", "planner")]
        for each in (service.process.pid, *processes):  # all at once, as a machine that loses its power
            os.kill(each, signal.SIGSTOP)
        for each in (service.process.pid, *processes):
            os.kill(each, signal.SIGKILL)
        seen(fleet, lambda member, now: member.need(now) is Attention.SILENT, service)


def test_the_command_sees_it_too(hub: Hub, service: Service) -> None:
    through(hub).close()
    said = trirail("fleet", "--connect", hub.locator, "--json")
    (robot,) = json.loads(said.stdout)["robots"]
    assert (robot["robot"], robot["need"], robot["mode"]) == ("demo", "nothing", "disabled")
