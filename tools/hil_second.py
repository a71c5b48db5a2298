"""Second robot in the emulated machine, on vcan0 at another rate, with one drive that is homed and a third-party drive.

Its service starts while the first service ends, since both are slow and neither robot is in motion then. At this time
the bus of the second robot is down; later the bus is lost at rest and in motion. The service must survive every loss.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from subprocess import Popen
from typing import Any, NamedTuple

from hil_programs import STEP_TIMEOUT_S, Failed, Machine, changed, wait_until
from hil_programs import run as run_command
from hil_scenario import Held, expect, loop_of, quick_stopped, recover, wait_for_state, wait_until_moving
from trirail.client.client import Robot
from trirail.config import Config

CHANNEL = "vcan0"
MAKE = "maxon_epos4_compact50_5"
"""Name in tests/data/drives of the drive that python-canopen simulates as drive C."""
COUNTS = 819_200.0
"""Counts per metre of drive C: 4096 counts per turn, and a screw with a lead of 5 mm."""
REVOLUTIONS = 200.0
"""Revolutions per metre of drive C, whose velocities are in rpm."""
CLOSE = 1e-4
"""Maximum deviation of a drive at rest from the position that the service reports [m]."""
VALVE = 1 << 16
"""Digital output of the third-party drive, as a bit of 60FEh:01."""
PULSES = {"output": "valve", "start": 0.004, "end": 0.016, "increment": 0.005, "pulse_width": 0.3}
"""Mark of a goal: three pulses, each three cycles long, with seven cycles between the beginnings of pulses."""

CHANGES = {
    'name = "robot"': 'name = "second"',
    "rate_hz = 20": "rate_hz = 10",
    'channel = "can0"': f'channel = "{CHANNEL}"',
    # The feedback is one SYNC old, and the setpoint is one SYNC ahead: alone 20 mm at 0.1 m/s and 10 Hz.
    "following_error = 0.03 ": "following_error = 0.06 ",
    "following_error = 0.04": "following_error = 0.08",
    "[can.simulated]\n": "[can.simulated]\nstart = [0.01, 0.0, 0.0]\n",
    "[drives.A]\n": (
        "[drives.A.homing]\nmethod = 19\nspeed_switch = 0.02\nspeed_zero = 0.005\nacceleration = 0.5\n\n[drives.A]\n"
    ),
    "[drives.C]\nnode = 3\ncounts_per_metre = 1e6": (
        f"[drives.C]\nnode = 3\ncounts_per_metre = {COUNTS}\nrevolutions_per_metre = {REVOLUTIONS}\n"
        'accept_without = ["1006"]\n\n[outputs.valve]\ndrive = "C"\nbit = 16'
    ),
    "/zenoh": "/zenoh-second",
    "/recordings": "/recordings-second",
}
"""Differences between the configurations of the second and the first robot."""
DOWN = f"CAN bus {CHANNEL} is down: "
"""Beginning of the fault's text while the bus is lost."""
FAULTS = "C silent\n"
"""Faults of the virtual drives: the third drive is silent, because the third-party drive replaces it."""


def configure(first: str) -> str:
    """Return the configuration of the second robot, given that of the first robot. Raises Failed."""
    return changed(first, CHANGES)


def begin(machine: Machine) -> tuple[Popen[bytes], Popen[bytes]]:
    """Start the drives and the log of frames, switch the bus off, and start the service.

    Return the processes of the service and of the virtual drives. This waits for the drives, but not for the service.
    """
    machine.candump(CHANNEL, "second-bus.log")
    virtual = machine.begin_drives("second.toml", CHANNEL, "second-drives", "second.faults")
    foreign = machine.begin("tools/hil_foreign.py", "second.toml", CHANNEL, "foreign")
    machine.await_drives(virtual, "second-drives")
    machine.await_drives(foreign, "foreign")
    _set_link("down")
    return machine.begin_service("second.toml", "second-service"), virtual


def run(
    machine: Machine,
    service: Popen[bytes],
    virtual: Popen[bytes],
    config: Config,
    held: Held,
    result: dict[str, Any],
) -> None:
    """Home, move and quick-stop the robot, check the position of the third-party drive, and lose bus and drives.

    `virtual` is the process of the first two drives.
    """
    machine.await_service(service, "second-service")
    with Robot(config.robot.name, config.zenoh.listen[0]) as robot:
        state = wait_for_state(robot, lambda state: state.mode == "fault", "fault without a bus")
        if not state.faults[0].startswith(DOWN):
            raise Failed(f"the fault of a start without a bus does not begin with {DOWN!r}: {state.faults}")
        held("start on a bus that is down", state.faults[0])
        _set_link("up")
        recover(robot)
        lacking = ", ".join(each.object for each in robot.info().missing_protections)
        where = f"up on {CHANNEL} at {config.loop.rate_hz} Hz"
        held("second service", f"{where}; drive C is python-canopen's, of {MAKE}, and lacks {lacking}")
        robot.home()
        held("homing", f"drive A has found its switch, {robot.state().sliders.position[0] * 1e3:.3f} mm")
        moved = robot.move_to(x=0.01, y=-0.005, phi=0.05).wait(STEP_TIMEOUT_S)
        expect(moved, "done", robot)
        result["switches"] = _switched(robot, machine, held)
        result["second_cut"] = quick_stopped(robot, held, "quick stop of a foreign drive")
        moved = robot.move_to(x=-0.01, y=0.005, phi=-0.05).wait(STEP_TIMEOUT_S)
        expect(moved, "done", robot)
        robot.disable()
        state = robot.state()
        result["loops"] |= {f"{config.loop.rate_hz} Hz": loop_of(state)}
    wait_until(lambda: _at(machine) is not None, "the foreign drive loses its power")
    there, reported = _at(machine) or 0.0, state.sliders.position[2]
    if abs(there - reported) > CLOSE:
        raise Failed(f"the foreign drive is at {there * 1e3:.3f} mm, the service says {reported * 1e3:.3f} mm")
    held("foreign drive", f"followed to {there * 1e3:.3f} mm, as the service says; no power")
    _disturb(machine, virtual, config, held)
    machine.end(service, "the second service")
    held("second end", "exit code 0 after SIGTERM")


class Change(NamedTuple):
    """Change of the third-party drive's outputs, from a line that the drive has printed."""

    on: bool
    """Value of the valve."""
    sync: int
    """Number of the SYNC at which the outputs changed."""
    t: float
    """Wall-clock time soon after the change [s]."""


def changes(log: str) -> list[Change]:
    """Return the changes of outputs in the log of the third-party drive."""
    lines = re.findall(r"^outputs ([0-9A-F]{8}) at SYNC (\d+), ([\d.]+)$", log, re.MULTILINE)
    return [Change(bool(int(bits, 16) & VALVE), int(sync), float(t)) for bits, sync, t in lines]


def cycles_problem(cycles: Sequence[tuple[int, bool]], switched: Sequence[tuple[int, bool]]) -> str:
    """Return a description of the difference between a table of switches and the actual switches, or "".

    There is no difference if the values are equal and all switches are delayed by the same number of SYNCs.
    """
    expected, values = [on for _, on in cycles], [on for _, on in switched]
    if values != expected:
        return f"outputs have switched to {values}, in the table to {expected}"
    shifts = [sync - cycle for (cycle, _), (sync, _) in zip(cycles, switched, strict=True)]
    return f"outputs have switched {shifts} SYNCs after their cycles of the table" if len(set(shifts)) > 1 else ""


def _switched(robot: Robot, machine: Machine, held: Held) -> list[dict[str, Any]]:
    """Switch an output of the third-party drive on the path of a goal; return the table of the switches.

    All switches must take effect the same number of SYNCs after their cycles in the goal's result.
    """
    before = len(changes(machine.log("foreign")))
    goal = robot.move_to(x=0.01, y=0.015, phi=0.05, speed=0.3, marks=[PULSES])
    ended = goal.wait(STEP_TIMEOUT_S)
    expect(ended, "done", robot)
    table = ended.marks
    wait_until(
        lambda: len(changes(machine.log("foreign"))) >= before + len(table), "the foreign drive switches its output"
    )
    switched = changes(machine.log("foreign"))[before:]
    if problem := cycles_problem(
        [(row.cycle, row.value) for row in table], [(each.sync, each.on) for each in switched]
    ):
        raise Failed(f"the foreign drive: {problem}")
    cycles = ", ".join(str(row.cycle) for row in table)
    held("outputs on the path", f"the foreign drive's valve has switched at the SYNC after each of cycles {cycles}")
    return [
        {"cycle": row.cycle, "value": row.value, "taken": each.t} for row, each in zip(table, switched, strict=True)
    ]


def _disturb(machine: Machine, virtual: Popen[bytes], config: Config, held: Held) -> None:
    """Lose the bus at rest and in motion, and then drives A and B. The robot must recover each time."""
    with Robot(config.robot.name, config.zenoh.listen[0]) as robot:
        robot.enable()
        held("bus lost at rest", _recovered(robot, lambda: _set_link("down"), lambda: _set_link("up"), DOWN))
        goal = robot.move_to(x=0.03, y=0.0, phi=0.0)
        wait_until_moving(robot, goal.id)
        lost = _recovered(robot, lambda: _set_link("down"), lambda: _set_link("up"), DOWN)
        expect(goal.wait(STEP_TIMEOUT_S), "faulted", robot)
        held("bus lost in motion", lost)

        def restart() -> None:
            machine.restart_drives("second.toml", CHANNEL, "second-drives-again", "second.faults")

        held("drives killed and started again", _recovered(robot, virtual.kill, restart, "drive "))


def _recovered(robot: Robot, lose: Callable[[], object], restore: Callable[[], object], fault: str) -> str:
    """Cause a loss, restore, and let the robot recover; return a description.

    The robot recovers by reset, enable, homing and a goal. Raises Failed if the fault does not begin with `fault`.
    """
    lose()
    state = wait_for_state(robot, lambda state: state.mode == "fault", "fault")
    if not state.faults[0].startswith(fault):
        raise Failed(f"the fault does not begin with {fault!r}: {state.faults}")
    restore()
    recover(robot)
    robot.home()
    moved = robot.move_to(x=0.0, y=0.0, phi=0.0).wait(STEP_TIMEOUT_S)
    expect(moved, "done", robot)
    return f"{state.faults[0]}; then reset, enabled, homed, goal done"


def _set_link(state: str) -> None:
    run_command("ip", "link", "set", CHANNEL, state)


def _at(machine: Machine) -> float | None:
    """Return the position of the third-party drive [m] if its newest line reports no power, otherwise None."""
    lines = [line for line in machine.log("foreign").splitlines() if line.startswith("C ")]
    logs = re.fullmatch(r"C switch on disabled, (-?[\d.]+) mm", lines[-1]) if lines else None
    return float(logs[1]) * 1e-3 if logs else None
