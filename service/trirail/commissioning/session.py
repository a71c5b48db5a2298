"""State of a commissioning on its bus: the drives that answer, their set-up, and the bench."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import can
from trirail_drivers.errors import DriveError
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import Carriages

from trirail.commissioning import drive_report
from trirail.commissioning.bench import Bench, DrivesStoppedError
from trirail.commissioning.judgement import Judgement
from trirail.commissioning.person import Operator
from trirail.commissioning.report import Number
from trirail.config import Config

SETUP_CHECK_S = 0.5
"""Time for which drives are observed after they are set up [s]."""
POLL_INTERVAL_S = 0.01
"""Interval between checks for an answer before the drives are set up [s]."""

StepOutcome = tuple[Judgement, dict[str, Number]]
"""Judgement of a step, and its measurements by name."""


class Environment(NamedTuple):
    """Everything that a commissioning needs from its surroundings."""

    config: Config
    bus: can.BusABC
    make_bench: Callable[[], Bench]
    """Function that configures the drives and starts their cycle."""
    rules: Carriages | None
    """Rules beside simulated sliders; None for real ones."""
    operator: Operator
    interrupted: Callable[[], bool]
    """Function that returns True once Ctrl-C was pressed."""
    inputs: Callable[[str], int | None] | None = None
    """Function that reads a drive's digital inputs (object 60FDh), or None if it has none; None without such a
    protocol."""
    press: Callable[[int, int], None] | None = None
    """Function that presses switches of a simulated drive, given its index and bits of 60FDh."""


class Session:
    """State that the steps share."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self._config = environment.config
        self._bench: Bench | None = None
        self._inspected: list[dict[str, object]] = []

    @property
    def reports_inputs(self) -> bool:
        """True if drives of this protocol report their digital inputs."""
        return self.environment.inputs is not None

    def inspect_bus(self) -> StepOutcome:
        """Read the identity of every drive."""
        drives = self._config.drives
        inspect = PROTOCOLS[drives.protocol].inspect
        if inspect is None:
            words = (f"drives of protocol {drives.protocol} have no objects to inspect; the next step finds them",)
            return Judgement("ok", words), {}
        fastest = self._config.limits.slider.fastest
        timing = self._config.period, time.monotonic, fastest
        self._inspected = inspect(self.environment.bus, drives, *timing, apply=False, io=self._config.drive_io)
        lines = tuple(
            line
            for each in self._inspected
            for line in drive_report.format_identity(each, self._config.geometry.labels)
        )
        refused = tuple(f"drive {each['name']}: {each['refused']}" for each in self._inspected if each["refused"])
        measured: dict[str, Number] = {}
        for each in self._inspected:
            for key in ("node", "device_type", "vendor", "product", "revision", "serial", "modes", "way"):
                if (value := each.get(key)) is not None:
                    measured[f"{each['name']}.{key}"] = value if isinstance(value, int | str) else str(value)
        if refused:
            remedy = (
                "if a drive does not answer, check supply, wiring, 60 Ω across the unpowered bus, bitrates, node ids; "
                "else follow the line above"
            )
            return Judgement("wrong", (*lines, *refused), remedy), measured
        return Judgement("ok", lines), measured

    def set_up(self) -> StepOutcome:
        """Configure all drives, without power, and start their cycle."""
        self._bench = None
        try:
            self._bench = self.environment.make_bench()
        except DriveError as error:
            return Judgement("failed", (str(error),), "follow the line above; no drive has power"), {}
        self._bench.wait(SETUP_CHECK_S)
        if (fault := self._bench.feedback.fault) is not None:
            try:
                self._bench.clear_fault()
            except DrivesStoppedError as error:
                return Judgement("failed", (str(error),), "remove the cause, then repeat this step"), {}
            return Judgement("ok", (f"a fault was reset: {fault.message}",)), {}
        written = sum(len(_changed_values(each)) for each in self._inspected)
        words = (f"set up, {written} values written, nothing stored; SYNC runs at {self._config.loop.rate_hz} Hz",)
        return Judgement("ok", words), {"written": written}

    def describe_setup(self) -> list[str]:
        """Return the changes made by the set-up as lines. A change that several drives share takes one line."""
        drives: dict[str, list[str]] = {}
        for each in self._inspected:
            for line in drive_report.format_differences(each, applied=False):
                drives.setdefault(line.strip().removeprefix("would be written: "), []).append(str(each["name"]))
        return [f"{', '.join(names)}: {line}" for line, names in drives.items()]

    def bench(self) -> Bench:
        """Return the bench. Raises RuntimeError before the set-up."""
        if self._bench is None:
            raise RuntimeError("the drives are not set up")
        return self._bench

    def idle(self) -> None:
        """Wait for a cycle, and keep the drives alive."""
        if self._bench is not None:
            self._bench.cycle()
        elif self.environment.interrupted():
            raise KeyboardInterrupt
        else:
            time.sleep(POLL_INTERVAL_S)


def _changed_values(drive: dict[str, object]) -> list[object]:
    changed = drive.get("differences")
    return changed if isinstance(changed, list) else []
