"""A second robot in the emulated machine: at another rate, on vcan0, one drive to be homed and one that others made.

Its service starts while the first one ends: both are slow there, and neither is in motion.
"""

from __future__ import annotations

import re
from subprocess import Popen
from typing import Any

from hil_programs import WITHIN, Failed, Machine, until
from hil_scenario import Held, expect, loop_of, quick_stopped, recover
from trirail.client.client import Robot
from trirail.config import Config

CHANNEL = "vcan0"
MAKE = "maxon_epos4_compact50_5"
"""Of tests/data/drives: what python-canopen serves as drive C."""
COUNTS = 819_200.0
"""Its counts per metre: 4096 a turn, a screw of 5 mm lead."""
REVOLUTIONS = 200.0
"""Its turns per metre, for it reckons in rpm."""
CLOSE = 1e-4
"""How far a drive at rest may be from where the service says that it is [m]."""

CHANGES = {
    'name = "robot"': 'name = "second"',
    "rate_hz = 20": "rate_hz = 10",
    'channel = "can0"': f'channel = "{CHANNEL}"',
    # At 10 Hz and 0.1 m/s a setpoint that is ahead and feedback that is behind alone are 20 mm.
    "following_error = 0.03 ": "following_error = 0.06 ",
    "following_error = 0.04": "following_error = 0.08",
    "[can.simulated]\n": "[can.simulated]\nstart = [0.01, 0.0, 0.0]\n",
    "[drives.A]\n": (
        "[drives.A.homing]\nmethod = 19\nspeed_switch = 0.02\nspeed_zero = 0.005\nacceleration = 0.5\n\n[drives.A]\n"
    ),
    "[drives.C]\nnode = 3\ncounts_per_metre = 1e6": (
        f"[drives.C]\nnode = 3\ncounts_per_metre = {COUNTS}\nrevolutions_per_metre = {REVOLUTIONS}\n"
        'accept_without = ["1006"]'
    ),
    "/zenoh": "/zenoh-second",
    "/recordings": "/recordings-second",
}
"""What its configuration has that differs from the first robot's."""
FAULTS = "C silent\n"
"""Of the virtual drives: the third gives its place to the foreign one."""


def configure(first: str) -> str:
    """The second robot's configuration from the first one's."""
    for before, after in CHANGES.items():
        if first.count(before) != 1:
            raise Failed(f"{before!r} is not there once; CHANGES of tools/hil_second.py needs it")
        first = first.replace(before, after)
    return first


def begin(machine: Machine) -> Popen[bytes]:
    """Start its drives, its log of frames and its service, and wait for none of them but the drives."""
    machine.candump(CHANNEL, "second-bus.log")
    virtual = machine.begin_drives("second.toml", CHANNEL, "second-drives", "second.faults")
    foreign = machine.begin("tools/hil_foreign.py", "second.toml", CHANNEL, "foreign")
    machine.await_drives(virtual, "second-drives")
    machine.await_drives(foreign, "foreign")
    return machine.begin_service("second.toml", "second-service")


def run(machine: Machine, service: Popen[bytes], config: Config, held: Held, result: dict[str, Any]) -> None:
    """Home, move, be stopped by a quick stop; the drive that others made must be where it was sent."""
    machine.await_service(service, "second-service")
    with Robot(config.robot.name, config.zenoh.listen[0]) as robot:
        lacking = ", ".join(each.object for each in robot.info().missing_protections)
        where = f"up on {CHANNEL} at {config.loop.rate_hz} Hz"
        held("second service", f"{where}; drive C is python-canopen's, of {MAKE}, and lacks {lacking}")
        recover(robot)
        robot.home()
        held("homing", f"drive A has found its switch, {robot.state().sliders.position[0] * 1e3:.3f} mm")
        moved = robot.move_to(x=0.01, y=-0.005, phi=0.05).wait(WITHIN)
        expect(moved, "done", robot)
        result["second_cut"] = quick_stopped(robot, held, "quick stop of a foreign drive")
        moved = robot.move_to(x=-0.01, y=0.005, phi=-0.05).wait(WITHIN)
        expect(moved, "done", robot)
        robot.disable()
        state = robot.state()
        result["loops"] |= {f"{config.loop.rate_hz} Hz": loop_of(state)}
    until(lambda: _at(machine) is not None, "the foreign drive loses its power")
    there, told = _at(machine) or 0.0, state.sliders.position[2]
    if abs(there - told) > CLOSE:
        raise Failed(f"the foreign drive is at {there * 1e3:.3f} mm, the service says {told * 1e3:.3f} mm")
    held("foreign drive", f"followed to {there * 1e3:.3f} mm, as the service says; no power")
    machine.end(service, "the second service")
    held("second end", "exit code 0 after SIGTERM")


def _at(machine: Machine) -> float | None:
    """Where the foreign drive is [m], if it says as its newest that it has no power."""
    lines = machine.log("foreign").splitlines()
    found = re.fullmatch(r"C switch on disabled, (-?[\d.]+) mm", lines[-1]) if lines else None
    return float(found[1]) * 1e-3 if found else None
