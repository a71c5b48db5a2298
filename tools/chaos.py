"""Kill matrix: every process of the service is killed, ended and frozen in every mode. The drives run separately.

python tools/chaos.py                   all cases, forty minutes
python tools/chaos.py --sample 10       ten cases, chosen at random by --seed
python tools/chaos.py --only moving/loop/KILL

Each case checks that the drives are at rest and unpowered, that no setpoint has jumped, that the goal has ended exactly
once, that no process is left, that the ports are free, that the recording can be read, and that the service can start
again. The exit code is 1 if any check fails.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from chaos_rig import EVENT_TIMEOUT_S, PROCESSES, Failed, Rig, running_rig, states, wait_for
from interruption import interrupt_on_signals
from trirail.client.client import Robot
from trirail.errors import TrirailError
from trirail.wire.zenoh_session import key, open_client

MODES = ("disabled", "enabling", "holding", "moving", "stopping", "fault")
HARM: dict[str, tuple[signal.Signals, float | None]] = {
    "KILL": (signal.SIGKILL, None),
    "TERM": (signal.SIGTERM, None),
    "STOP 2 s": (signal.SIGSTOP, 2.0),
    "STOP 10 s": (signal.SIGSTOP, 10.0),
    "STOP": (signal.SIGSTOP, None),
}
GOAL = "chaos"
STANDS_AFTER = 3.0
"""Time after which a robot that no process can stop any more must be at rest [s]."""


class Case(NamedTuple):
    """Disturbance of one process in one mode."""

    mode: str
    victim: str
    harm: str

    @property
    def ends_the_service(self) -> bool:
        """Whether the disturbance ends the service."""
        if self.victim == "fork-server":
            return self.harm == "KILL"
        return self.victim == "loop" or (self.victim == "supervisor" and self.harm in ("KILL", "TERM"))

    @property
    def stops_the_robot(self) -> bool:
        """Whether the robot must be at rest soon after the disturbance."""
        return self.ends_the_service or self.victim == "gateway"

    @property
    def exit_codes(self) -> tuple[int, ...]:
        """Permitted exit codes of the service."""
        if self.victim == "supervisor":
            return (0,) if self.harm not in {"KILL", "STOP"} else (-signal.SIGKILL,)
        if self.victim == "loop" or (self.victim, self.harm) == ("fork-server", "KILL"):
            return (1,)
        # A recorder that is frozen when the service ends is killed and loses its data, which counts as a failure. A
        # frozen fork server does not report how the other processes have ended, so the service may report a failure.
        return (0, 1) if self.victim in ("recorder", "fork-server") and self.harm == "STOP" else (0,)

    def __str__(self) -> str:
        return "/".join(self)


CASES = [Case(*case) for case in itertools.product(MODES, PROCESSES, HARM)]


def enter_mode(mode: str, rig: Rig, robot: Robot, ask: Callable[[str], object]) -> None:
    """Bring a disabled robot into a mode, with the goal GOAL if the mode requires a goal.

    `ask` sends a command and does not wait for its execution.
    """
    if mode == "disabled":
        return
    if mode == "enabling":
        rig.fault("A drop rpdo1")  # keeps drive A from receiving the command to power up
        ask("enable")
        states(robot, lambda state: state.mode == "enabling")
        return
    robot.enable()
    if mode == "holding":
        return
    there = -1.0 if robot.state().pose[0] > 0.0 else 1.0
    robot.move_to(x=0.1 * there, y=0.02, phi=0.3 * there, speed=0.3, id=GOAL)
    states(robot, lambda state: state.goal is not None and state.goal.progress > 0.2)
    if mode == "stopping":
        ask("stop")
        states(robot, lambda state: state.mode == "stopping")
    elif mode == "fault":
        robot.quick_stop()


def run(rig: Rig, case: Case) -> None:
    """Apply a case to a running service with a disabled robot, and check the outcome. Raises Failed."""
    heard: list[str] = []
    victim = rig.process(case.victim)
    faults = rig.major_faults()
    number, seconds = HARM[case.harm]
    with rig.robot() as robot, open_client(rig.locator) as session:
        enter_mode(case.mode, rig, robot, lambda name: session.get(key("demo", "cmd", "chaos", name)))
        os.kill(victim, number)
        stands_by = time.monotonic() + STANDS_AFTER
    if seconds is not None:
        time.sleep(seconds)
        with contextlib.suppress(ProcessLookupError):  # the service may have killed the frozen process
            os.kill(victim, signal.SIGCONT)
    rig.fault("clear")
    if case.ends_the_service:
        _wait_end(rig)
    else:
        heard = _check_continues(rig, case)
        if waited := rig.major_faults() - faults:
            raise Failed(f"the loop has waited for {waited} pages from the disk: they should have been in memory")
        if case.victim == "supervisor" and case.harm == "STOP":
            rig.service.kill()
        else:
            rig.service.send_signal(signal.SIGTERM)
        _wait_end(rig)
    if rig.service.returncode not in case.exit_codes:
        raise Failed(f"exit code {rig.service.returncode}, expected was {case.exit_codes[0]}")
    wait_for(lambda: not rig.remains(), "all processes have ended")
    time.sleep(max(0.0, stands_by - time.monotonic()))  # the service may end before the drives' watchdogs react
    rig.check_rest()
    rig.check_unpowered()
    rig.check_setpoints()
    if not rig.ports_are_free():
        raise Failed("a port is not free")
    _check_goal(rig, case, heard)


def _check_continues(rig: Rig, case: Case) -> list[str]:
    """Check that the service continues and obeys a stop; return the reported outcomes of the goal."""
    if case.stops_the_robot:
        time.sleep(STANDS_AFTER)
        rig.check_rest()
    with rig.served() as robot:
        robot.stop()
        if case.mode == "fault":
            robot.reset()
        robot.disable()
        events = robot.events(history=True, timeout=1.0)
        return [str(event.outcome) for event in events if event.id == GOAL and event.outcome]


def _wait_end(rig: Rig) -> None:
    with contextlib.suppress(Exception):
        rig.service.wait(EVENT_TIMEOUT_S)
    if rig.service.poll() is None:
        rig.service.kill()
        rig.service.wait()
        raise Failed("the service does not end")


def _check_goal(rig: Rig, case: Case, heard: list[str]) -> None:
    """Check that the recordings are readable and contain exactly one end of the goal. Raises Failed."""
    recorded: dict[int, str] = {}
    sent = False
    for recording in rig.recordings():
        sent = sent or any(getattr(what.given, "id", "") == GOAL for what in recording.requests)
        for line in recording.events:
            if line.event is not None and line.event.id == GOAL and line.event.outcome:
                recorded[line.event.seq] = line.event.outcome
    if case.mode in ("disabled", "enabling", "holding"):
        return
    if len(heard) > 1 or len(recorded) > 1:
        raise Failed(f"the goal has ended more than once: {heard} {recorded}")
    # If the recorder was the victim, the event may be missing in the recording.
    if not recorded and (case.victim != "recorder" or not heard):
        raise Failed("how the goal has ended is in no recording")


def attempt(rig: Rig, case: Case) -> str:
    """Run a case, and start a new service for the next one; return "ok" or a description of the failure."""
    outcome = "ok"
    try:
        run(rig, case)
    except (Failed, TrirailError) as failure:
        rig.service.terminate()
        outcome = " ".join(f"{failure}; warnings: {rig.warnings()}".split())
    finally:
        rig.fault("clear")
    try:
        rig.clean_up()
        rig.start()
        with rig.served() as robot:
            if robot.state().mode == "fault":
                robot.reset()
            robot.enable()
            robot.disable()
    except (Failed, TrirailError) as failure:
        return f"{outcome}; the next start: {' '.join(str(failure).split())}"
    return outcome


def main() -> int:
    """Run the selected cases; print a table or, with --json, one JSON object; return the exit code."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--sample", type=int, help="number of random cases")
    arguments.add_argument("--seed", type=int, default=0, help="seed of the random choice")
    arguments.add_argument("--only", default="", help="cases whose mode/victim/signal contains this")
    arguments.add_argument("--json", action="store_true", help="print one JSON object")
    options = arguments.parse_args()
    cases = [case for case in CASES if options.only in str(case)]
    if options.sample is not None and options.sample < len(cases):
        cases = random.Random(options.seed).sample(cases, options.sample)
    if not cases:
        arguments.error("no case is selected; a case is mode/victim/signal, such as moving/loop/KILL")
    interrupt_on_signals()
    results: dict[str, str] = {}
    interrupted = False
    try:
        with tempfile.TemporaryDirectory(prefix="trirail-chaos-") as folder, running_rig(Path(folder)) as rig:
            for case in cases:
                results[str(case)] = result = attempt(rig, case)
                if not options.json:
                    print(f"{case.mode:9} {case.victim:11} {case.harm:10} {result}", flush=True)
    except KeyboardInterrupt:
        interrupted = True
    counts = Counter(result == "ok" for result in results.values())
    if options.json:
        print(json.dumps({"ok": counts[True], "failed": counts[False], "cases": results}))
    else:
        left = f"; interrupted, {len(cases) - len(results)} not run" if interrupted else ""
        print(f"{counts[True]} of {len(results)} cases ok{left}")
    return 130 if interrupted else int(counts[False] > 0)


if __name__ == "__main__":
    sys.exit(main())
