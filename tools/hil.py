"""Hardware in the loop, without the hardware: the service on real SocketCAN, in an emulated machine.

python tools/hil.py               boots Debian's kernel in QEMU with two CAN cards on one bus; minutes
make hil                          the same, and installs what it needs where that is possible

Inside, tools/hil_guest.py runs the service on can0, virtual drives on can1 and a client; then pytest runs the tests
that are marked vcan. The frames on the bus are checked here, by tools/bus_log.py.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import bus_log

from service.config import Config, load

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
SEARCH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
CARD = "kernel/drivers/net/can/sja1000/kvaser_pci.ko"
"""The driver of the emulated cards, by which a kernel is known to be one that will do."""

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "modprobe": "kmod", "udevadm": "udev"}
PROGRAMS |= {"ip": "iproute2", "candump": "can-utils", "chrt": "util-linux", "mksquashfs": "squashfs-tools"}
"""Each program that is needed, and the package of Debian and Ubuntu that has it."""
KERNELS = {"debian": "linux-image-amd64", "ubuntu": "linux-image-generic"}
"""The package of a kernel with CAN and its drivers."""

CHANGES = {
    # The emulated processor is ten to twenty times slower than the real one.
    "rate_hz = 1000": "rate_hz = 20",
    "heartbeat = 0.1": "heartbeat = 1.0",
    "enable_timeout = 5.0": "enable_timeout = 30.0",
    # Feedback is one SYNC old and a setpoint one ahead: at 0.1 m/s and 20 Hz that alone is 10 mm.
    "following_error = 0.002 ": "following_error = 0.03 ",
    "following_error = 0.0025": "following_error = 0.04",
    "live_port = 9876": "live_port = 0",
}
"""What the machine's configuration has that differs from configs/socketcan.toml."""


PRECEDENCE = "-10"
"""Nice value of the machine's session, where this may be set."""


class Failed(Exception):
    """What is missing or wrong, with the remedy or the log that tells more."""


def main() -> int:
    """Run it; exit code 0 only if everything held."""
    parser = argparse.ArgumentParser(description="The service on real SocketCAN, in a machine that QEMU emulates.")
    parser.add_argument("--install", action="store_true", help="install missing Debian packages first (as root)")
    parser.add_argument("--timeout", type=float, default=900.0, help="of the whole run [s]; default 900")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where to leave the logs")
    parser.add_argument("--json", action="store_true", help="print one JSON object; progress goes to standard error")
    options = parser.parse_args()

    signal.signal(signal.SIGTERM, _interrupt)
    say = Progress(sys.stderr if options.json else sys.stdout)
    report: dict[str, Any] = {"ok": False, "checks": {}, "failure": None}
    folder: Path | None = None
    try:
        if options.install:
            install(say)
        kernel = requirements()
        folder = options.keep or Path(tempfile.mkdtemp(prefix="trirail-hil-"))
        folder.mkdir(parents=True, exist_ok=True)
        run(folder.resolve(), kernel, time.monotonic() + options.timeout, say, report)
        report["ok"] = True
    except Failed as failed:
        report["failure"] = str(failed)
    except KeyboardInterrupt:
        report["failure"] = "interrupted"
    if folder is not None:
        (folder / "python.img").unlink(missing_ok=True)  # a gigabyte
        if not options.keep and (report["ok"] or report["failure"] == "interrupted"):
            shutil.rmtree(folder)
    if options.json:
        print(json.dumps(report), flush=True)
    elif report["ok"]:
        say("everything held")
    if report["failure"]:
        print(f"hil: {report['failure']}", file=sys.stderr)
    return 0 if report["ok"] else 1


class Progress:
    """Prints lines with the time since the start."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._began = time.monotonic()

    def __call__(self, line: str) -> None:
        """Print a line."""
        print(f"{time.monotonic() - self._began:5.0f} s  {line}", file=self._stream, flush=True)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


# ---------------------------------------------------------------------- what it needs


def lacking() -> tuple[str, ...]:
    """The Debian packages that are missing on this machine."""
    packages = [package for program, package in PROGRAMS.items() if shutil.which(program, path=SEARCH) is None]
    if not kernels():
        packages.append(KERNELS.get(_distribution(), KERNELS["debian"]))
    return tuple(packages)


def kernels(boot: Path = Path("/boot"), modules: Path = Path("/lib/modules")) -> list[Path]:
    """Installed kernels that have the cards' driver and can be read, the newest last."""
    found = (
        image
        for image in boot.glob("vmlinuz-*")
        if os.access(image, os.R_OK) and any((modules / image.name.removeprefix("vmlinuz-")).glob(f"{CARD}*"))
    )
    return sorted(found, key=lambda image: [int(number) for number in re.findall(r"\d+", image.name)])


def requirements() -> Path:
    """The kernel to boot. Raises Failed with what to install."""
    if packages := lacking():
        raise Failed(f"missing here: apt-get install {' '.join(packages)} (Debian, Ubuntu); or, as root: make hil")
    if not (BIN / "vng").exists():
        raise Failed(f"missing here: {BIN}/python -m pip install --group hil (virtme-ng, which boots the kernel)")
    return kernels()[-1]


def install(say: Progress) -> None:
    """Install missing packages, as root where there is apt; else they are named by `requirements`."""
    packages = lacking()
    if not packages or os.geteuid() != 0 or shutil.which("apt-get") is None:
        return
    say(f"installing {' '.join(packages)}")
    for command in (("update",), ("install", "--yes", "--no-install-recommends", *packages)):
        done = subprocess.run(
            ("apt-get", "-q", *command),
            env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            raise Failed(f"apt-get {command[0]} failed:\n{_last(done.stdout + done.stderr)}")


def _distribution() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/etc/os-release").read_text().splitlines():
            if line.startswith("ID="):
                return line.removeprefix("ID=").strip('"')
    return ""


# ---------------------------------------------------------------------- the run


def run(folder: Path, kernel: Path, deadline: float, say: Progress, report: dict[str, Any]) -> None:
    """Boot, run both cases, check the frames. Raises Failed."""
    config = configure(folder)
    say("compiling the kinematics for the emulated processor")
    prepare(folder)
    packed = pack(folder)
    say(f"booting {kernel.name} in QEMU; logs are in {folder}")
    with machine(folder, kernel, packed) as lines:
        for line in _until(lines, deadline):
            say(line)
    result = _result(folder)
    report["checks"] |= result["checks"]
    if result["failure"]:
        raise Failed(f"{result['failure']}{_logs(folder, 'service', 'drives')}")
    code = (folder / "vcan.code").read_text().strip() if (folder / "vcan.code").exists() else "none"
    summary = _last((folder / "vcan.log").read_text(), 1) if (folder / "vcan.log").exists() else ""
    if code != "0" or "passed" not in summary:
        raise Failed(f"the tests marked vcan: exit code {code}{_logs(folder, 'vcan')}")
    say(f"tests marked vcan: {summary.strip()}")
    report["checks"]["vcan"] = summary.strip()
    report["loop"] = result["loop"]
    check_frames(folder, config, result, say, report)


def configure(folder: Path) -> Config:
    """Write the machine's configuration: configs/socketcan.toml with CHANGES."""
    text = (ROOT / "configs/socketcan.toml").read_text()
    memory = "/dev/shm"
    changes = CHANGES | {
        'listen = ["tcp/127.0.0.1:7447"]': f'listen = ["unixsock-stream/{memory}/zenoh"]',
        'directory = "recordings"': f'directory = "{memory}/recordings"',
        # A stalled host stalls the drives with the loop: that is no loss of SYNC.
        "[drives]\n": "[can.simulated]\nmissed_syncs = 40\n\n[drives]\nsdo_timeout = 10.0\n",
    }
    for before, after in changes.items():
        if text.count(before) != 1:
            raise Failed(f"configs/socketcan.toml: {before!r} is not there once; CHANGES of tools/hil.py needs it")
        text = text.replace(before, after)
    (folder / "robot.toml").write_text(text)
    return load(folder / "robot.toml")


PORTABLE = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Compiled code for any x86-64: the emulated processor has not what this one has, and compiles for minutes."""


def prepare(folder: Path) -> None:
    """Compile the kinematics here, for the machine to load."""
    done = subprocess.run(
        (sys.executable, "-c", "import service.loop, service.gateway, service.recording, service.client"),
        cwd=ROOT,
        env=os.environ | PORTABLE | {"NUMBA_CACHE_DIR": str(folder / "numba")},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise Failed(f"cannot compile the kinematics:\n{_last(done.stderr)}")


def pack(folder: Path) -> tuple[Path, ...]:
    """Write what Python itself and its packages consist of into an image; return the folders that are in it.

    Our own modules stay on the host: numba takes compiled code for old where a file's time differs, and an image
    keeps whole seconds.
    """
    library, packages = (Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib"))
    done = subprocess.run(
        (
            *("mksquashfs", library, packages, folder / "python.img"),
            *("-no-strip", "-noappend", "-no-progress", "-quiet", "-noI", "-noD", "-noF", "-noX"),
            *("-wildcards", "-e", str(library / "site-packages").lstrip("/"), *(f"... {name}" for name in UNUSED)),
        ),
        cwd=ROOT,
        env=os.environ | {"PATH": SEARCH},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise Failed(f"mksquashfs failed:\n{_last(done.stdout + done.stderr)}")
    return library, packages


UNUSED = ("test", "rerun_cli", "scipy", "scipy.libs", "matplotlib", "mypy", "*__mypyc.*", "fontTools", "sympy", "ruff")
"""Large folders and files of Python's that nothing in the machine imports."""


def script(folder: Path, packed: tuple[Path, ...]) -> str:
    """What the machine runs, as root."""
    # The tree that virtme-ng mounts asks the host for every file at every import, which takes a minute for the
    # service; an image, whose blocks stay in memory, takes a third of that.
    binds = "\n".join(f"mount --bind /run/python{path} {path}" for path in packed)
    return f"""set -e
echo 'the machine is up'
modprobe -a kvaser_pci can-raw vcan virtio_blk squashfs
mkdir /run/python
mount -t squashfs -o ro /dev/vda /run/python
{binds}
cd {ROOT}
export PATH={BIN}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PYTHONDONTWRITEBYTECODE=1 TMPDIR=/dev/shm NUMBA_CACHE_DIR=/dev/shm/numba
export {" ".join(f"{name}='{value}'" for name, value in PORTABLE.items())}
cp -r {folder}/numba /dev/shm/numba
for interface in can0 can1; do
    ip link set $interface txqueuelen 100
    ip link set $interface up type can bitrate 1000000
done
set +e
{sys.executable} tools/hil_guest.py {folder}
{sys.executable} -m pytest -m vcan -rA --tb=short tests/test_socketcan.py 2>&1 | tee {folder}/vcan.log
echo ${{PIPESTATUS[0]}} > {folder}/vcan.code
"""


@contextlib.contextmanager
def machine(folder: Path, kernel: Path, packed: tuple[Path, ...]) -> Iterator[queue.Queue[str | None]]:
    """Boot the machine; give the lines that it prints, None at its end. It is gone when the context is left."""
    (folder / "machine.sh").write_text(script(folder, packed))
    devices = (
        f"-drive file={folder}/python.img,format=raw,if=virtio,readonly=on",
        "-cpu Nehalem",  # what Python's packages need and no more: emulating AVX halves the speed
        "-object can-bus,id=bus -device kvaser_pci,canbus=bus -device kvaser_pci,canbus=bus",
    )
    command = [
        *(str(BIN / "vng"), "--run", str(kernel), "--user", "root", "--cpus", "2", "--memory", "2G"),
        # Emulated on purpose: the same everywhere, also where KVM is not to be had or hangs.
        *("--disable-kvm", "--disable-microvm", "--force-9p", "--force-initramfs"),
        *("--append", "mitigations=off", "--rwdir", str(folder), f"--qemu-opts={' '.join(devices)}"),
        *("--", f"bash {folder}/machine.sh"),
    ]
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # so that all of it can be ended: virtme-ng, its shell, QEMU
        env=os.environ | {"PATH": f"{BIN}:{SEARCH}"},
    )
    # The machine keeps real time: as root it goes before what else runs here. Linux shares the processors out
    # among sessions first, and only then among the processes of one: sched(7), the autogroup feature.
    with contextlib.suppress(OSError):
        Path(f"/proc/{process.pid}/autogroup").write_text(PRECEDENCE)
    lines: queue.Queue[str | None] = queue.Queue()
    reader = threading.Thread(target=_read, args=(process, lines), daemon=True)
    reader.start()
    try:
        yield lines
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # an emulated machine has nothing to save
        process.wait()
        reader.join()


def _read(process: subprocess.Popen[bytes], lines: queue.Queue[str | None]) -> None:
    if process.stdout is not None:
        with process.stdout:
            for line in process.stdout:
                lines.put(line.decode(errors="replace").rstrip())
    lines.put(None)


def _until(lines: queue.Queue[str | None], deadline: float) -> Iterator[str]:
    """Yield the machine's lines until it ends. Raises Failed at the deadline."""
    last = "nothing"
    while True:
        try:
            line = lines.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise Failed(f"the time limit is over (--timeout); the last that was heard: {last}") from None
        if line is None:
            return
        if line:
            last = line
            yield line


def _result(folder: Path) -> dict[str, Any]:
    try:
        return json.loads((folder / "result.json").read_text())  # type: ignore[no-any-return]
    except FileNotFoundError:
        raise Failed(f"the machine ended without a result{_logs(folder, 'service', 'drives')}") from None


def check_frames(folder: Path, config: Config, result: dict[str, Any], say: Progress, report: dict[str, Any]) -> None:
    """Check the frames that candump saw on can1, and those that the service says it sent and heard."""
    frames = bus_log.read(folder / "bus.log")
    own = bus_log.read(folder / "service-frames.log")
    until, missed = result["cut"], result["loop"]["overruns"]
    problems = bus_log.problems(frames, config, missed, until) + bus_log.differences(own, frames, until)
    if problems:
        raise Failed("the frames on the bus are wrong:\n  " + "\n  ".join(problems[:10]) + f"\nsee {folder}/bus.log")
    report["frames"] = bus_log.statistics(frames, config, until)
    for name, words in bus_log.HELD.items():
        report["checks"][name] = words
        say(f"frames: {words}")
    say(f"frames: {json.dumps(report['frames'])}")


def _last(text: str, lines: int = 30) -> str:
    return "\n".join(text.splitlines()[-lines:])


def _logs(folder: Path, *names: str) -> str:
    """The ends of some logs, for people."""
    found = ((name, folder / f"{name}.log") for name in names)
    return "".join(
        f"\n--- {name}.log\n{_last(path.read_text(errors='replace'))}" for name, path in found if path.exists()
    )


if __name__ == "__main__":
    sys.exit(main())
