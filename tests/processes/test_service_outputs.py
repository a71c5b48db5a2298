"""Outputs and inputs of a whole service with simulated drives: command line, goals with marks, replay and tables."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from processes.test_service import Service, until
from trirail.analysis import export
from trirail.analysis.replay import replay_session
from trirail.cli.app import app
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.errors import RefusalCode, RefusedError
from trirail.telemetry.reading import read

DIGITAL = """
[outputs.valve]
drive = "A"
bit = 16

[outputs.lamp]
drive = "A"
bit = 17
always = true

[inputs.part]
drive = "B"
bit = 16

[telemetry]
"""


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with Service(tmp_path, **{"\n[telemetry]\n": DIGITAL}) as service:
        service.wait_up()
        yield service


@pytest.fixture
def robot(service: Service) -> Iterator[Robot]:
    with service.robot() as robot:
        robot.enable()
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(30.0)
        yield robot


@pytest.mark.long
def test_outputs_are_set_by_client_and_command_line(service: Service, robot: Robot) -> None:
    assert (robot.info().outputs, robot.info().inputs) == (("valve", "lamp"), ("part",))
    robot.set_output("valve", True)
    until(robot, lambda state: state.outputs == {"valve": True, "lamp": False})
    assert app(["output", "valve", "off", "--connect", service.locator], result_action="return_value") == 0
    until(robot, lambda state: state.outputs == {"valve": False, "lamp": False})
    robot.disable()
    until(robot, lambda state: state.mode == "disabled")
    with pytest.raises(
        RefusedError, match="output 'valve' stays at its safe value, off, while the robot is disabled"
    ) as refused:
        robot.set_output("valve", True)
    assert refused.value.code is RefusalCode.NOT_ENABLED
    robot.set_output("lamp", True)
    robot.set_output("lamp", False)


def test_a_goal_tells_its_switches_and_they_are_in_the_recording(
    service: Service, robot: Robot, tmp_path: Path
) -> None:
    goal = robot.move_to(
        x=0.05,
        y=0.0,
        phi=0.0,
        speed=0.3,
        marks=[
            {"output": "valve", "start": 0.01, "end": 0.04, "increment": 0.01, "pulse_width": 0.01},
            {"output": "lamp", "before_target": 0.005},
        ],
    )
    result = goal.wait(30.0)
    assert result.outcome == "done"
    assert [(each.output, each.value) for each in result.marks if each.mark == 1] == [("lamp", True)]
    pulses = [each for each in result.marks if each.mark == 0]
    assert [each.value for each in pulses] == [True, False] * 4
    for k, (on, off) in enumerate(zip(pulses[::2], pulses[1::2], strict=True), 1):
        assert on.commanded[0] == pytest.approx(0.01 * k, abs=2e-4)
        assert off.cycle - on.cycle == round(0.01 / load(SIM).period)
    assert all(before.cycle <= after.cycle for before, after in pairwise(result.marks))
    robot.set_output("lamp", False)

    assert service.end() == 0
    (file,) = (service.folder / "recordings").glob("*.rrd")
    recorded = read(file)
    found = [switch for switch in export.switches(recorded) if switch.goal == goal.id]
    assert [(each.cycle, each.output, each.value) for each in found] == [
        (each.cycle, each.output, each.value) for each in result.marks
    ]
    words = dict(zip(recorded.records["cycle"].tolist(), recorded.records["outputs"][:, 0].tolist(), strict=True))
    for on in pulses[::2]:
        assert (words[on.cycle - 1] >> 16 & 1, words[on.cycle] >> 16 & 1) == (0, 1)
    due = dict(zip(recorded.records["cycle"].tolist(), recorded.records["deadline_ns"].tolist(), strict=True))
    offsets = [each.time - due[each.cycle] * 1e-9 for each in result.marks]  # of the wall clock, in missed ticks too
    assert offsets == pytest.approx([time.time() - time.monotonic()] * len(offsets), abs=1e-3)
    compared = replay_session(recorded, load(service.folder / "robot.toml"), simulated=False)
    assert (compared.differing, compared.plans_differing) == (0, 0)
    path = tmp_path / "switches.npy"
    assert export.write_switches(recorded, path) >= len(found)
    assert np.isin(goal.id, np.load(path)["goal"])


@pytest.mark.long
def test_marks_that_cannot_be_are_refused_and_nothing_moves(robot: Robot) -> None:
    before = robot.state().commanded.position
    for marks, what in (
        ([{"output": "pump", "after_start": 0.01}], "there is no output 'pump': the robot has valve, lamp"),
        ([{"output": "valve", "after_start": 0.5}], "is at after_start = 500 mm; the path is 20 mm long"),
    ):
        with pytest.raises(RefusedError, match=what):
            robot.move_to(x=0.02, y=0.0, phi=0.0, marks=marks)
    assert robot.state().commanded.position == before


@pytest.mark.long
def test_outputs_are_safe_at_the_end_of_the_service(service: Service, robot: Robot) -> None:
    robot.set_output("valve", True)
    until(robot, lambda state: state.outputs["valve"])
    assert service.end() == 0
    sent = [int.from_bytes(data, "little") >> 16 & 1 for identifier, data in service.frames() if identifier == 0x401]
    assert [value for value, _ in itertools.groupby(sent)][-2:] == [1, 0]
