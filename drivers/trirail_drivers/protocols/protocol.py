"""Description of a protocol: its driver, the checks of its settings, its traffic and its simulated drive."""

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
    """Everything about a protocol that other packages use."""

    name: str
    """Name in `drives.protocol` of the configuration."""
    driver: Callable[..., DriveGroup]
    """Return the driver of three drives. Arguments: the bus, its bit rate, section [drives], the clock, a Reopening if
    a lost bus can be reopened, and the digital outputs and inputs of each drive.
    """
    rules: Callable[[config.Drives, Requirements], Iterator[Rule]]
    """Yield checks for settings that the drives cannot carry out."""
    files: Callable[[config.Drives], Iterator[Rule]]
    """Yield checks that read the files named in the settings."""
    traffic: Traffic
    """Bus traffic of the drives and the service."""
    simulated_drive: Callable[[config.Simulated, config.Drives, config.Drive, float], SimulatedDevice]
    """Return one simulated drive whose slider is at rest at a position [m]."""
    inspect: Callable[..., list[dict[str, Any]]] | None
    """Return a description of each drive and the changes of its set-up; None if drives cannot be inspected.

    Arguments: the bus, section [drives], the period [s], the clock, the velocity limit of the sliders [m/s], whether to
    `apply` the changes, and the digital outputs and inputs `io` of each drive.
    """
    save: Callable[..., dict[str, SavedParameters | DriveError]] | None
    """Read the parameters of drives; None if the drives have no object dictionary.

    Arguments: the bus, section [drives], the clock and the names of the drives.
    """
    restore: Callable[..., RestoreResult] | None
    """Restore the parameters of a drive, given the same arguments, its name and its saved parameters."""
    protections: Mapping[str, str]
    """Names that `accept_without` may contain, each with its description for people."""
    inputs: Callable[[can.BusABC, config.Drives, Clock], Callable[[str], int | None]] | None
    """Return a function that reads a drive's digital inputs, as bits of object 60FDh, given the drive's name; None if
    the drives do not report inputs.
    """
    without_io: str
    """Reason why the drives have no digital outputs and inputs in the cycle; "" if they have them."""
    states: Callable[[int], set[int]]
    """Return the identifiers of the state frames of a node."""
    fault_frames: Mapping[str, Frames]
    """Frames that faults on demand may name."""
