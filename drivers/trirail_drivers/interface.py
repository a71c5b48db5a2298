"""What the control loop needs of three drives together."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, Protocol

from msgspec import Struct

NAMES = ("A", "B", "C")
"""The drives are named as the sliders they move."""

Triple = tuple[float, float, float]

Clock = Callable[[], float]
"""Tells the time [s]: monotonic, or that of a simulation."""


class PowerState(IntEnum):
    """States of the CiA 402 power drive system (CiA 402-2, finite state automaton); other drives' are told as these."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


class DriveFault(NamedTuple):
    """Why a drive must not be moved any more; lasts until it is reset."""

    drive: str
    """Name of the drive, or "" where the bus itself is at fault."""
    cause: str
    """One of emcy, fault, silent, heartbeat, state, timeout, homing, frame, setpoint, bus."""
    code: int
    """The EMCY or 603Fh error code, or an ODrive's error bits; 0 where there is none."""
    message: str
    """One line for people, of bounded length, with drive, cause and code in words."""


class MissingProtection(Struct, frozen=True):
    """What would stop a drive where the service cannot, and what it does without, as its configuration accepts."""

    drive: str
    """Name of the drive."""
    object: str
    """As `accept_without` names it: the object's index, as 1006."""
    means: str
    """One line for people: what it is for, and what is so without."""


class Counts(NamedTuple):
    """What of one drive's cyclic traffic went wrong since the start; none of it is a fault by itself."""

    feedback_late: int = 0
    """Positions that came a cycle later than the one before did."""
    feedback_lost: int = 0
    """SYNCs that were never answered, as far as later answers show."""
    setpoints_late: int = 0
    """Setpoints written after the next SYNC was due."""
    setpoints_lost: int = 0
    """Setpoints that the bus did not take."""


class Feedback(NamedTuple):
    """What the three drives have said by now."""

    position: Triple
    """Measured slider positions [m]."""
    state: tuple[PowerState, PowerState, PowerState]
    fault: DriveFault | None
    """The first fault since the last reset, or that a drive did not stop after it; else None."""
    counts: tuple[Counts, Counts, Counts] = (Counts(), Counts(), Counts())
    warnings: tuple[str, ...] = ()
    """What people should know and is no fault, a line each; told in one feedback only."""
    age: tuple[int, int, int] = (0, 0, 0)
    """How many SYNCs before the newest one each position was sampled: 0 where a drive has answered it already, 1
    where the answer is still on its way, more where answers were lost."""
    homing: bool = False
    """Drives are being homed."""
    follows: tuple[bool, bool, bool] = (True, True, True)
    """Whether each drive follows setpoints; one that is being homed moves by itself."""
    homed: tuple[bool, bool, bool] = (True, True, True)
    """Whether each position is counted from a known place: always with absolute encoders, else after homing."""


class DriveGroup(Protocol):
    """Three drives that follow a position setpoint every cycle.

    `configure` and `close` may block and raise DriveError. All else is for the cycle: it never blocks and never
    raises; what goes wrong is a fault in the next feedback.
    """

    bus_load: float
    """Worst-case share of the bus that the cyclic traffic takes, with stuffing; 1.0 is full."""
    missing_protections: tuple[MissingProtection, ...]
    """What the drives do without; known once they are set up."""

    @property
    def traffic(self) -> int:
        """Bits of all frames sent and heard since the start, each with worst-case stuffing; what a kernel filters out
        is not heard."""

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """Of each drive the first fault that it has told of by itself since the last reset, whichever came first."""

    def configure(self, period: float, fastest: float | None = None) -> None:
        """Set the drives up for a cycle of `period` seconds, check what can be read back, start them without power.

        `fastest` is the sliders' limit of velocity [m/s]: where it is given, drives that cannot be told it are refused.
        """

    def sync(self) -> None:
        """Begin a cycle: the drives take up the setpoints written in the last one and sample their positions."""

    def read(self) -> Feedback:
        """Take in every frame that has arrived."""

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], to be taken up at the next SYNC."""

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up, all drives, or the one of this name `alone`: the others are kept without power.

        The following cycles carry it out, the feedback's states tell when it is done. Drives that have power, or are
        getting it, first have to be disabled.
        """

    def home(self) -> None:
        """Begin to home the drives whose positions are not absolute; the following cycles carry it out.

        Powered drives at standstill only; one that was enabled alone is homed alone. What is written for a drive is
        not for it while it does not follow; in the cycle in which it follows again, that must be the position that was
        fed back one cycle before.
        """

    def stop_homing(self) -> None:
        """Halt the drive that is being homed; in the end every drive follows setpoints again, where it stands."""

    def disable(self) -> None:
        """Take power off; meant for a robot at standstill."""

    def quick_stop(self) -> None:
        """Make every drive stop by its quick-stop ramp, beginning in this cycle."""

    def reset(self) -> None:
        """Forget the fault and clear the drives' own; never powers them up."""

    def close(self) -> None:
        """Leave the drives without power and not operational, and let go of the bus."""
