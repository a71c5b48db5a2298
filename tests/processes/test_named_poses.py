"""Named poses with a whole service: taught, gone to, kept over every end of it; from Python, a shell, plain Zenoh."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import message_schemas
import pytest
from jsonschema import Draft202012Validator
from processes.test_ends import wait_gone
from processes.test_service import until
from refusals import refused_as
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.errors import RefusalCode, ServiceError
from trirail.processes.operating_system import child, processes
from trirail.wire.zenoh_session import open_client
from waiting import WITHIN
from warm import trirail

pytestmark = pytest.mark.slow


class Place(NamedTuple):
    """Where a service is configured, listens, and keeps its poses."""

    config: Path
    locator: str
    state: Path

    @contextlib.contextmanager
    def service(self, number: int = signal.SIGTERM) -> Iterator[own_service.Process]:
        recording = self.config.with_suffix(".rrd")
        recording.unlink(missing_ok=True)  # of the service before
        with (self.config.parent / "service.log").open("ab") as log:
            process = own_service.start(self.config, log, "--record", str(recording), STATE_DIRECTORY=str(self.state))
        try:
            yield process
        finally:
            others = processes(process.pid).values()
            process.send_signal(number)
            process.wait(WITHIN)
            for other in others:  # they outlive one that is killed, and have its socket
                wait_gone(other)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    config, locator = own_service.private(tmp_path)
    text = config.read_text(encoding="utf-8") + "\n[poses]\npark = [0.0, 0.05, 0.0]\n"
    config.write_text(text, encoding="utf-8")
    return Place(config, locator, tmp_path / "state")


@pytest.fixture
def robot(place: Place) -> Iterator[Robot]:
    with place.service(), Robot("demo", place.locator, user="ann") as robot:
        yield robot


def at(robot: Robot, *pose: float) -> None:
    """See it come to be at a pose."""
    until(robot, lambda state: state.pose == pytest.approx(pose, abs=1e-5))


def test_a_pose_is_taught_without_power_and_gone_to(robot: Robot) -> None:
    rest = robot.teach("rest")
    at(robot, rest.x, rest.y, rest.phi)
    robot.enable()
    for number in range(5):  # what is done stands: it can be taught at once
        pose = (0.01 * number, -0.02, 0.1)
        assert robot.move_to(x=pose[0], y=pose[1], phi=pose[2]).wait(WITHIN).outcome == "done"
        taught = robot.teach("pick")
        assert (taught.x, taught.y, taught.phi) == pytest.approx(pose, abs=1e-5)
    assert robot.move_to_named("rest", id="home-again").wait(WITHIN).outcome == "done"
    at(robot, rest.x, rest.y, rest.phi)
    assert robot.move_to_named("park", speed=0.5).wait(WITHIN).outcome == "done"
    at(robot, 0.0, 0.05, 0.0)
    assert {name: pose.taught for name, pose in robot.poses().items()} == {"park": False, "pick": True, "rest": True}
    goal = robot.move_to_named("rest", speed=0.1)
    with refused_as(RefusalCode.MOVING):
        robot.teach("pick")
    goal.cancel()
    with refused_as(RefusalCode.UNKNOWN_POSE):
        robot.move_to_named("nowhere")
    told = (event.user for event in robot.events(history=True, timeout=WITHIN) if event.kind == "pose")
    assert list(itertools.islice(told, 6)) == ["ann"] * 6


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_what_was_taught_outlasts_gateway_and_service(place: Place, number: int) -> None:
    with place.service(number) as process, Robot("demo", place.locator) as robot:
        robot.teach("pick")
        before = robot.poses()
        gateway = child(process.pid, "gateway")
        os.kill(gateway, signal.SIGKILL)
        wait_gone(gateway)
        assert until(robot, lambda _: True).mode == "disabled"  # the next one says so
        assert robot.poses() == before
    with place.service(), Robot("demo", place.locator) as robot:
        assert robot.poses() == before
        robot.forget("pick")
    with place.service(), Robot("demo", place.locator) as robot:
        assert set(robot.poses()) == {"park"}


def test_a_file_that_breaks_while_the_service_runs_ends_nothing(place: Place) -> None:
    with place.service() as process, Robot("demo", place.locator) as robot:
        robot.teach("pick")
        file = place.state / "demo/poses.json"
        broken = file.read_bytes()[:9]
        file.write_bytes(broken)
        gateway = child(process.pid, "gateway")
        os.kill(gateway, signal.SIGKILL)
        wait_gone(gateway)
        until(robot, lambda state: any("poses.json" in warning for warning in state.warnings))
        assert set(robot.poses()) == {"park"}
        assert file.with_name("poses.json.broken").read_bytes() == broken


def test_a_taught_pose_that_the_robot_cannot_reach_any_more_is_refused_where_it_is_gone_to(place: Place) -> None:
    (place.state / "demo").mkdir(parents=True)
    (place.state / "demo/poses.json").write_text('{"far": [0.3, 0.0, 0.0]}', encoding="utf-8")
    with place.service(), Robot("demo", place.locator) as robot:
        robot.enable()
        with refused_as(RefusalCode.OUT_OF_WORKSPACE):
            robot.move_to_named("far")


@pytest.mark.parametrize("wrong", ["state", "configuration"])
def test_a_service_does_not_start_with_poses_that_cannot_be_used(place: Place, wrong: str) -> None:
    said = "limits.platform.x = [-0.15, 0.15]"
    if wrong == "state":
        (place.state / "demo").mkdir(parents=True)
        (place.state / "demo/poses.json").write_text('{"far": [0.3, 0.0', encoding="utf-8")
        said = "poses.json: Input data was truncated; repair the file, or move it away and teach the poses again"
    else:
        text = place.config.read_text(encoding="utf-8").replace("park = [0.0, ", "park = [0.4, ")
        place.config.write_text(text, encoding="utf-8")
    with pytest.raises(ServiceError, match="could not start"), place.service():
        pass
    assert said in (place.config.parent / "service.log").read_text(encoding="utf-8")


def test_from_the_command_line(place: Place, robot: Robot) -> None:
    robot.enable()
    taught = trirail("teach", "pick", locator=place.locator)
    assert (taught.returncode, taught.stdout) == (0, "pick: x 0.000 mm   y 0.000 mm   φ 0.0000 °\n".replace(" °", "°"))
    done = trirail("goto", "park", "--wait", locator=place.locator)
    assert (done.returncode, done.stderr) == (0, "")
    at(robot, 0.0, 0.05, 0.0)
    listed = trirail("poses", locator=place.locator).stdout.splitlines()
    assert [line.split()[0] for line in listed] == ["park", "pick"]
    assert [line.rpartition("   ")[2] for line in listed] == ["of [poses]", "taught"]
    told = json.loads(trirail("poses", "--json", locator=place.locator).stdout)
    park = {"name": "park", "x": 0.0, "y": 0.05, "phi": 0.0, "taught": False, "other_geometry": False}
    assert told["park"] == park
    unknown = trirail("goto", "nowhere", locator=place.locator)
    assert (unknown.returncode, unknown.stdout) == (1, "")
    assert unknown.stderr == "trirail: no pose 'nowhere': `trirail poses` lists the saved poses\n"
    for words, names in ((("goto", ""), ["park", "pick"]), (("forget", ""), ["pick"])):
        assert trirail("__complete", *words, locator=place.locator).stdout.splitlines()[-len(names) :] == names
    assert trirail("forget", "pick", locator=place.locator).returncode == 0
    assert trirail("forget", "park", locator=place.locator).returncode == 1


def test_from_anything_that_speaks_zenoh(place: Place, robot: Robot) -> None:
    def ask(key: str, content: object = None) -> Any:
        payload = None if content is None else json.dumps(content)
        (reply,) = session.get(f"trirail/demo/{key}", payload=payload, timeout=WITHIN)
        assert reply.ok is not None, reply.err and reply.err.payload.to_string()
        return json.loads(reply.ok.payload.to_string())

    def is_as_described(name: str, message: object) -> None:
        file = message_schemas.FOLDER / f"{name}.json"
        Draft202012Validator(json.loads(file.read_text(encoding="utf-8"))).validate(message)

    with open_client(place.locator) as session:
        ask("cmd/plain/enable")
        taught = ask("teach/plain/pick")
        is_as_described("pose", taught)
        told = ask("poses")
        is_as_described("poses", told)
        assert [pose["name"] for pose in told["poses"]] == ["park", "pick"]
        goal = {"kind": "named", "name": "park", "speed": 0.5}
        is_as_described("goal", goal)
        assert ask("goal/plain", goal)["accepted"]
        (wild,) = session.get("trirail/*/poses", timeout=WITHIN)
        assert wild.ok is not None
        assert str(wild.ok.key_expr) == "trirail/demo/poses"
        is_as_described("pose", ask("forget/plain/pick"))
