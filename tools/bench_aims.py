"""Run of all benchmarks one after the other, and a table that compares the results with the service's aims."""

from __future__ import annotations

import json as json_format
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

Results = dict[str, Any]
"""Results of each benchmark by name."""

COMMANDS = {
    "peers": ("--seconds", "5"),
    "fairness": ("--goals", "400"),
    "frames": (),
    "kinematics": (),
    "latency": ("--goals", "80"),
    "loop": ("--rates", "1000", "--rates", "2000", "--seconds", "60", "--runs", "5"),
    "outputs": ("--tries", "5"),
    "start": (),
}
"""Benchmarks and their options; together they take less than ten minutes."""
BRIEF = {
    "fairness": ("--goals", "20"),
    "frames": ("--cycles", "50"),
    "latency": ("--goals", "3"),
    "loop": ("--rates", "1000", "--seconds", "2", "--runs", "1"),
    "outputs": ("--pulses", "3", "--tries", "1"),
    "peers": ("--seconds", "1"),
}
"""Options for a brief run."""


Measured = Callable[[Results], tuple[float, ...]]
"""Function that returns the numbers for an aim from the results of all benchmarks, or of `loop` at one rate."""


class Aim(NamedTuple):
    """Aim of the service: one row of the table."""

    name: str
    before: str
    """Result of an earlier version."""
    aim: tuple[float, ...]
    measured: Measured
    """Function that returns one number for each limit in `aim`, which it must not exceed; no numbers if the service
    could not keep the rate.
    """


def at(results: Results, rate: int) -> Results:
    """Return the results of `loop` at a rate."""
    return next(loop for loop in results["loop"]["rates"] if loop["rate_hz"] == rate)


def _loop(rate: int, measured: Measured) -> Measured:
    """Return a function that applies `measured` to the results of `loop` at a rate, if the service kept this rate."""

    def measured_if_kept(results: Results) -> tuple[float, ...]:
        loop = at(results, rate)
        return () if "not_kept" in loop else measured(loop)

    return measured_if_kept


def _missed(loop: Results) -> float:
    """Return the number of missed ticks, minus the ticks that the machine itself lost."""
    return float(max(0, loop["missed"] - loop["lost_by_the_machine"]))


def _cycle_to_bare(loop: Results) -> tuple[float, ...]:
    """Return the duration of the service's cycle divided by that of the bare loop's cycle, at p50, p99 and p99.9."""
    return tuple(loop["to_bare"]["cycle"][:3])


def _to_canopen(deviations: Results) -> tuple[float, ...]:
    """Return the ratios of trirail's deviations to those of python-canopen with setpoints, p99 and p99.9."""
    ours, theirs = deviations["trirail, moving"], deviations["python-canopen, SCHED_FIFO, with setpoints"]
    return tuple(ours[k] / theirs[k] for k in (1, 2))


AIMS = (
    Aim(
        "SYNC's interval off its period to the machine's lateness spread, p99 / p99.9",
        "not measured",
        (1.2, 1.5),
        lambda results: tuple(results["peers"]["ratio"][1:3]),
    ),
    Aim(
        "SYNC's interval off its period to that of a bare compiled loop, p99 / p99.9",
        "not measured",
        (1.2, 1.5),
        lambda results: tuple(results["peers"]["ratio_to_bare"][1:3]),
    ),
    Aim(
        "SYNC's interval off its period to python-canopen's with setpoints, p99 / p99.9",
        "not measured",
        (1.0, 1.0),
        lambda results: _to_canopen(results["peers"]["deviation_us"]),
    ),
    Aim(
        "memory [MB]; up [s], of processor [s]",
        "915; 5; 6 to 9",
        (260.0, 2.5, 3.0),
        lambda results: tuple(results["start"][what] for what in ("megabytes", "up", "processor")),
    ),
    Aim(
        "whole cycle with its decisions at 1 kHz to the bare loop, p50 / p99 / p99.9",
        "1.6 / 8.2",
        (1.6, 2.0, 3.0),
        _loop(1000, _cycle_to_bare),
    ),
    Aim(
        "the same at 2 kHz",
        "not measured",
        (1.6, 2.0, 3.0),
        _loop(2000, _cycle_to_bare),
    ),
    Aim(
        "SYNC to the last setpoint at 1 kHz, p99.9 [µs]",
        "p50 227",
        (150.0,),
        _loop(1000, lambda loop: (loop["to_setpoints"][2],)),
    ),
    Aim("ticks missed at 1 kHz beyond the machine's", "46", (0.0,), _loop(1000, lambda loop: (_missed(loop),))),
    Aim(
        "ticks missed at 2 kHz beyond the machine's, of 100,000",
        "3303",
        (10.0,),
        _loop(2000, lambda loop: (_missed(loop) * 100_000 / loop["cycles"],)),
    ),
    Aim(
        "lateness p99.9 to the machine's, the worst of the runs",
        "1.2 to 1.5",
        (1.2,),
        _loop(1000, lambda loop: (max(run["ratio"][2] for run in loop["runs"]),)),
    ),
    Aim(
        "goal to first changed setpoint, at rest, p99 [ms]",
        "9.0",
        (4.0,),
        lambda results: (results["latency"]["at_rest_ms"][1],),
    ),
    Aim(
        "goal to first changed setpoint, in motion, p99 [ms]",
        "7.8",
        (6.0,),
        lambda results: (results["latency"]["in_motion_ms"][1],),
    ),
    Aim(
        "answer under another's flood to quiet, p99 of goals / of stops",
        "3.8 / 2.8",
        (2.0, 2.0),
        lambda results: (results["fairness"]["goal_p99_ratio"], results["fairness"]["stop_p99_ratio"]),
    ),
    Aim(
        "outputs on the path: error of place to half a cycle's travel, the worst",
        "no outputs",
        (1.0,),
        lambda results: (max(at["marks_um"][3] / at["half_a_cycle_um"] for at in results["outputs"]["speeds"]),),
    ),
    Aim(
        "outputs on the path: time in a cycle, of 8 outputs less that of none, p99 [µs]",
        "no outputs",
        (3.0,),
        lambda results: (results["outputs"]["switch_us"][-1]["us"][1] - results["outputs"]["switch_us"][0]["us"][1],),
    ),
    Aim("frames of one cycle, p50 [µs]", "43", (10.0,), lambda results: (results["frames"]["socket_us"]["p50"],)),
)


def table(results: Results) -> list[dict[str, Any]]:
    """Return a row for each aim that was measured, with the results and whether the aim is met."""
    rows = []
    for aim in AIMS:
        try:
            measured = aim.measured(results)
        except (KeyError, StopIteration):
            continue
        met = bool(measured) and all(value <= limit for value, limit in zip(measured, aim.aim, strict=True))
        rows.append({"name": aim.name, "before": aim.before, "measured": measured, "aim": aim.aim, "met": met})
    return rows


def measure(brief: bool) -> Results:
    """Run each benchmark in a separate process; return the results, the names of those that failed, and the table."""
    program = str(Path(__file__).with_name("bench.py"))
    results: Results = {}
    failed = []
    for name, options in COMMANDS.items():
        print(f"{name} …", file=sys.stderr, flush=True)
        arguments = BRIEF.get(name, ()) if brief else options
        command = [sys.executable, program, name, "--json", *arguments]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
        if done.returncode == 0:
            results[name] = json_format.loads(done.stdout)
        else:
            failed.append(name)
    return {**results, "failed": failed, "aims": table(results)}


def main(brief: bool, json: bool = False) -> None:
    """Run all benchmarks and print the table, or all results as one JSON object. Exit with code 1 if one failed."""
    results = measure(brief)
    if json:
        print(json_format.dumps(results))
    else:
        _show(results)
    if results["failed"]:
        raise SystemExit(f"failed: {', '.join(results['failed'])}")


def _show(results: Results) -> None:
    if "peers" in results:
        _show_sync(results["peers"])
    print(f"{'':80}{'before':>26}{'measured':>26}{'aim':>20}   met")
    for row in results["aims"]:
        measured, aim = (" / ".join(f"{value:.4g}" for value in row[key]) or "not kept" for key in ("measured", "aim"))
        print(f"{row['name']:80}{row['before']:>26}{measured:>26}{aim:>20}   {'yes' if row['met'] else 'NO'}")
    for loop in results.get("loop", {}).get("rates", ()):
        if "to_bare" in loop:
            for other, words in (("to_bare", "loop's"), ("to_bare_beside_busy", "loop's beside a busy processor")):
                times = " / ".join(f"{value:.1f}" for value in loop[other]["cycle"][:3])
                print(f"whole cycle at {loop['rate_hz']} Hz to the bare {words}, p50 / p99 / p99.9: {times} times")
        else:
            print(f"{loop['rate_hz']} Hz are not kept here: {loop['not_kept']}")


def _show_sync(peers: Results) -> None:
    """Print the table of SYNC's intervals."""
    title = f"SYNC at {peers['rate_hz']} Hz, interval off its period [µs]"
    print(f"{title:50}{'p50':>8}{'p99':>8}{'p99.9':>8}{'worst':>8}")
    machine = {f"the machine's lateness spread, {when}": values for when, values in peers["machine_us"].items()}
    for name, values in {**machine, **peers["deviation_us"]}.items():
        print(f"{name:50}" + "".join(f"{value:8.0f}" for value in values))
    if peers["linuxcnc"]:
        print(f"LinuxCNC's servo thread: {peers['linuxcnc']}")
    print()
