"""Intervals of LinuxCNC's servo thread, which runs no other function than the one that measures the interval.

The thread is created by `halrun` of Debian's package linuxcnc-uspace. LinuxCNC runs it with real-time priority only on
a kernel that it recognises as real-time. The benchmark therefore gives the thread the priority and the processor of
trirail's loop itself, so that both are compared under the same conditions. The thread drives no drives.
"""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

INSTALLED = shutil.which("halrun") is not None and shutil.which("halsampler") is not None
"""Whether LinuxCNC is installed."""
_SETTLE = 1.0
"""Duration from the priority change until the intervals count [s]."""
_START_TIMEOUT = 30.0
"""Maximum time that LinuxCNC may take in addition to the measurement [s]."""
_HAL = """\
loadrt threads name1=servo period1={period_ns}
loadrt timedelta
loadrt sampler depth=8000 cfg=s
addf timedelta.0 servo
net interval timedelta.0.out => sampler.0.pin.0
addf sampler.0 servo
start
loadusr -w halsampler -n {number} {samples}
"""


def intervals(seconds: float, rate_hz: int, priority: int) -> NDArray[np.float64]:
    """Run the servo thread for `seconds`, and return its intervals, (n,) [s].

    Raises RuntimeError if LinuxCNC does not start.
    """
    number = round((seconds + _SETTLE) * rate_hz)
    with tempfile.TemporaryDirectory(prefix="trirail-") as name:
        folder = Path(name)
        folder.chmod(0o777)  # LinuxCNC gives up root's rights
        samples = folder / "samples"
        script = _HAL.format(period_ns=1_000_000_000 // rate_hz, number=number, samples=samples)
        (folder / "servo.hal").write_text(script, encoding="utf-8")
        nobody = str(pwd.getpwnam("nobody").pw_uid)
        environment = {**os.environ, "RTAPI_UID": nobody, "RTAPI_FIFO_PATH": str(folder / "fifo")}
        halrun = subprocess.Popen(
            ["halrun", "-f", str(folder / "servo.hal")],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        try:
            _raise_priority(halrun, str(folder), priority)
            output, _ = halrun.communicate(timeout=seconds + _SETTLE + _START_TIMEOUT)
        finally:
            if halrun.poll() is None:
                halrun.terminate()
                halrun.communicate()
        if halrun.returncode or not samples.exists():
            raise RuntimeError(f"LinuxCNC did not run: {output.decode(errors='replace').strip()}")
        measured = [int(line) for line in samples.read_text(encoding="utf-8").split() if line.isdigit()]
    return np.array(measured[-round(seconds * rate_hz) :], float) / 1e9


def _raise_priority(halrun: subprocess.Popen[bytes], folder: str, priority: int) -> None:
    """Give the servo thread of the `rtapi_app` that uses `folder` a real-time priority and the last processor."""
    end = time.monotonic() + _START_TIMEOUT
    while halrun.poll() is None and time.monotonic() < end:
        for thread in _servo_threads(folder):
            os.sched_setaffinity(thread, {max(os.sched_getaffinity(0))})
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
            return
        time.sleep(0.01)


def _servo_threads(folder: str) -> list[int]:
    """Return the servo threads of all `rtapi_app` processes whose environment names `folder`."""
    threads = []
    for task in Path("/proc").glob("[0-9]*/task/[0-9]*"):
        try:
            named = (task / "comm").read_text().startswith("rtapi_app:T")
            if named and folder.encode() in (task.parent.parent / "environ").read_bytes():
                threads.append(int(task.name))
        except OSError:  # the process has ended
            continue
    return threads
