"""Simulated CiA 402 servos and ODrives as devices on a CAN bus, for tests and for work without hardware."""

from trirail_drivers.simulated.bus import SimulatedBus
from trirail_drivers.simulated.carriages import Carriages
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.digital import OutputChange
from trirail_drivers.simulated.drive import EDS, SimulatedDrive
from trirail_drivers.simulated.factor_group import Mechanics
from trirail_drivers.simulated.faultlines import Frames
from trirail_drivers.simulated.odrive import SimulatedOdrive
from trirail_drivers.simulated.servo import Servo

__all__ = [
    "EDS",
    "Carriages",
    "Frames",
    "Mechanics",
    "OutputChange",
    "Servo",
    "SimulatedBus",
    "SimulatedDevice",
    "SimulatedDrive",
    "SimulatedOdrive",
]
