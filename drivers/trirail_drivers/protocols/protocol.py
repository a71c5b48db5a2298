"""Description of a protocol: its driver, checks of its settings, its traffic, its simulated drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import can

from trirail_drivers import config
from trirail_drivers.bus.load import Traffic
from trirail_drivers.cia402.backup import RestoreResult
from trirail_drivers.cia402.parameter_file import SavedParameters
from trirail_drivers.driver.requirements import Requirements, Rule
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.simulated import Frames, SimulatedDevice


@dataclass(frozen=True, slots=True)
class Protocol:
    """Everything that other rooms use of a protocol."""

    name: str
    """Name in `drives.protocol` of the configuration."""
    driver: Callable[..., DriveGroup]
    """Return the driver of three drives, from the bus, its bitrate, section [drives], the clock, a Reopening if a lost
    bus can be reopened, and the drives' digital I/O."""
    rules: Callable[[config.Drives, Requirements], Iterator[Rule]]
    """Yield checks for settings that the drives cannot carry out."""
    files: Callable[[config.Drives], Iterator[Rule]]
    """Yield checks that read the files that the settings name."""
    traffic: Traffic
    """Bus traffic of drives and service."""
    simulated_drive: Callable[..., SimulatedDevice]
    """Return one simulated drive, from [can.simulated], [drives], its own section, the position of its slider at rest
    [m], and its digital I/O."""
    inspect: Callable[..., list[dict[str, Any]]] | None
    """Return a description of each drive and the changes of its set-up, from the bus, section [drives], the period [s],
    the clock, the sliders' velocity limit [m/s], and whether to `apply` them; None if drives cannot be inspected."""
    save: Callable[..., dict[str, SavedParameters | DriveError]] | None
    """Read the parameters of drives, from the bus, section [drives], the clock and the drives' names; None if they have
    no object dictionary."""
    restore: Callable[..., RestoreResult] | None
    """Restore the parameters of a drive, from the same arguments, its name and its saved parameters."""
    protections: Mapping[str, str]
    """Names that `accept_without` may have, each with its description for people."""
    inputs: Callable[[can.BusABC, config.Drives, Clock], Callable[[str], int | None]] | None
    """Return a function that reads a drive's digital inputs by its name, as bits of object 60FDh; None if drives do not
    report them."""
    states: Callable[[int], set[int]]
    """Return the identifiers of the state frames of a node."""
    fault_frames: Mapping[str, Frames]
    """Frames that faults on demand can name."""
