"""One commissioning on its bus: who is there, the drives' set-up, and the bench that comes of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import can
from trirail_drivers.errors import DriveError
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.simulated import Carriages

from trirail.commissioning import drives_told
from trirail.commissioning.bench import Bench, Stopped
from trirail.commissioning.judgement import Judged
from trirail.commissioning.person import Person
from trirail.commissioning.report import Number
from trirail.config import Config

SETTLED = 0.5
"""How long drives are looked at that have just been set up [s]."""
IDLE = 0.01
"""How often it is looked for an answer while no drive has been set up [s]."""

Done = tuple[Judged, dict[str, Number]]
"""What is to be thought of a step, and what was measured in it."""


class Place(NamedTuple):
    """Where all this happens."""

    config: Config
    bus: can.BusABC
    make_bench: Callable[[], Bench]
    """Sets the drives up and begins their cycle."""
    rules: Carriages | None
    """Where the sliders really are, of simulated drives."""
    person: Person
    interrupted: Callable[[], bool]
    """Tells of Ctrl-C."""
    inputs: Callable[[str], int | None] | None = None
    """Reads a drive's digital inputs, object 60FDh: None where it has none to tell; None for drives without."""
    press: Callable[[int, int], None] | None = None
    """Presses switches of a simulated drive: its index, and bits of 60FDh."""


class Session:
    """Holds what is kept from step to step."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self._config = place.config
        self._bench: Bench | None = None
        self._told: list[dict[str, object]] = []

    @property
    def tells_inputs(self) -> bool:
        """Whether drives of this protocol tell which of their switches are pressed."""
        return self.place.inputs is not None

    def bus(self) -> Done:
        """Ask every drive who it is."""
        drives = self._config.drives
        inspect = PROTOCOLS[drives.protocol].inspect
        if inspect is None:
            words = (f"drives of protocol {drives.protocol} have no objects to be shown; the next step finds them",)
            return Judged("ok", words), {}
        fastest = self._config.limits.slider.fastest
        self._told = inspect(self.place.bus, drives, self._config.period, time.monotonic, fastest, apply=False)
        lines = tuple(line for each in self._told for line in drives_told.identity(each, self._config.geometry.labels))
        refused = tuple(f"drive {each['name']}: {each['refused']}" for each in self._told if each["refused"])
        measured: dict[str, Number] = {}
        for each in self._told:
            for key in ("node", "device_type", "vendor", "product", "revision", "serial", "modes", "way"):
                if (value := each.get(key)) is not None:
                    measured[f"{each['name']}.{key}"] = value if isinstance(value, int | str) else str(value)
        if refused:
            remedy = (
                "no answer: supply, wiring, 60 Ω across the unpowered bus, the same bitrate everywhere, node ids; "
                "else what the line says"
            )
            return Judged("wrong", (*lines, *refused), remedy), measured
        return Judged("ok", lines), measured

    def set_up(self) -> Done:
        """Set all drives up, without power, and begin their cycle."""
        self._bench = None
        try:
            self._bench = self.place.make_bench()
        except DriveError as error:
            return Judged("failed", (str(error),), "what the line says; no drive has power"), {}
        self._bench.wait(SETTLED)
        if (fault := self._bench.feedback.fault) is not None:
            try:
                self._bench.clear()
            except Stopped as stopped:
                return Judged("failed", (str(stopped),), "remove the cause, then repeat this step"), {}
            return Judged("ok", (f"was in fault, and could be reset: {fault.message}",)), {}
        written = sum(len(_differences(each)) for each in self._told)
        words = (f"set up, {written} values written, nothing stored; SYNC runs at {self._config.loop.rate_hz} Hz",)
        return Judged("ok", words), {"written": written}

    def changes_of_set_up(self) -> list[str]:
        """Return what the set-up would change, as lines: what is so of several drives once."""
        of: dict[str, list[str]] = {}
        for each in self._told:
            for line in drives_told.differences(each, applied=False):
                of.setdefault(line.strip().removeprefix("would be written: "), []).append(str(each["name"]))
        return [f"{', '.join(names)}: {line}" for line, names in of.items()]

    def bench(self) -> Bench:
        """Return the bench, once the drives have been set up."""
        if self._bench is None:
            raise RuntimeError("the drives have not been set up")
        return self._bench

    def idle(self) -> None:
        """Wait a little, and keep the drives alive."""
        if self._bench is not None:
            self._bench.cycle()
        elif self.place.interrupted():
            raise KeyboardInterrupt
        else:
            time.sleep(IDLE)


def _differences(told: dict[str, object]) -> list[object]:
    found = told.get("differences")
    return found if isinstance(found, list) else []
