"""Replays of what goes wrong: faults of drives, late ticks, lost gateways, goals that come too late."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from processes.test_loop import Shell, shell
from trirail.analysis.replay import replay_session
from trirail.telemetry.recording import Recording
from trirail.wire.goals import PoseGoal
from trirail.wire.packets import CommandRequest, ControlInput, GoalRequest, Kind, decode_answer, message
from trirail.wire.records import unpack
from trirail.wire.vocabulary import MODES, Command, Mode

__all__ = ["shell"]


def recorded(shell: Shell) -> Recording:
    """What the recorder would have written."""
    packets = shell.received(shell.recorder)
    records = np.concatenate([unpack(packet[1:]) for packet in packets if packet[0] == Kind.RECORDS])
    said = [decode_answer(packet[1:]) for packet in packets if packet[0] == Kind.MESSAGE]
    given = tuple(answer for answer in said if isinstance(answer, ControlInput))
    t, wall = records["cycle"] * shell.rig.config.period, np.zeros(len(records), "datetime64[ns]")
    return Recording("demo", records, t, wall, [], {}, given)


def lose_a_drive(shell: Shell) -> None:
    shell.rig.drives[1].fail(0x4310)
    shell.cycles(150)
    shell.gateway.send(message(CommandRequest(3, "ann", Command.RESET)))
    shell.cycles(300)
    shell.gateway.send(message(CommandRequest(4, "ann", Command.ENABLE)))


def push_a_slider(shell: Shell) -> None:
    shell.rig.drives[0].servo.position += 0.0045 * 1e7


def be_late(shell: Shell) -> None:
    shell.cycles(1, missed=shell.rig.config.watchdogs.max_overruns + 1)


def lose_the_gateway(shell: Shell) -> None:
    shell.gateway.close()


def freeze_the_gateway(shell: Shell) -> None:
    shell.heartbeats.heart("gateway").beat()
    shell.cycles(400)


def end(shell: Shell) -> None:
    shell.loop.ending = True


@pytest.mark.parametrize("happen", [lose_a_drive, push_a_slider, be_late, lose_the_gateway, freeze_the_gateway, end])
def test_a_mishap_comes_out_the_same(shell: Shell, happen: Callable[[Shell], None]) -> None:
    shell.cycles(40)  # without power, with the recorder there
    shell.enabled()
    now = round(shell.rig.now * 1e9)
    shell.gateway.send(message(GoalRequest(2, "ann", "g-1", PoseGoal(0.08, 0.02, 0.2, valid_for=1.0), now)))
    shell.cycles(150)
    assert shell.loop.control.state.mode is Mode.MOVING
    happen(shell)
    shell.cycles(600)
    recording = recorded(shell)
    assert np.any(recording.records["mode"] != MODES.index(Mode.MOVING))
    compared = replay_session(recording, shell.rig.config, simulated=False)
    assert compared.cycles == len(recording.records) > 600
    assert compared.differing == 0
    without = recording._replace(requests=recording.requests[:3])  # enabled, sent a goal, and that is planned
    if len(recording.requests) > 3:  # of a pushed slider the drives' positions tell by themselves
        assert replay_session(without, shell.rig.config, simulated=False).differing > 0


def test_a_goal_that_came_too_late_is_too_late_again(shell: Shell) -> None:
    shell.cycles(40)  # without power, with the recorder there
    shell.enabled()
    then = round((shell.rig.now - 1.0) * 1e9)
    shell.gateway.send(message(GoalRequest(2, "ann", "g-1", PoseGoal(0.08, 0.0, 0.0, valid_for=0.5), then)))
    shell.cycles(100)
    recording = recorded(shell)
    assert replay_session(recording, shell.rig.config, simulated=False).differing == 0
    assert not recording.records["commanded_velocity"].any()
