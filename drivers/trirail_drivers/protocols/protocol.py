"""What a protocol brings: its driver, the checks of its settings, its traffic, and its simulated drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import can

from trirail_drivers import config
from trirail_drivers.bus.load import Traffic
from trirail_drivers.cia402.backup import Restored
from trirail_drivers.cia402.parameter_file import Saved
from trirail_drivers.driver.requirements import Requirements, Rule
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.simulated import Frames, SimulatedDevice


@dataclass(frozen=True, slots=True)
class Protocol:
    """All that is known of a protocol outside its own modules."""

    name: str
    """As `drives.protocol` of the configuration names it."""
    driver: Callable[[can.BusABC, int, config.Drives, Clock], DriveGroup]
    """Makes the driver of three drives, from the bus, its bitrate, section [drives] and the clock."""
    rules: Callable[[config.Drives, Requirements], Iterator[Rule]]
    """Yields what refuses settings that the drives could not carry out."""
    files: Callable[[config.Drives], Iterator[Rule]]
    """Yields what refuses files that the settings name, by reading them."""
    traffic: Traffic
    """What drives and service put on the bus."""
    simulated_drive: Callable[[config.Simulated, config.Drives, config.Drive, float], SimulatedDevice]
    """Makes one simulated drive, its slider at rest at a position [m]."""
    inspect: Callable[..., list[dict[str, Any]]] | None
    """Tells what each drive is and what its set-up would change, from the bus, section [drives], the period [s],
    the clock and the sliders' limit of velocity [m/s], and whether to `apply` that; None where they tell nothing."""
    save: Callable[..., dict[str, Saved | DriveError]] | None
    """Reads the parameters of drives, from the bus, section [drives], the clock and the drives' names; None where they
    have no object dictionary."""
    restore: Callable[..., Restored] | None
    """Gives a drive its parameters back, from the same, its name and what was saved."""
    protections: Mapping[str, str]
    """What `accept_without` may name, and what each means, for people."""
    inputs: Callable[[can.BusABC, config.Drives, Clock], Callable[[str], int | None]] | None
    """Makes what reads the digital inputs of the drive of a name, as bits of object 60FDh; None where drives do not
    tell them."""
    states: Callable[[int], set[int]]
    """The identifiers of the frames in which the drive of a node id says what is now."""
    fault_frames: Mapping[str, Frames]
    """The frames that faults on demand can name."""
