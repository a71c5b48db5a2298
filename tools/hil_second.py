"""Second robot in the emulated machine: another rate, on vcan0, with a drive that needs homing and a third-party one.

Its service starts while the first one ends, because both are slow then, and neither is in motion. Its bus is down at
that time, and is lost at rest and in motion later. The same service survives all of this.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from subprocess import Popen
from typing import Any, NamedTuple

from hil_programs import STEP_TIMEOUT_S, Failed, Machine, wait_until
from hil_programs import run as run_command
from hil_scenario import Held, expect, loop_of, quick_stopped, recover, wait_for_state, wait_until_moving
from trirail.client.client import Robot
from trirail.config import Config

CHANNEL = "vcan0"
MAKE = "maxon_epos4_compact50_5"
"""Name in tests/data/drives of the drive that python-canopen serves as drive C."""
COUNTS = 819_200.0
"""Counts per metre of drive C: 4096 per turn, a screw of 5 mm lead."""
REVOLUTIONS = 200.0
"""Turns per metre of drive C, which uses rpm."""
CLOSE = 1e-4
"""Maximum deviation of a drive at rest from the position that the service reports [m]."""
VALVE = 1 << 16
"""Output of the foreign drive, as a bit of 60FEh:01."""
PULSES = {"output": "valve", "start": 0.004, "end": 0.016, "increment": 0.005, "pulse_width": 0.3}
"""Mark of a goal: three pulses of three cycles, seven cycles apart."""

CHANGES = {
    'name = "robot"': 'name = "second"',
    "rate_hz = 20": "rate_hz = 10",
    'channel = "can0"': f'channel = "{CHANNEL}"',
    # A setpoint one cycle ahead and feedback one cycle behind alone are 20 mm at 10 Hz and 0.1 m/s.
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
"""Differences of its configuration from that of the first robot."""
DOWN = f"CAN bus {CHANNEL} is down: "
"""Beginning of the fault while its bus is lost."""
FAULTS = "C silent\n"
"""Faults of the virtual drives: the third is replaced by the foreign one."""


def configure(first: str) -> str:
    """Return the second robot's configuration, derived from that of the first."""
    for before, after in CHANGES.items():
        if first.count(before) != 1:
            raise Failed(f"{before!r} is not there once; CHANGES of tools/hil_second.py needs it")
        first = first.replace(before, after)
    return first


def begin(machine: Machine) -> tuple[Popen[bytes], Popen[bytes]]:
    """Start its drives, its log of frames and its service, on a bus that is down; return service and virtual drives.

    Waits only for the drives.
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
    """Home, move, stop by a quick stop, lose the bus and the drives; the foreign drive must reach its target.

    `virtual`: the process of its first two drives.
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
    """Change of the foreign drive's outputs, as it prints it."""

    on: bool
    """Value of the valve."""
    sync: int
    """Number of the SYNC at which they changed."""
    t: float
    """Wall-clock time soon after it [s]."""


def changes(log: str) -> list[Change]:
    """Return the changes of outputs in the foreign drive's log."""
    lines = re.findall(r"^outputs ([0-9A-F]{8}) at SYNC (\d+), ([\d.]+)$", log, re.MULTILINE)
    return [Change(bool(int(bits, 16) & VALVE), int(sync), float(t)) for bits, sync, t in lines]


def cycles_problem(cycles: Sequence[tuple[int, bool]], switched: Sequence[tuple[int, bool]]) -> str:
    """Return what is wrong; "" where values switched as in a table, all equally many SYNCs after their cycle."""
    expected, values = [on for _, on in cycles], [on for _, on in switched]
    if values != expected:
        return f"outputs have switched to {values}, in the table to {expected}"
    shifts = [sync - cycle for (cycle, _), (sync, _) in zip(cycles, switched, strict=True)]
    return f"outputs have switched {shifts} SYNCs after their cycles of the table" if len(set(shifts)) > 1 else ""


def _switched(robot: Robot, machine: Machine, held: Held) -> list[dict[str, Any]]:
    """Switch an output of the foreign drive on the path of a goal; return the table of its switches.

    Each must take effect equally many SYNCs after the cycle that the table has.
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
    """Lose the bus at rest and in motion, then drives A and B; reset, enable, home and a goal suffice each time."""
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
    """Cause a loss and restore it; return the passed check. Raises Failed unless the `fault` begins as expected."""
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
    """Return the position of the foreign drive [m], if its newest output reports no power."""
    lines = [line for line in machine.log("foreign").splitlines() if line.startswith("C ")]
    logs = re.fullmatch(r"C switch on disabled, (-?[\d.]+) mm", lines[-1]) if lines else None
    return float(logs[1]) * 1e-3 if logs else None
