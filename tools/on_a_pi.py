"""Measure trirail on this machine, such as a Raspberry Pi, in ten minutes, and print a block for a report.

python tools/on_a_pi.py > report.md     as root, so that the loop gets its real-time rights; stop other programs first
python tools/on_a_pi.py --brief         a minute, to try it

The block contains the machine, the findings of `trirail doctor`, the intervals of SYNC at simulated drives beside those
of python-canopen and the machine's own wake-ups, and the timing of the loop. Nothing is sent anywhere.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

TOOLS = Path(__file__).parent
PACKAGES = ("trirail", "ruckig", "numba", "numpy", "eclipse-zenoh", "python-can")
COMMANDS = {
    "doctor": (("-m", "trirail", "doctor", "--json"), ("--quick",)),
    "peers": ((str(TOOLS / "bench.py"), "peers", "--json"), ("--seconds", "1")),
    "loop": ((str(TOOLS / "bench.py"), "loop", "--rates", "1000", "--runs", "1", "--json"), ("--seconds", "2")),
}
"""Arguments of Python for each measurement, and options for a brief one."""
FULL = {"peers": ("--seconds", "60"), "loop": ("--seconds", "60")}
"""Options for the full measurement."""


def main() -> int:
    """Measure, print the block, and return 1 if a measurement failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--brief", action="store_true", help="measure for seconds only, to try it")
    brief = parser.parse_args().brief
    results: dict[str, Any] = {}
    for name, (arguments, options) in COMMANDS.items():
        print(f"{name} …", file=sys.stderr, flush=True)
        command = [sys.executable, *arguments, *(options if brief else FULL.get(name, ()))]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        try:
            results[name] = json.loads(done.stdout)
        except ValueError:
            results[name] = None
    print("\n".join(block(results, brief=brief)))
    return int(None in results.values())


def block(results: dict[str, Any], *, brief: bool) -> Iterator[str]:
    """Yield the lines of the report in Markdown; a measurement that is None has failed."""
    yield f"### trirail on {machine()}{', brief: not for comparison' if brief else ''}"
    yield ""
    yield f"- {platform.system()} {platform.release()}, {os.cpu_count()} processors, governor {governor()}"
    yield f"- Python {platform.python_version()}, " + ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    for check in (results.get("doctor") or {}).get("checks", ()):
        if check["verdict"] != "ok" or check["name"] == "cycle":
            yield f"- {check['name']}: {check['verdict']}, {check['found']}"
    yield ""
    yield "| [µs] | p50 | p99 | p99.9 | worst |"
    yield "|---|---|---|---|---|"
    yield from _rows(results)
    yield ""
    loop = ((results.get("loop") or {}).get("rates") or [{}])[0]
    if "missed" in loop:
        lost = loop["lost_by_the_machine"]
        yield f"Of {loop['cycles']} cycles {loop['missed']} ticks were missed; the machine itself lost {lost}."
    if "not_kept" in loop:
        yield f"The loop did not keep {loop['rate_hz']} Hz: {loop['not_kept']}."
    for name, result in results.items():
        if result is None:
            yield f"{name}: failed, see the messages above."


def _rows(results: dict[str, Any]) -> Iterator[str]:
    """Yield the rows of the table."""
    if peers := results.get("peers"):
        for when, values in peers["machine_us"].items():
            yield _row(f"the machine's lateness spread, {when}", values)
        for name, values in peers["deviation_us"].items():
            yield _row(f"SYNC's interval off 1 ms: {name}", values)
    loop = ((results.get("loop") or {}).get("rates") or [{}])[0]
    for key, name in (("lateness", "loop: lateness"), ("to_setpoints", "loop: SYNC to the last setpoint")):
        if key in loop:
            yield _row(name, loop[key])


def _row(name: str, values: list[float]) -> str:
    return f"| {name} | " + " | ".join(f"{value:.0f}" for value in values) + " |"


def machine() -> str:
    """Return the model of the machine."""
    model = Path("/proc/device-tree/model")
    if model.is_file():
        return model.read_text(encoding="utf-8").strip("\0\n")
    return f"{platform.machine()}, {platform.processor() or 'unknown processor'}"


def governor() -> str:
    """Return the frequency governor of the first processor."""
    path = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    return path.read_text(encoding="utf-8").strip() if path.is_file() else "unknown"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"


if __name__ == "__main__":
    sys.exit(main())
