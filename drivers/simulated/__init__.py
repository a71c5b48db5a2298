"""CiA 402 drives simulated as devices on a CAN bus: for tests and work without hardware."""

from drivers.simulated.bus import SimulatedBus, simulated_bus
from drivers.simulated.drive import SimulatedDrive
from drivers.simulated.servo import Servo

__all__ = ["Servo", "SimulatedBus", "SimulatedDrive", "simulated_bus"]
