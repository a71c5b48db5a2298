"""Hardware-in-the-loop test without hardware: the service on real SocketCAN, in an emulated machine.

python tools/hil.py               boots Debian's kernel in QEMU with two CAN cards on one bus; takes minutes
make hil                          the same, and installs missing packages if possible

In the machine, tools/hil_guest.py runs the service on can0, virtual drives on can1, and a client. Then it runs a second
service on vcan0 at another rate, with one drive that is homed and one third-party drive. Then pytest runs the tests
marked vcan. tools/hil_fd.py runs a service on vcan1 as a CAN FD bus. `--only` selects one of these. Outside the
machine, tools/bus_log.py and Wireshark's dissector check the frames.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bus_log
import hil_dissector
import hil_fd
import hil_second
from hil_dissector import Dissected
from hil_machine import IMAGE, ROOT, STEPS, begin_compiling, compiling, machine, output_lines, pack
from hil_needs import install, last, requirements
from hil_programs import Failed, changed
from interruption import interrupt_on_signals
from trirail.config import Config, load

CHANGES = {
    # The emulated processor is ten to twenty times slower than the host's.
    "rate_hz = 1000": "rate_hz = 20",
    "heartbeat = 0.1": "heartbeat = 1.0",
    "enable_timeout = 5.0": "enable_timeout = 30.0",
    # The feedback is one SYNC old, and the setpoint is one SYNC ahead: alone 10 mm at 0.1 m/s and 20 Hz.
    "following_error = 0.002 ": "following_error = 0.03 ",
    "following_error = 0.0025": "following_error = 0.04",
    "live_port = 9876": "live_port = 0",
    "[watchdogs]\n": "[watchdogs]\ngateway_timeout = 3.0\n",
}
"""Differences between the configuration of the emulated machine and configs/socketcan.toml."""
LOGS = ("service", "drives", "second-service", "second-drives", "foreign")
"""Names of the logs that are printed after a failed run."""
NOT_SHOWN = (
    "lateness, jitter and 1 kHz: the processor is emulated, ten to twenty times slower and without a clock of its own",
    "bit errors, arbitration, a bus that is full, error-passive and bus-off: the emulated cards delay nothing, and "
    "lose only what comes while the host stalls",
    "cable, terminators, bitrates that differ, transceivers, and the drivers of USB adapters: there is no wire",
    "what maker's firmware does beyond its dictionary, motors, brakes, power: every drive is a program",
)
"""Properties that an emulated machine cannot test."""


class Stalled(Failed):
    """A card lost frames, because its 64 bytes of memory were too small for the frames of a stall of the host."""


def main() -> int:
    """Run the test; return the exit code, which is 0 only if all checks passed."""
    parser = argparse.ArgumentParser(description="The service on real SocketCAN, in a machine that QEMU emulates.")
    parser.add_argument("--install", action="store_true", help="install missing Debian packages first (as root)")
    parser.add_argument("--timeout", type=float, default=2100.0, help="of the whole run [s]; default 2100")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where to leave the logs; new or empty")
    parser.add_argument("--only", choices=STEPS, help="run only one step: two robots, a robot on CAN FD, or the tests")
    parser.add_argument("--json", action="store_true", help="print one JSON object; progress goes to standard error")
    parser.add_argument("--prepare", action="store_true", help="only compile what runs in the machine")
    options = parser.parse_args()
    if options.keep and (options.keep.is_file() or any(options.keep.glob("*"))):
        parser.error(f"--keep {options.keep}: the folder is not empty, and earlier results could count as new ones")

    interrupt_on_signals()
    say = Progress(sys.stderr if options.json else sys.stdout)
    steps = STEPS if options.only is None else (options.only,)
    report: dict[str, Any] = {"ok": False, "checks": {}, "failure": None, "not_shown": NOT_SHOWN}
    folder: Path | None = None
    try:
        if options.install:
            install(say)
        if options.prepare:
            return begin_compiling(Path(os.devnull)).wait()
        kernel = requirements()
        folder = options.keep or Path(tempfile.mkdtemp(prefix="trirail-hil-"))
        folder.mkdir(parents=True, exist_ok=True)
        deadline = time.monotonic() + options.timeout
        try:
            run(folder.resolve(), kernel, deadline, say, report, steps)
        except Stalled as stalled:
            say(f"once more, for {stalled}")
            again = folder / "again"
            again.mkdir(exist_ok=True)
            run(again.resolve(), kernel, deadline, say, report, steps)
        report["ok"] = True
    except Failed as failed:
        report["failure"] = str(failed)
    except KeyboardInterrupt:
        report["failure"] = "interrupted"
    if folder is not None and not options.keep and (report["ok"] or report["failure"] == "interrupted"):
        shutil.rmtree(folder)
    if options.json:
        print(json.dumps(report), flush=True)
    elif report["ok"]:
        say("everything held")
        for words in NOT_SHOWN:
            say(f"not shown here: {words}")
    if report["failure"]:
        print(f"hil: {report['failure']}", file=sys.stderr)
    return 0 if report["ok"] else 1


class Progress:
    """Printer of lines with the time since the start."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._began = time.monotonic()

    def __call__(self, line: str) -> None:
        """Print a line."""
        print(f"{time.monotonic() - self._began:5.0f} s  {line}", file=self._stream, flush=True)


def run(
    folder: Path, kernel: Path, deadline: float, say: Progress, report: dict[str, Any], steps: Sequence[str]
) -> None:
    """Boot the machine, run these steps in it, and check the frames.

    Raises Failed, or Stalled if a second attempt may succeed.
    """
    config = configure(folder)
    say("compiling the kinematics for the emulated processor, beside what follows")
    with compiling(folder):
        try:
            packed = pack(folder)
            say(f"booting {kernel.name} in QEMU; logs are in {folder}")
            with machine(folder, kernel, packed, steps) as lines:
                for line in output_lines(lines, deadline):
                    say(line)
        finally:
            (folder / IMAGE).unlink(missing_ok=True)  # a gigabyte
    if "fd" in steps:
        try:
            report["fd"] = hil_fd.check(folder, load(folder / "fd.toml"))
        except Failed as failed:
            raise Failed(f"{failed}{_logs(folder, 'fd-service', 'fd-drives')}") from None
        report["checks"]["fd"] = hil_fd.HELD
        loop = report["fd"]["loop"]
        say(f"CAN FD: {hil_fd.HELD}; {loop['overruns']} ticks missed, {loop['cycles']} cycles")
        say(f"CAN FD: {json.dumps(report['fd'])}")
    if "tests" in steps:
        _judge_tests(folder, say, report)
    if "robots" in steps:
        _judge_robots(folder, config, say, report)


def _judge_robots(folder: Path, config: Config, say: Progress, report: dict[str, Any]) -> None:
    """Check what both robots did. Raises Failed, or Stalled if a second attempt may succeed."""
    result = _result(folder)
    report["checks"] |= result["checks"]
    report["lost"] = result["lost"]
    try:
        judge(folder, config, result, say, report)
    except Failed as failed:
        if any(result["lost"].values()):
            raise Stalled(f"the emulated cards had no room for frames, {result['lost']} times, and {failed}") from None
        raise


def judge(folder: Path, config: Config, result: dict[str, Any], say: Progress, report: dict[str, Any]) -> None:
    """Check the results from the machine. Raises Failed."""
    if result["failure"]:
        raise Failed(f"{result['failure']}{_logs(folder, *LOGS)}")
    report["loops"] = result["loops"]
    check_frames(folder, config, result, say, report)


def _judge_tests(folder: Path, say: Progress, report: dict[str, Any]) -> None:
    """Check the outcome of the tests marked vcan. Raises Failed."""
    code = (folder / "vcan.code").read_text().strip() if (folder / "vcan.code").exists() else "none"
    summary = last((folder / "vcan.log").read_text(), 1) if (folder / "vcan.log").exists() else ""
    if code != "0" or "passed" not in summary or "skipped" in summary:
        raise Failed(f"the tests marked vcan: exit code {code}{_logs(folder, 'vcan')}")
    say(f"tests marked vcan: {summary.strip()}")
    report["checks"]["vcan"] = summary.strip()
    price = _price(folder)
    say(f"a cycle's frames: {price['socket_us']['p50']:.0f} µs, by python-can {price['ratio']:.1f} times as much")
    report["price"] = price


def configure(folder: Path) -> Config:
    """Write the configurations of both robots; return that of the first robot.

    It is configs/socketcan.toml with CHANGES. The configuration of the second robot is derived from it.
    """
    text = (ROOT / "configs/socketcan.toml").read_text()
    memory = "/dev/shm"
    changes = CHANGES | {
        'listen = ["tcp/127.0.0.1:7447"]': f'listen = ["unixsock-stream/{memory}/zenoh"]',
        'directory = "recordings"': f'directory = "{memory}/recordings"',
        # A stall of the host delays the drives as well as the loop, so it must not count as a loss of SYNC.
        "[drives]\n": "[can.simulated]\nmissed_syncs = 40\n\n[drives]\nsdo_timeout = 10.0\n",
    }
    text = changed(text, changes)
    (folder / "robot.toml").write_text(text)
    (folder / "second.toml").write_text(hil_second.configure(text))
    (folder / "second.faults").write_text(hil_second.FAULTS)
    (folder / "fd.toml").write_text(hil_fd.configure(text))
    load(folder / "second.toml")
    load(folder / "fd.toml")
    return load(folder / "robot.toml")


def _result(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "result.json").read_text())  # type: ignore[no-any-return]
    except FileNotFoundError:
        raise Failed(f"the machine ended without a result{_logs(folder, *LOGS)}") from None


def _price(folder: Path) -> dict[str, Any]:
    """Return the results of `tools/bench.py frames` in the machine."""
    try:
        return json.loads((folder / "price.json").read_text())  # type: ignore[no-any-return]
    except (FileNotFoundError, json.JSONDecodeError):
        raise Failed(f"a cycle's frames could not be measured in the machine{_logs(folder, 'vcan')}") from None


def check_frames(folder: Path, config: Config, result: dict[str, Any], say: Progress, report: dict[str, Any]) -> None:
    """Check the frames that candump recorded on can1, and the service's own log of its frames. Raises Failed."""
    frames = bus_log.read(folder / "bus.log")
    own = bus_log.read(folder / "service-frames.log")
    until, missed = result["cut"], result["loops"][f"{config.loop.rate_hz} Hz"]["overruns"]
    dissected = hil_dissector.dissect(folder / "bus.log")
    problems = bus_log.problems(frames, config, missed, until) + bus_log.differences(own, frames, until)
    problems += hil_dissector.problems(dissected, until)
    if problems:
        raise Failed("the frames on the bus are wrong:\n  " + "\n  ".join(problems[:10]) + f"\nsee {folder}/bus.log")
    report["frames"] = bus_log.statistics(frames, config, until)
    report["dissected"] = hil_dissector.statistics(dissected)
    for name, words in (bus_log.HELD | {"dissector": hil_dissector.HELD}).items():
        report["checks"][name] = words
        say(f"frames: {words}")
    say(f"frames: {json.dumps(report['frames'])}")
    say(f"frames, as Wireshark sees them: {json.dumps(report['dissected'])}")
    _check_second(folder, result, say, report)


def _check_second(folder: Path, result: dict[str, Any], say: Progress, report: dict[str, Any]) -> None:
    """Check the second robot's SYNCs, and all its frames as decoded by Wireshark. Raises Failed."""
    config, until = load(folder / "second.toml"), result["second_cut"]
    path, missed = folder / "second-bus.log", result["loops"][f"{config.loop.rate_hz} Hz"]["overruns"]
    dissected = hil_dissector.dissect(path)
    problems = bus_log.sync_problems(bus_log.read(path), config.period, missed, until)
    problems += hil_dissector.problems(dissected, until)
    if problems:
        raise Failed("the second robot's frames are wrong:\n  " + "\n  ".join(problems[:10]) + f"\nsee {path}")
    _check_outputs(dissected, result["switches"], until, config, say, report)
    report["second_dissected"] = hil_dissector.statistics(dissected)
    say(f"the second robot's frames, as Wireshark sees them: {json.dumps(report['second_dissected'])}")


def _check_outputs(
    frames: Sequence[Dissected],
    table: Sequence[dict[str, Any]],
    until: float,
    config: Config,
    say: Progress,
    report: dict[str, Any],
) -> None:
    """Check the times at which a goal switched an output, in the frames decoded by Wireshark. Raises Failed.

    The drive must apply each switch at the next SYNC.
    """
    calm = [frame for frame in frames if frame.t < until]
    seen = hil_dissector.switches(calm, config.drives.C.node, hil_second.VALVE)
    cycles = [(row["cycle"], row["value"]) for row in table]
    if problem := hil_second.cycles_problem(cycles, [(each.sync, each.on) for each in seen]):
        raise Failed(f"the second robot's frames: {problem}")
    for row, each in zip(table, seen, strict=True):
        late = row["taken"] - each.next_sync
        if not 0.0 <= late < config.period:
            raise Failed(f"the drive has switched {late:.3f} s after the SYNC that took its frame, not at it")
    words = f"{len(seen)} switches of an output leave in their cycle, and are taken at the next SYNC"
    report["checks"]["switches"] = words
    say(f"frames: {words}")


def _logs(folder: Path, *names: str) -> str:
    """Return the last lines of some logs as text."""
    logs = ((name, folder / f"{name}.log") for name in names)
    return "".join(
        f"\n--- {name}.log\n{last(path.read_text(errors='replace'))}" for name, path in logs if path.exists()
    )


if __name__ == "__main__":
    sys.exit(main())
