"""Drives simulated as devices on a CAN bus, CiA 402 servos and ODrives: for tests and work without hardware."""

from trirail_drivers.simulated.bus import SimulatedBus, simulated_bus
from trirail_drivers.simulated.devices import SimulatedDevice
from trirail_drivers.simulated.drive import SimulatedDrive
from trirail_drivers.simulated.odrive import SimulatedOdrive
from trirail_drivers.simulated.servo import Servo

__all__ = ["Servo", "SimulatedBus", "SimulatedDevice", "SimulatedDrive", "SimulatedOdrive", "simulated_bus"]
