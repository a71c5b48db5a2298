"""State of a commissioning that all steps share: the inspected drives, and the bench that runs their cycle."""

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
"""Interval between checks for the person's answer before the drives are set up [s]."""

StepOutcome = tuple[Judgement, dict[str, Number]]
"""Judgement of a step, and the measured values by name."""


class Environment(NamedTuple):
    """Objects and functions that a commissioning uses: configuration, bus, drives and person."""

    config: Config
    bus: can.BusABC
    make_bench: Callable[[], Bench]
    """Function that configures the drives and returns a bench for their cycle."""
    rules: Carriages | None
    """Rules at simulated sliders; None if the sliders are real."""
    operator: Operator
    interrupted: Callable[[], bool]
    """Function that returns True after Ctrl-C was pressed."""
    inputs: Callable[[str], int | None] | None = None
    """Function that returns the digital inputs (object 60FDh) of a drive, or None if the drive does not report them.
    None if the protocol of the drives has no digital inputs."""
    press: Callable[[int, int], None] | None = None
    """Function that presses switches of a simulated drive, given the drive's index and bits of 60FDh. None if the
    drives are real."""


class Session:
    """State of a commissioning that the steps share."""

    def __init__(self, environment: Environment) -> None:
        self.environment = environment
        self._config = environment.config
        self._bench: Bench | None = None
        self._inspected: list[dict[str, object]] = []

    @property
    def reports_inputs(self) -> bool:
        """True if the protocol of the drives can report digital inputs."""
        return self.environment.inputs is not None

    def inspect_bus(self) -> StepOutcome:
        """Run the step that reads the identity of every drive and writes nothing."""
        drives = self._config.drives
        inspect = PROTOCOLS[drives.protocol].inspect
        if inspect is None:
            words = (f"drives of protocol {drives.protocol} have no objects to inspect; the next step finds them",)
            return Judgement("ok", words), {}
        slider = self._config.limits.slider
        cycle = self._config.period, time.monotonic, slider.fastest
        bus, io, timing = self.environment.bus, self._config.drive_io, self._config.can.timing
        try:
            self._inspected = inspect(bus, drives, *cycle, apply=False, io=io, timing=timing, travel=slider.positions)
        except DriveError as error:
            return Judgement("failed", (str(error),), "follow the line above, then repeat this step"), {}
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
        """Run the step that configures all drives, without power, and starts their cycle."""
        self._bench = None
        try:
            self._bench = self.environment.make_bench()
        except DriveError as error:
            return Judgement("failed", (str(error),), "follow the line above"), {}
        self._bench.wait(SETUP_CHECK_S)
        if (fault := self._bench.feedback.fault) is not None:
            try:
                self._bench.clear_fault()
            except DrivesStoppedError as error:
                return Judgement("failed", (str(error),), "remove the cause, then repeat this step"), {}
            return Judgement("ok", (f"a fault was reset: {fault.message}",)), {}
        differed = sum(len(_changed_values(each)) for each in self._inspected)
        words = (
            f"set up, nothing stored; {differed} values differed when the bus was read; "
            f"SYNC runs at {self._config.loop.rate_hz} Hz",
        )
        return Judgement("ok", words), {"differed": differed}

    def describe_setup(self) -> list[str]:
        """Return lines with the changes that the set-up will make, with one line for a change that drives share."""
        drives: dict[str, list[str]] = {}
        for each in self._inspected:
            for line in drive_report.format_differences(each, applied=False):
                drives.setdefault(line.strip().removeprefix("would be written: "), []).append(str(each["name"]))
        return [f"{', '.join(names)}: {line}" for line, names in drives.items()]

    def bench(self) -> Bench:
        """Return the bench. Raises RuntimeError if the drives have not been set up."""
        if self._bench is None:
            raise RuntimeError("the drives are not set up")
        return self._bench

    def warn_of_power(self, judgement: Judgement) -> Judgement:
        """Return the judgement of a step that has ended, with a warning and not as ok if a drive still has power."""
        warning = self.power_warning
        if not warning or any(warning in word for word in judgement.words):
            return judgement
        verdict = "failed" if judgement.verdict == "ok" else judgement.verdict
        return judgement._replace(verdict=verdict, words=(*judgement.words, warning))

    @property
    def power_warning(self) -> str:
        """Warning that names the drives that have power between two steps; "" if no drive has power."""
        return "" if self._bench is None else self._bench.power_warning

    def idle(self) -> None:
        """Run one cycle of the drives, or wait for a short time if the drives have not been set up.

        Raises KeyboardInterrupt if Ctrl-C was pressed.
        """
        if self._bench is not None:
            self._bench.cycle()
        elif self.environment.interrupted():
            raise KeyboardInterrupt
        else:
            time.sleep(POLL_INTERVAL_S)


def _changed_values(drive: dict[str, object]) -> list[object]:
    changed = drive.get("differences")
    return changed if isinstance(changed, list) else []
