"""Interface between the control loop and three drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol

from msgspec import Struct

NAMES = ("A", "B", "C")
"""Names of the drives, which are those of their sliders."""

Triple = tuple[float, float, float]

Clock = Callable[[], float]
"""Function that returns the time [s]: monotonic, or simulated."""


class PowerState(IntEnum):
    """States of the CiA 402 power drive system (CiA 402-2, finite state automaton), used for every protocol."""

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
    """Fault of a drive or the bus, latched until it is reset."""

    drive: str
    """Name of the drive, or "" for a fault of the bus."""
    cause: str
    """One of emcy, fault, silent, heartbeat, state, timeout, homing, frame, setpoint, bus."""
    code: int
    """The EMCY or 603Fh error code, or an ODrive's error bits; 0 if there is none."""
    message: str
    """One line for people, of bounded length, with drive, cause and code in words."""


class MissingProtection(Struct, frozen=True):
    """A protection that a drive lacks, as its configuration accepts."""

    drive: str
    """Name of the drive."""
    object: str
    """Name in `accept_without`: the object's index, as 1006, or an ODrive's setting."""
    means: str
    """One line for people: its purpose, and the consequence of lacking it."""


class Counts(NamedTuple):
    """Numbers of late and lost positions and setpoints of one drive since the start; none is a fault by itself."""

    feedback_late: int = 0
    """Positions that came a cycle later than the previous one did."""
    feedback_lost: int = 0
    """SYNCs that were never answered, as far as later answers show."""
    setpoints_late: int = 0
    """Setpoints written after the next SYNC was due."""
    setpoints_lost: int = 0
    """Setpoints that the bus refused."""


class Unready(NamedTuple):
    """Reason for which a drive cannot be reset yet, and the progress of its set-up."""

    reason: str
    """One line for people: it does not answer, restarted, or is refused."""
    objects: int = 0
    """Number of its objects read or written until now; 0 outside a set-up."""
    expected: int = 0
    """Number of them in its last set-up; 0 if it had none."""
    counted: str = "objects"
    """Name of the things counted, for people."""

    def __str__(self) -> str:
        of = f" of {self.expected}" if self.expected >= self.objects else ""
        return f"{self.reason} ({self.objects}{of} {self.counted})" if self.objects else self.reason


UnreadyDrives = tuple[Unready | None, Unready | None, Unready | None]
"""Reason for which each drive cannot be reset yet; None if it is configured."""


class Feedback(NamedTuple):
    """Feedback of the three drives."""

    position: Triple
    """Measured slider positions [m]."""
    state: tuple[PowerState, PowerState, PowerState]
    fault: DriveFault | None
    """First fault since the last reset, or the fault of a drive that did not stop after it; else None."""
    counts: tuple[Counts, Counts, Counts] = (Counts(), Counts(), Counts())
    warnings: tuple[str, ...] = ()
    """New warnings for people, a line each; each appears in one feedback only."""
    age: tuple[int, int, int] = (0, 0, 0)
    """Number of SYNCs between the one at which each position was sampled and the newest: 0 if the drive has answered
    it already, 1 if its answer is still on its way, more if answers were lost."""
    homing: bool = False
    """Whether a drive is being homed."""
    follows: tuple[bool, bool, bool] = (True, True, True)
    """Whether each drive follows setpoints; a drive that is being homed moves by itself."""
    homed: tuple[bool, bool, bool] = (True, True, True)
    """Whether each position is counted from a known place: always with absolute encoders, otherwise after homing."""
    unready: UnreadyDrives = (None, None, None)
    """Reason for which each drive cannot be reset yet; None if it is configured. A drive without a position since the
    start is reported at its zero, and as not homed."""
    inputs: tuple[int, int, int] = (0, 0, 0)
    """Newest digital inputs of each drive: bits of object 60FDh, those of the configuration alone."""


class DriveGroup(Protocol):
    """Three drives that follow a position setpoint every cycle.

    `configure` and `close` may block and raise DriveError. All other methods are for the cycle and never block or
    raise; an error becomes a fault in the next feedback.
    """

    bus_load: float
    """Worst-case share of the bus that the cyclic traffic takes, with bit stuffing; 1.0 is full."""

    @property
    def missing_protections(self) -> tuple[MissingProtection, ...]:
        """Protections that the configured drives lack."""

    @property
    def traffic(self) -> int:
        """Bits of all frames sent and received since the start, each with worst-case stuffing, without those that the
        kernel filters out."""

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """First fault that each drive itself has reported since the last reset, or None."""

    def configure(self, period: float, fastest: float | None = None, *, awaits: bool = False) -> None:
        """Set the drives up for a cycle of `period` seconds, read back what can be read, start them without power.

        Parameters
        ----------
        period
            Cycle period [s].
        fastest
            Velocity limit of the sliders [m/s]; if given, drives that cannot take it are refused.
        awaits
            Whether a drive that does not answer is a fault instead of an error: the following cycles configure it
            when it appears, like a drive that restarts.
        """

    def sync(self) -> None:
        """Begin a cycle: the drives adopt the setpoints written in the last one and sample their positions."""

    def read(self) -> Feedback:
        """Handle every frame that has arrived; return the feedback."""

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], which the drives adopt at the next SYNC."""

    @property
    def path_outputs(self) -> tuple[bool, bool, bool]:
        """Whether each drive takes its digital outputs at the same SYNC as a setpoint, known after `configure`."""

    def set_outputs(self, words: Sequence[int]) -> None:
        """Set the wanted digital outputs of each drive, bits of object 60FEh; the next `write` sends what has changed.

        Also in a cycle in which the drives were stopped.
        """

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up all drives, or only the drive `alone`, the others staying without power.

        The following cycles carry it out, as the states in the feedback show. Drives with power, or getting it, must
        be disabled first.
        """

    def home(self) -> None:
        """Begin to home the drives whose positions are not absolute; the following cycles carry it out.

        Only for powered drives at standstill; a drive that was enabled alone is homed alone. While a drive does not
        follow, its setpoints are ignored; in the cycle in which it follows again, its setpoint must be the position
        of the previous cycle's feedback.
        """

    def stop_homing(self) -> None:
        """Halt the drive that is being homed; then every drive follows setpoints again, at its present position."""

    def disable(self) -> None:
        """Take the power off, at standstill."""

    def quick_stop(self) -> None:
        """Begin the quick-stop ramp of every drive in this cycle."""

    def reset(self) -> None:
        """Clear the latched fault and the drives' own faults, without powering up."""

    def close(self) -> None:
        """Leave the drives without power and not operational, and close the bus."""
