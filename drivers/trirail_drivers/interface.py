"""Interface between the control loop and three drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple, Protocol

from msgspec import Struct

NAMES = ("A", "B", "C")
"""Names of the drives, which are also the names of their sliders."""

Triple = tuple[float, float, float]
Travel = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Lower and upper end of the travel of the sliders A, B, C [m]."""

Clock = Callable[[], float]
"""Function that returns the monotonic or simulated time [s]."""


class PowerState(IntEnum):
    """States of the CiA 402 power drive system (CiA 402-2, finite state automaton).

    The drivers of all protocols use these states.
    """

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
    """Protection that a drive lacks and that its configuration allows it to lack."""

    drive: str
    """Name of the drive."""
    object: str
    """Name in `accept_without`: the index of the object, such as 1006, or the name of an ODrive setting."""
    means: str
    """One line for people: the purpose of the protection, and the consequence of lacking it."""


class Counts(NamedTuple):
    """Numbers of late and lost positions and setpoints of one drive since the start.

    A late or lost value is not a fault by itself.
    """

    feedback_late: int = 0
    """Number of positions that arrived one cycle later than the position before."""
    feedback_lost: int = 0
    """Number of SYNCs that the drive never answered. A SYNC is counted once a later SYNC has been answered."""
    setpoints_late: int = 0
    """Number of setpoints written after the next SYNC was due."""
    setpoints_lost: int = 0
    """Number of setpoints that the bus refused."""


class Unready(NamedTuple):
    """Reason why a drive cannot be reset yet, and the progress of its set-up."""

    reason: str
    """One line for people: the drive does not answer, has restarted, or is refused."""
    objects: int = 0
    """Number of objects of the drive read or written up to now; 0 outside a set-up."""
    expected: int = 0
    """Number of objects read or written in the drive's last set-up; 0 if there was none."""
    counted: str = "objects"
    """Name of the counted items, for people."""

    def __str__(self) -> str:
        of = f" of {self.expected}" if self.expected >= self.objects else ""
        return f"{self.reason} ({self.objects}{of} {self.counted})" if self.objects else self.reason


UnreadyDrives = tuple[Unready | None, Unready | None, Unready | None]
"""For each drive, the reason why it cannot be reset yet; None if it is configured."""


class Feedback(NamedTuple):
    """Feedback of the three drives."""

    position: Triple
    """Measured slider positions [m]."""
    state: tuple[PowerState, PowerState, PowerState]
    fault: DriveFault | None
    """First fault since the last reset or, if a drive then did not stop, the fault of that drive; None if there is no
    fault.
    """
    warnings: tuple[str, ...] = ()
    """New warnings for people, one line each; each warning appears in one feedback only."""
    age: tuple[int, int, int] = (0, 0, 0)
    """For each position, the number of SYNCs since the SYNC at which it was sampled.

    0 if the drive has already answered the newest SYNC, 1 if only that answer has not arrived yet, more if answers
    were lost.
    """
    homing: bool = False
    """Whether a drive is being homed."""
    follows: tuple[bool, bool, bool] = (True, True, True)
    """Whether each drive follows setpoints; False while a drive is being homed, since it then moves by itself."""
    homed: tuple[bool, bool, bool] = (True, True, True)
    """Whether each position is relative to a known place: always True with an absolute encoder, otherwise True after
    homing.
    """
    unready: UnreadyDrives = (None, None, None)
    """For each drive, the reason why it cannot be reset yet; None if it is configured. A drive that has not sent a
    position since the start is reported at zero counts and as not homed.
    """
    inputs: tuple[int, int, int] = (0, 0, 0)
    """Newest digital inputs of each drive, limited to its mask (trirail_drivers.config.DigitalIo)."""


class DriveGroup(Protocol):
    """Three drives that follow a position setpoint every cycle.

    `configure` and `close` may block and raise DriveError. All other methods are called in the cycle and never block or
    raise; an error becomes a fault in the next feedback.
    """

    next_sync: float
    """Time of the drives' clock at which the next `sync` is due [s], set before commands between two cycles; inf if the
    time is unknown. Frames of `disable` and `reset` that would delay this `sync` are sent by the next `write`. Those of
    `quick_stop` are never held back.
    """
    bus_load: float
    """Fraction of the bus capacity that cyclic and periodic frames use with worst-case bit stuffing; 1.0 is a full bus.
    """

    @property
    def missing_protections(self) -> tuple[MissingProtection, ...]:
        """Protections that the configured drives lack."""

    @property
    def path_outputs(self) -> tuple[bool, bool, bool]:
        """Whether each drive applies its digital outputs together with a setpoint; only such outputs can be switched on
        a path.
        """

    @property
    def traffic(self) -> int:
        """Duration of all frames sent and received since the start, with worst-case bit stuffing [ns].

        Frames that the kernel filters out are not counted.
        """

    @property
    def counts(self) -> tuple[Counts, Counts, Counts]:
        """Numbers of late and lost positions and setpoints of each drive."""

    @property
    def reported_faults(self) -> tuple[DriveFault | None, ...]:
        """For each drive, the first fault that it has reported itself since the last reset, or None."""

    def configure(
        self, period: float, fastest: float | None = None, *, travel: Travel | None = None, awaits: bool = False
    ) -> None:
        """Set up the drives for a cycle of `period` seconds, verify the settings, and start the drives without power.

        Settings that a drive can report are read back.

        Parameters
        ----------
        period
            Cycle period [s].
        fastest
            Velocity limit of the sliders [m/s]. If it is given, drives that cannot handle it are refused.
        travel
            Travel of each slider [m]. If it is given, drives whose own position limits exclude part of it are refused.
        awaits
            If True, a drive that does not answer causes a fault and not a DriveError. Once the drive appears, the
            following cycles configure it like a drive that has restarted.
        """

    def sync(self) -> None:
        """Begin a cycle: the drives apply the setpoints of the previous cycle and sample their positions."""

    def read(self) -> Feedback:
        """Handle every frame that has arrived, and return the feedback."""

    def observe(self) -> Feedback:
        """Do the same as `read`, but do not stop the drives, whatever they report, and send no command.

        The states in the following feedback are those that the drives report themselves, also without `sync`.
        """

    def write(self, position: Triple, velocity: Triple) -> None:
        """Send setpoints [m] and velocity feed-forward [m/s], which the drives apply at the next SYNC.

        Changed outputs are sent after the setpoints, even if no setpoint is sent, and are applied at the same SYNC.
        """

    def set_outputs(self, words: Sequence[int]) -> None:
        """Set the wanted outputs of the drives A, B, C as bits of 60FEh; the next `write` sends those that changed.

        Bits outside a drive's mask (trirail_drivers.config.DigitalIo) are ignored.
        """

    def enable(self, alone: str | None = None) -> None:
        """Begin to power up all drives, or only the drive `alone` while the others stay without power.

        The following cycles complete the power-up, and the states in the feedback show its progress. Drives that have
        power, or are being powered up, must be disabled first.
        """

    def home(self) -> None:
        """Begin to home the drives whose positions are not absolute; the following cycles complete the homing.

        All drives to be homed must have power and be at standstill. A drive that was enabled alone is homed alone.
        While a drive does not follow setpoints, its setpoints are ignored. In the first cycle in which the drive
        follows setpoints again, its setpoint must be the position in the previous cycle's feedback.
        """

    def stop_homing(self) -> None:
        """Halt the drive that is being homed.

        Every drive then follows setpoints again, starting at its present position.
        """

    def disable(self) -> None:
        """Remove power from the drives, which must be at standstill."""

    def quick_stop(self) -> None:
        """Begin the quick-stop ramp of every drive in this cycle."""

    def reset(self) -> None:
        """Clear the latched fault and the faults of the drives, without powering up."""

    def close(self) -> None:
        """Leave the drives without power and not operational, and close the bus."""
