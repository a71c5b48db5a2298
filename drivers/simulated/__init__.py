"""Drives simulated as devices on a CAN bus, CiA 402 servos and ODrives: for tests and work without hardware."""

from drivers.simulated.bus import SimulatedBus, simulated_bus
from drivers.simulated.devices import SimulatedDevice
from drivers.simulated.drive import SimulatedDrive
from drivers.simulated.odrive import SimulatedOdrive
from drivers.simulated.servo import Servo

__all__ = ["Servo", "SimulatedBus", "SimulatedDevice", "SimulatedDrive", "SimulatedOdrive", "simulated_bus"]
