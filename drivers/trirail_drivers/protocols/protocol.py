"""Description of a protocol: its driver, the checks of its settings, its traffic and its simulated drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import can

from trirail_drivers import config
from trirail_drivers.bus.load import Traffic, TrafficPlan
from trirail_drivers.cia402.backup import RestoreResult
from trirail_drivers.cia402.parameter_file import SavedParameters
from trirail_drivers.driver.requirements import Requirements, Rule
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import Clock, DriveGroup
from trirail_drivers.simulated import Frames, SimulatedDevice
from trirail_drivers.timing import BusTiming


@dataclass(frozen=True, slots=True)
class Protocol:
    """Everything about a protocol that other packages use."""

    name: str
    """Name in `drives.protocol` of the configuration."""
    driver: Callable[..., DriveGroup]
    """Function that returns the driver of three drives. Arguments: the bus, its BusTiming, section [drives], the clock,
    a Reopening if a lost bus can be reopened, and the digital outputs and inputs of each drive.
    """
    rules: Callable[[config.Drives, Requirements], Iterator[Rule]]
    """Function that yields checks for settings that the drives cannot carry out."""
    files: Callable[[config.Drives], Iterator[Rule]]
    """Function that yields checks that read the files named in the settings."""
    traffic: Traffic
    """Bus traffic of drives with every optional object and without digital outputs and inputs."""
    plan_traffic: Callable[[config.Drives, Sequence[config.DigitalIo], float, BusTiming], TrafficPlan]
    """Function that returns the traffic expected from the configuration. Arguments: section [drives], the digital
    outputs and inputs of each drive, the cycle rate [Hz] and the bit rate [bit/s].
    """
    simulated_drive: Callable[[config.Simulated, config.Drives, config.Drive, float], SimulatedDevice]
    """Function that returns one simulated drive, whose slider is at rest at a position [m]."""
    inspect: Callable[..., list[dict[str, Any]]] | None
    """Function that returns a description of each drive, with the values that its set-up changes; None if the drives
    cannot be inspected.

    Arguments: the bus, section [drives], the period [s], the clock, the velocity limit of the sliders [m/s], whether to
    `apply` the changes, the digital outputs and inputs `io` of each drive, the `timing` of the bus, and the `travel` of
    each slider [m].
    """
    check_exclusive: Callable[[can.BusABC, config.Drives, Clock], None]
    """Function that listens for another master, and raises DriveError if there is one."""
    save: Callable[..., dict[str, SavedParameters | DriveError]] | None
    """Function that reads the parameters of drives; None if the drives have no object dictionary.

    Arguments: the bus, section [drives], the clock and the names of the drives.
    """
    restore: Callable[..., RestoreResult] | None
    """Function that restores the parameters of a drive; None if the drives have no object dictionary.

    Arguments: the bus, section [drives], the clock, the name of the drive, its saved parameters, and the digital
    outputs and inputs `io` of each drive.
    """
    protections: Mapping[str, str]
    """Names that `accept_without` may contain, each with its description for people."""
    inputs: Callable[[can.BusABC, config.Drives, Clock], Callable[[str], int | None]] | None
    """Function that returns a reader of digital inputs; None if the drives do not report inputs. The reader takes the
    name of a drive and returns its inputs, as bits of object 60FDh.
    """
    without_io: str
    """Reason why the drives have no digital outputs and inputs in the cycle; "" if they have them."""
    without_fd: str
    """Reason why the drives cannot be used on a CAN FD bus; "" if they can."""
    states: Callable[[int], set[int]]
    """Function that returns the CAN identifiers of the state frames of a node."""
    sync: int | None
    """CAN identifier of the frame at which the drives apply their setpoints; None if the protocol has no such frame."""
    setpoints: range
    """CAN identifiers that frames with setpoints may have."""
    fault_frames: Mapping[str, Frames]
    """Frames that a fault on demand may affect, by the names used in the faults."""
