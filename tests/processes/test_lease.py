"""The lease of a whole service: held by programs that live, hang and die, and behind gateways that do."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes.test_service import SLOWLY, Service, again, until
from refusals import refused_as
from trirail.analysis.replay import replay_session
from trirail.client.client import Robot
from trirail.errors import RefusalCode, RefusedError
from trirail.telemetry import provenance
from trirail.telemetry.reading import read
from waiting import WITHIN
from warm import trirail

pytestmark = pytest.mark.slow


REQUIRED = {"[telemetry]": '[control]\nlease = "required"\n\n[telemetry]'}
LONG = 10.0
"""The time-out of a lease that a busy machine must not end [s]."""


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """A service that moves for the holder of the lease alone."""
    with Service(tmp_path, **REQUIRED) as started:
        started.wait_up()
        yield started


def held_by(service: Service, user: str) -> subprocess.Popen[str]:
    """Run a program that holds the lease and moves the robot, until it is killed; return once it does."""
    program = (
        "import sys, threading; from trirail import Robot\n"
        "with Robot('demo', sys.argv[1], user=sys.argv[2]) as robot, robot.lease(timeout=3.0):\n"
        "    robot.enable()\n"
        "    robot.override(2)\n"
        "    robot.move_to(x=0.1, y=0.0, phi=0.0)\n"
        "    print('moving', flush=True)\n"
        "    threading.Event().wait()\n"
    )
    command = [sys.executable, "-c", program, service.locator, user]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "moving\n"
    return process


def told(robot: Robot, number: int) -> list[tuple[str, str | None]]:
    """What was told of the lease, message and user, as soon as it is so much."""
    events = robot.events(history=True, timeout=WITHIN)
    return list(itertools.islice(((event.message, event.user) for event in events if event.kind == "lease"), number))


@pytest.mark.parametrize("harm", [signal.SIGKILL, signal.SIGSTOP])
def test_a_holder_that_dies_or_hangs_is_a_controlled_stop_and_the_lease_is_free(
    service: Service, harm: signal.Signals
) -> None:
    with held_by(service, "bob") as holder, service.robot() as ann:
        try:
            until(ann, lambda state: (state.lease, state.mode) == ("bob", "moving"))
            with refused_as(RefusalCode.LEASED):
                ann.move_to(x=0.0, y=0.0, phi=0.0)
            assert ann.state().mode == "moving"
            holder.send_signal(harm)
            state = until(ann, lambda state: state.lease is None)
            state = until(ann, lambda state: state.mode == "holding")
            assert 0.0 < state.pose[0] < 0.09
            assert told(ann, 2)[-1] == ("lease of bob has expired: it was not renewed within 3 s", None)
            with refused_as(RefusalCode.NO_LEASE):
                ann.move_to(x=0.0, y=0.0, phi=0.0)
            with ann.lease(timeout=LONG):
                ann.override(100)
                assert ann.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
        finally:
            holder.kill()


def test_a_gateway_that_is_lost_for_longer_than_a_lease_neither_keeps_it_nor_frees_it_in_silence(
    tmp_path: Path,
) -> None:
    with Service(tmp_path, **REQUIRED, **{"gateway_timeout = 0.3": "gateway_timeout = 3.0"}) as service:
        service.wait_up()
        gateway_lost_for_longer_than_a_lease(service)


def gateway_lost_for_longer_than_a_lease(service: Service) -> None:
    with service.robot() as bob:
        with bob.lease(timeout=2.0) as lease:
            bob.enable()
            bob.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
            os.kill(service.child("gateway"), signal.SIGSTOP)  # it is killed after 3 s
            assert lease.wait(WITHIN)
            assert lease.lost is not None
        with again(service) as ann:
            until(ann, lambda state: state.mode == "holding" and state.lease is None)
            assert told(ann, 2) == [
                ("lease acquired by ann", "ann"),
                ("lease of ann has expired: it was not renewed within 2 s", None),
            ]
            with ann.lease(timeout=LONG):
                assert ann.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"


def test_a_gateway_that_is_back_at_once_leaves_the_lease_to_a_holder_who_lives(service: Service) -> None:
    with service.robot() as bob, bob.lease(timeout=LONG) as lease:
        bob.enable()
        bob.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
        os.kill(service.child("gateway"), signal.SIGKILL)
        with again(service) as ann:
            until(ann, lambda state: state.mode == "holding" and state.lease is not None)
            assert lease.lost is None
        until(bob, lambda state: state.mode == "holding")  # he hears the new gateway too
        assert bob.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"


def test_it_is_taken_over_by_those_who_may_and_both_are_told(service: Service) -> None:
    with service.robot() as ann, Robot("demo", service.locator, user="bob") as bob:
        with ann.lease(timeout=LONG) as lease:
            ann.enable()
            going = ann.move_to(x=0.1, y=0.0, phi=0.0, speed=SLOWLY)
            with refused_as(RefusalCode.LEASED), bob.lease():
                pass
            with bob.lease(force=True, timeout=LONG):
                assert bob.state().mode == "holding"  # entering has waited for the standstill
                assert going.wait(WITHIN).outcome == "stopped"
                assert lease.wait(WITHIN)
                assert isinstance(lease.lost, RefusedError)
                assert lease.lost.code is RefusalCode.LEASE_OVER
                assert bob.move_to(x=0.0, y=0.0, phi=0.0).wait(WITHIN).outcome == "done"
                ann.stop()  # is everybody's
        assert told(bob, 3) == [
            ("lease acquired by ann", "ann"),
            ("lease taken over by bob from ann", "bob"),
            ("lease released by bob", None),
        ]


@pytest.mark.parametrize(("ending", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_from_the_command_line(service: Service, ending: signal.Signals, code: int) -> None:
    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        return trirail(*arguments, locator=service.locator)

    refused = call("enable", "--json")
    assert refused.returncode == 1
    assert json.loads(refused.stdout)["code"] == "no_lease"
    command = [sys.executable, "-m", "trirail", "acquire", "--timeout", "10", "--connect", service.locator]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert "holds the lease until Ctrl-C" in holder.stdout.readline()
            assert call("enable").returncode == 0
            assert call("goto", 0.01, 0, 0, "--wait").returncode == 0
            assert "held by" in call("status").stdout
            holder.send_signal(ending)
            while ending == signal.SIGTERM and holder.poll() is None:  # again and again, into the way out
                holder.send_signal(ending)
                threading.Event().wait(0.001)
            assert holder.wait(WITHIN) == code
            assert holder.stderr is not None
            assert holder.stderr.read() == ""
        finally:
            holder.kill()
    assert "held by" not in call("status").stdout
    assert call("goto", 0, 0, 0).returncode == 1
    assert call("stop").returncode == 0


def test_a_session_with_leases_comes_out_again_to_the_last_bit(service: Service) -> None:
    users = [Robot("demo", service.locator, user=name) for name in ("ann", "bob")]
    for turn in range(4):
        mine, other = users[turn % 2], users[1 - turn % 2]
        with mine.lease(timeout=LONG):
            mine.enable()
            mine.move_to(x=0.03 * (-1) ** turn, y=0.0, phi=0.1, speed=0.3)
            with pytest.raises(RefusedError):
                other.move_to(x=0.0, y=0.0, phi=0.0)
            threading.Event().wait(0.3)  # some way; leaving stops it on the way
    for user in users:
        user.close()
    assert service.end() == 0
    (path,) = (service.folder / "recordings").glob("demo-*.rrd")
    recording = read(path)
    config = provenance.configuration(recording.texts)
    assert config is not None
    compared = replay_session(recording, config, simulated=False)
    assert compared.cycles == len(recording.records)
    assert (compared.differing, compared.first, compared.plans_differing) == (0, None, 0)
