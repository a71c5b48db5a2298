"""Times of the service's cycle on this machine, measured by the process trirail.diagnosis.cycle_process."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trirail_drivers import files

from trirail.config import Config
from trirail.processes.forked_processes import describe_exit
from trirail.processes.operating_system import ONE_THREAD, python
from trirail.wire.state import Percentiles

_MODULE: Final = "trirail.diagnosis.cycle_process"


class Cycles(NamedTuple):
    """Measured times of n cycles."""

    lateness: NDArray[np.int64]
    """Delay of the start of each cycle, including the ticks missed before the cycle, (n,) [ns]."""
    work: NDArray[np.int64]
    """Time from the start of each cycle until its setpoints were sent, (n,) [ns]."""
    to_record: NDArray[np.int64]
    """Time from the start of each cycle until its record was written, (n,) [ns]."""
    period: int
    """Period of the cycle [ns]."""
    unanswered: int = 0
    """Number of SYNCs that the drives did not answer, counted per drive."""
    fault: str = ""
    """Fault of the robot at the end of the measurement, or ""."""

    @property
    def missed(self) -> NDArray[np.int64]:
        """Number of ticks missed before each cycle, (n,)."""
        return self.lateness // self.period


def measure(config: Config, seconds: float, progress: Callable[[float], None] | None = None) -> Cycles | str:
    """Run the service's cycle for `seconds` [s]; return its times, or the reason why it could not be measured.

    `progress` is called with the fraction of the cycles that has been completed.
    """
    ours, theirs = Pipe()
    try:
        with ours, theirs, files.temporary_folder() as folder, _start(theirs) as process:
            theirs.close()
            try:
                ours.send((config, folder, seconds))
                while isinstance(answer := ours.recv(), float):
                    if progress is not None:
                        progress(answer)
            except (EOFError, ConnectionError):
                return f"the process that runs the cycles has ended: {describe_exit(process.wait(), 0.0)}"
            finally:
                process.kill()  # the simulated drives end with it
    except OSError as error:
        return str(error)
    measured: Cycles | str = answer
    return measured


def _start(connection: Connection[Any, Any]) -> subprocess.Popen[bytes]:
    """Start the measuring process, in a session of its own, so that Ctrl-C interrupts only this process."""
    descriptor = connection.fileno()
    command = python("-m", _MODULE, str(descriptor))
    return subprocess.Popen(command, pass_fds=[descriptor], env=os.environ | ONE_THREAD, start_new_session=True)


def compute_percentiles(values: NDArray[Any]) -> Percentiles:
    """Return the percentiles [µs] of times [ns]."""
    return Percentiles(*(float(each) / 1e3 for each in np.percentile(values, (50.0, 99.0, 99.9, 100.0))))
