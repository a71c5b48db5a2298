"""Scenario of the first robot in the emulated machine: motion, stops, and disturbances on the bus, in this order."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any

from hil_programs import STEP_TIMEOUT_S, Failed, Machine, run, wait_until
from trirail.client.client import Result, Robot
from trirail.config import Config
from trirail.errors import RefusedError
from trirail.wire.state import State

Held = Callable[[str, str], None]
"""Function that records a passed check and its details."""

FLOOD_GAP = "4"
"""Time between two frames of a flood [ms]. A flood thus has 250 frames per second; their priority is the highest that a
data frame of another node can have.
"""
PRE_OPERATIONAL_B = "000#8002"
"""NMT command with which another master would switch drive B to pre-operational (CiA 301, 7.2.8.3.1)."""


def disturbed(machine: Machine, config: Config, held: Held, result: dict[str, Any]) -> None:
    """Move and stop the robot, then disturb it: by other nodes on the bus, and by the loss of either card in motion.

    "cut" in `result` is set to the time of the first disturbance. Until then, the frames on the bus must be perfect.
    """
    held("service", "up on can0, its drives set up and read back by SDO")
    with Robot(config.robot.name, config.zenoh.listen[0]) as robot:
        recover(robot)  # a stall of the machine at the start correctly causes a fault
        held("enable", "confirmed, the robot holds")
        moved = robot.move_to(x=0.01, y=-0.005, phi=0.05).wait(STEP_TIMEOUT_S)
        expect(moved, "done", robot)
        held("goal", moved.message)
        _refused(robot, held)
        _stopped(robot, held)
        robot.disable()
        held("disable", "confirmed, no drive has power")
        result["loops"] |= {f"{config.loop.rate_hz} Hz": loop_of(robot.state())}
        result["cut"] = time.time()
        robot.enable()
        held("doctor beside the service", machine.measured_timing())
        recover(robot)
        quick_stopped(robot, held)
        _flooded(robot, held)
        _thrown_out(robot, held)
        _drives_link_down(robot, machine, held)
        _link_down(robot, machine, held)


def _refused(robot: Robot, held: Held) -> None:
    try:
        robot.move_to(x=0.5, y=0.0, phi=0.0)
    except RefusedError as refused:
        held("goal out of reach", str(refused))
    else:
        raise Failed("a goal 0.5 m away was accepted")


def _stopped(robot: Robot, held: Held) -> None:
    goal = robot.move_to(x=-0.08, y=0.0, phi=0.0)
    wait_until_moving(robot, goal.id)
    robot.stop()
    result = goal.wait(STEP_TIMEOUT_S)
    expect(result, "stopped", robot)
    held("stop", result.message)


def quick_stopped(robot: Robot, held: Held, name: str = "quick stop and reset") -> float:
    """Quick-stop the robot in motion, reset and enable it; return the time of the stop command [s since 1970]."""
    goal = robot.move_to(x=0.08, y=0.0, phi=0.0)
    wait_until_moving(robot, goal.id)
    at = time.time()
    robot.quick_stop()
    expect(goal.wait(STEP_TIMEOUT_S), "faulted", robot)
    state = wait_for_state(robot, lambda state: state.mode == "fault", "fault after a quick stop")
    recover(robot)
    held(name, f"{'; '.join(state.faults)}; then enabled again")
    return at


def _flooded(robot: Robot, held: Held) -> None:
    with subprocess.Popen(("cangen", "can1", "-I", "001", "-L", "8", "-g", FLOOD_GAP)) as flood:
        try:
            result = robot.move_to(x=0.0, y=0.01, phi=0.0).wait(STEP_TIMEOUT_S)
        finally:
            flood.terminate()
    expect(result, "done", robot)
    held("flood at the highest priority", f"{1000 // int(FLOOD_GAP)} frames 001 a second: {result.message}")


def _thrown_out(robot: Robot, held: Held) -> None:
    """Switch drive B to pre-operational in motion, as another master could: the robot must stop and name the drive."""
    goal = robot.move_to(x=-0.08, y=0.0, phi=0.0)
    wait_until_moving(robot, goal.id)
    run("cansend", "can1", PRE_OPERATIONAL_B)
    held("a foreign master's NMT", _faulted(robot, goal.wait(STEP_TIMEOUT_S), "drive B"))
    recover(robot)


def _drives_link_down(robot: Robot, machine: Machine, held: Held) -> None:
    """Switch the drives' CAN interface off in motion: the drives must stop by themselves, and recover afterwards."""
    goal = robot.move_to(x=0.08, y=0.0, phi=0.0)
    wait_until_moving(robot, goal.id)
    run("ip", "link", "set", "can1", "down")
    words = _faulted(robot, goal.wait(STEP_TIMEOUT_S), "drive")
    wait_until(lambda: _in_fault(machine.log("drives")), "the drives stop by their own watchdogs")
    run("ip", "link", "set", "can1", "up")
    recover(robot)
    held("drives' interface down in motion", f"{words}; up again, reset and enabled")


def _link_down(robot: Robot, machine: Machine, held: Held) -> None:
    goal = robot.move_to(x=0.0, y=0.0, phi=0.0)
    wait_until_moving(robot, goal.id)
    run("ip", "link", "set", "can0", "down")
    held("interface down in motion", _faulted(robot, goal.wait(STEP_TIMEOUT_S), "CAN bus"))
    wait_until(lambda: _in_fault(machine.log("drives")), "the drives stop by their own watchdogs")
    held("drives without a master", "all three stopped by their own watchdogs")


def _faulted(robot: Robot, result: Result, whose: str) -> str:
    """Return the text of the fault. Raises Failed unless the goal ended with a fault that names its origin `whose`."""
    expect(result, "faulted", robot)
    state = wait_for_state(robot, lambda state: state.mode == "fault", "fault")
    if not any(whose in fault for fault in state.faults):
        raise Failed(f"the fault does not name {whose!r}: {state.faults}")
    return "; ".join(state.faults)


def recover(robot: Robot) -> None:
    """Repeat reset and enable until both succeed: the cause of a fault must be gone, and the sliders at rest."""

    def enabled() -> bool:
        try:
            if robot.state().mode == "fault":
                robot.reset()
            robot.enable()
        except RefusedError:
            return False
        return True

    wait_until(enabled, "reset and enabled")


def wait_until_moving(robot: Robot, goal: str) -> None:
    """Wait until a goal has progressed by more than a fifth. Raises Failed."""
    wait_for_state(
        robot,
        lambda state: state.goal is not None and state.goal.id == goal and state.goal.progress > 0.2,
        "the robot moves",
    )


def wait_for_state(robot: Robot, condition: Callable[[State], bool], what: str) -> State:
    """Wait for the first state that satisfies a condition, and return it. Raises Failed."""
    deadline = time.monotonic() + STEP_TIMEOUT_S
    for state in robot.states(timeout=STEP_TIMEOUT_S):
        if condition(state):
            return state
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {STEP_TIMEOUT_S:g} s; {_about(state)}")
    raise Failed(f"{what}: the service has gone silent")


def expect(result: Result, outcome: str, robot: Robot) -> None:
    """Raise Failed unless a goal ended with the expected outcome."""
    if result.outcome != outcome:
        raise Failed(f"goal: {result.message}; expected {outcome}. {_about(robot.state())}")


def _about(state: State) -> str:
    return f"mode {state.mode}, faults {state.faults}, missed ticks {state.loop.overruns}"


def _in_fault(log: str) -> bool:
    """Return whether the newest line of each drive reports a fault; in this scenario, its watchdog causes the fault."""
    newest = {line[0]: line for line in log.splitlines() if line[:2] in {"A ", "B ", "C "}}
    return len(newest) == 3 and all(line[2:].startswith("fault,") for line in newest.values())


def loop_of(state: State) -> dict[str, Any]:
    """Return the numbers of cycles and of missed ticks, and the lateness of the loop."""
    loop = state.loop
    return {
        "cycles": loop.cycles,
        "overruns": loop.overruns,
        "lateness_us": {"p50": loop.lateness_us.p50, "p99": loop.lateness_us.p99, "max": loop.lateness_us.max},
    }
