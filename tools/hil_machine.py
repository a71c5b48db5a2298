"""Emulated machine: Debian's kernel in QEMU with two CAN cards on one bus, and Python with its packages."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from hil_needs import BIN, MODULES, SEARCH, busybox, last
from hil_programs import Failed

ROOT = Path(__file__).parents[1]
PRECEDENCE = "-10"
"""Nice value of the emulated machine's session, if a change is permitted."""
PORTABLE = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Settings of numba that make it compile for any x86-64, since the emulated processor lacks features of the host's. It
would also take minutes to compile itself.
"""

TESTS = ("tests/drivers/test_real_bus.py", "tests/drivers/test_frame_io.py", "tests/diagnosis/test_bus_timing.py")
"""Files with tests marked vcan."""

STEPS = "robots", "fd", "tests"
"""Steps in the machine: two robots on classical CAN, a robot on CAN FD, and the tests marked vcan."""

IMAGE = "python.img"
"""Name of the disk image with Python."""
COMPILED = "compiled"
"""Name of the file with the outcome of compiling. The machine waits for this file."""
CACHE = Path(sys.prefix) / "hil-numba"
"""Folder of the compiled code, which is also used in the next run: numba reuses code if the time and the size of its
source have not changed.
"""
COMPILE = """
import sys
from pathlib import Path
outcome = "failed"
try:
    from trirail.processes import gateway, loop_process, recording
    from trirail.client import client
    outcome = "well"
finally:
    Path(sys.argv[1]).write_text(outcome)
"""


def begin_compiling(outcome: Path, **streams: Any) -> subprocess.Popen[bytes]:
    """Start a process that compiles the kinematics for any x86-64 and writes "well" or "failed" to a file."""
    return subprocess.Popen(
        (sys.executable, "-P", "-c", COMPILE, outcome),
        cwd=ROOT,
        env=os.environ | PORTABLE | {"NUMBA_CACHE_DIR": str(CACHE)},
        stdin=subprocess.DEVNULL,
        **streams,
    )


@contextlib.contextmanager
def compiling(folder: Path) -> Iterator[None]:
    """Compile the kinematics on the host, in parallel with the context, so that the machine can load them.

    Raises Failed at the end of the context if compiling has failed.
    """
    with (folder / "compile.log").open("wb") as log:
        process = begin_compiling(folder / COMPILED, stdout=log, stderr=log)
    try:
        yield
    finally:
        outcome = process.poll()
        process.kill()  # if the machine has ended without waiting for it
        process.wait()
    if outcome:
        raise Failed(f"cannot compile the kinematics:\n{last((folder / 'compile.log').read_text())}")


def pack(folder: Path) -> tuple[Path, ...]:
    """Write the files of Python and its packages into a disk image; return the folders in the image.

    The modules of this project stay on the host: numba discards compiled code if the time of the source differs, and an
    image stores times only in whole seconds.
    """
    library, packages = (Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib"))
    done = subprocess.run(
        (
            *("mksquashfs", library, packages, folder / IMAGE),
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
        raise Failed(f"mksquashfs failed:\n{last(done.stdout + done.stderr)}")
    return library, packages


UNUSED = ("test", "rerun_cli", "scipy", "scipy.libs", "matplotlib", "mypy", "*__mypyc.*", "fontTools", "sympy", "ruff")
"""Large folders and files of Python that nothing in the machine imports."""


def can_interface(name: str) -> str:
    """Return the shell commands with which the shipped systemd unit brings a CAN interface up."""
    lines = (ROOT / "configs" / "trirail-can@.service").read_text(encoding="utf-8").replace("%i", name).splitlines()
    setting = next(line.removeprefix("Environment=") for line in lines if line.startswith("Environment="))
    commands = [line.removeprefix("ExecStart=") for line in lines if line.startswith("ExecStart=")]
    # A command with the prefix "-" may fail.
    return "\n".join([setting, *(f"{line[1:]} || true" if line.startswith("-") else line for line in commands)])


def script(folder: Path, packed: tuple[Path, ...], steps: Collection[str] = STEPS) -> str:
    """Return the shell script that the machine runs as root, with some of its STEPS."""
    commands = {
        "robots": f"{sys.executable} tools/hil_guest.py {folder}",
        "fd": f"{sys.executable} tools/hil_fd.py guest {folder} &  # beside the tests, which use another interface",
        # Hypothesis, which no test of these needs as a plug-in, alone takes a quarter of a minute to be loaded.
        "tests": f"""export PYTEST_DISABLE_PLUGIN_AUTOLOAD=1
options='-p pytest_timeout -p no:cacheprovider --noconftest -m vcan -rA --tb=short'
{sys.executable} -m pytest $options {" ".join(TESTS)} 2>&1 | tee {folder}/vcan.log
echo ${{PIPESTATUS[0]}} > {folder}/vcan.code
wait
{sys.executable} tools/bench.py frames --cycles 300 --json > {folder}/price.json""",
    }
    run = "\n".join(commands[step] for step in STEPS if step in steps)
    # The tree that virtme-ng mounts queries the host for every file at every import, which takes a minute for the
    # service. An image, whose blocks stay in memory, takes a third of that.
    binds = "\n".join(f"mount --bind /run/python{path} {path}" for path in packed)
    return f"""set -e
echo 'the machine is up'
modprobe -a {" ".join(Path(module).name for module in MODULES)}
mkdir /run/python
mount -t squashfs -o ro /dev/vda /run/python
{binds}
cd {ROOT}
export PATH={BIN}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PYTHONDONTWRITEBYTECODE=1 TMPDIR=/dev/shm NUMBA_CACHE_DIR=/dev/shm/numba
export {" ".join(f"{name}='{value}'" for name, value in PORTABLE.items())}
{can_interface("can0")}
{can_interface("can1")}
# Both cards interrupt one processor. With one processor each, the host may suspend that of can1 while can0 continues to
# send, until the 64 bytes of can1's buffer are full; on a busy host this happened 300 times in 3,600 frames.
for interrupt in $(awk '/can[01]$/ {{print $1 + 0}}' /proc/interrupts); do
    echo 1 > /proc/irq/$interrupt/smp_affinity
done
ip link add vcan0 type vcan
ip link set vcan0 up
ip link add vcan1 type vcan
ip link set vcan1 mtu 72 up
until [ -s {folder}/{COMPILED} ]; do sleep 0.2; done
grep -q well {folder}/{COMPILED}
cp -r {CACHE} /dev/shm/numba
set +e
{run}
wait
"""


@contextlib.contextmanager
def machine(
    folder: Path, kernel: Path, packed: tuple[Path, ...], steps: Collection[str] = STEPS
) -> Iterator[queue.Queue[str | None]]:
    """Boot the machine; yield the queue of the lines that it prints, which ends with None.

    The end of the context kills the machine.
    """
    (folder / "machine.sh").write_text(script(folder, packed, steps))
    devices = (
        f"-drive file={folder}/{IMAGE},format=raw,if=virtio,readonly=on",
        "-cpu Nehalem",  # the minimum for Python's packages: emulating AVX halves the speed
        "-object can-bus,id=bus -device kvaser_pci,canbus=bus -device kvaser_pci,canbus=bus",
    )
    command = [
        *(str(BIN / "vng"), "--run", str(kernel), "--user", "root", "--cpus", "2", "--memory", "2G"),
        # KVM is not used, so that the machine is the same everywhere, even if KVM is not available or hangs.
        *("--disable-kvm", "--disable-microvm", "--force-9p", "--force-initramfs"),
        *("--busybox", str(busybox())),  # otherwise vng uses the first of that name, which may need libraries
        *("--append", "mitigations=off", "--rwdir", str(folder), f"--qemu-opts={' '.join(devices)}"),
        *("--", f"bash {folder}/machine.sh"),
    ]
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,  # so that virtme-ng, its shell and QEMU can be killed together
        env=os.environ | {"PATH": f"{BIN}:{SEARCH}"},
    )
    # The machine needs real time, so as root it gets precedence over other programs. Linux divides processor time
    # among sessions first, and only then among the processes of one (sched(7), the autogroup feature).
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


def output_lines(lines: queue.Queue[str | None], deadline: float) -> Iterator[str]:
    """Yield the lines that the machine prints, until it ends. Raises Failed at the deadline."""
    newest = "nothing"
    while True:
        try:
            line = lines.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise Failed(f"time limit exceeded (--timeout); last output: {newest}") from None
        if line is None:
            return
        if line:
            newest = line
            yield line
