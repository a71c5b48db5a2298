"""Sections [can] and [drives] of a configuration file."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from msgspec import Meta, Struct

# The bounds exclude values that no machine of this kind has, so that nothing overflows or loses precision later.
Coordinate = Annotated[float, Meta(ge=-100.0, le=100.0)]
"""A position [m]."""
Distance = Annotated[float, Meta(ge=1e-6, le=1.0)]
"""A small length, such as a following error [m]."""
Velocity = Annotated[float, Meta(ge=1e-5, le=100.0)]
"""[m/s] or [rad/s]."""
Acceleration = Annotated[float, Meta(ge=1e-4, le=1e4)]
"""[m/s²] or [rad/s²]."""
Timeout = Annotated[float, Meta(ge=0.01, le=600.0)]
"""[s]."""
Name = Annotated[str, Meta(max_length=4096, pattern=r"^[^\x00-\x1f\x7f]*$")]
"""A file's or a device's name: no control characters."""
UnitName = Annotated[str, Meta(max_length=32)]
"""A unit of velocity or acceleration."""
ProtectionName = Annotated[str, Meta(max_length=64, pattern=r"^([0-9A-F]{4}(:[0-9A-F]{2})?|[a-z_]+)$")]
"""An object's index in hexadecimal, as 605A, or an ODrive's setting, as enable_watchdog."""
NodeId = Annotated[int, Meta(ge=0, le=127)]
"""CANopen allows 1 to 127, ODrive 0 to 62; the driver refuses other values."""


CountsPerMetre = Annotated[float, Meta(ge=1e-3, le=1e12)]


class SimulatedSlider(Struct, frozen=True, forbid_unknown_fields=True):
    """True axis of a simulated slider, which may differ from [drives]."""

    node: NodeId
    """Node id of its drive."""
    counts_per_metre: CountsPerMetre
    """Resolution of its encoder, as in [drives]."""
    direction: Literal[1, -1] = 1
    """-1 where counts fall as the slider position rises."""


class Simulated(Struct, frozen=True, forbid_unknown_fields=True):
    """Behaviour of the simulated drives; used only with interface = "simulated"."""

    time_constant: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.004
    """First-order lag of the servo behind its setpoint [s]."""
    feed_forward_gain: Annotated[float, Meta(ge=0.0, le=2.0)] = 1.0
    """Share of the velocity feed-forward that the servo uses; the servo follows the rest with a lag."""
    max_velocity: Velocity = 2.0
    """Largest velocity of the slider [m/s]."""
    max_acceleration: Acceleration = 100.0
    """Largest acceleration of the slider [m/s²]."""
    missed_syncs: Annotated[int, Meta(ge=1, le=100_000)] = 3
    """Number of consecutive missed SYNCs after which a CiA 402 drive stops by itself; an ODrive has its watchdog."""
    start: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """Slider positions at power-on [m]."""
    built: tuple[SimulatedSlider, SimulatedSlider, SimulatedSlider] | None = None
    """True axes of the simulated sliders where they differ from [drives], for `trirail commission` to find out."""


OptionNumber = Annotated[int, Meta(ge=-(10**12), le=10**12)] | Annotated[float, Meta(ge=-1e12, le=1e12)]
OptionName = Annotated[str, Meta(max_length=64, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A keyword argument of a python-can bus."""


class Can(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [can]: any python-can interface, or "simulated" (three drives inside the service)."""

    interface: Name
    """`simulated`, or the name of a python-can interface, as `socketcan`."""
    channel: Name = ""
    """The interface's channel, as `can0`."""
    bitrate: Annotated[int, Meta(ge=10_000, le=8_000_000)] = 1_000_000
    """Bits per second: for the bus load, and for interfaces that set it themselves; at most 1 Mbit/s on a wire."""
    options: dict[OptionName, bool | OptionNumber | Name] = {}
    """Passed to python-can unchanged: `index` of gs_usb, `host` and `port` of socketcand, `tty_baudrate` of slcan."""
    simulated: Simulated = Simulated()


class Homing(Struct, frozen=True, forbid_unknown_fields=True):
    """Homing of a drive with an incremental encoder, in homing mode: [drives.A.homing], and so on."""

    method: Annotated[int, Meta(ge=-128, le=127)]
    """Object 6098h; directions are those of the drive's counts, negative methods are the maker's."""
    speed_switch: Velocity
    """Object 6099h:01, during the search for the switch [m/s]."""
    speed_zero: Velocity
    """Object 6099h:02, during the search for its edge or the index pulse [m/s]."""
    acceleration: Acceleration
    """Object 609Ah [m/s²]."""
    timeout: Annotated[float, Meta(ge=0.01, le=180.0)] = 60.0
    """Longest duration [s]; it bounds the travel of a slider that meets no switch."""

    def __post_init__(self) -> None:
        if self.method == 0:
            raise ValueError("method 0 is no homing: leave the table out where the encoder is absolute")


class ObjectWrite(Struct, frozen=True, forbid_unknown_fields=True):
    """An object of the maker's, written and read back at set-up. Refused: objects that set-up itself writes, node id,
    bitrate, storing."""

    object: Annotated[int, Meta(ge=0x1000, le=0xFFFF)]
    """Index, as 0x208E."""
    value: Annotated[int, Meta(ge=-(2**31), le=2**32 - 1)]
    """Value to write to the object."""
    type: Literal["u8", "u16", "u32", "i8", "i16", "i32"]
    """Data type, from the maker's manual."""
    why: Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
    """Purpose, shown by `trirail drives`."""
    sub: Annotated[int, Meta(ge=0, le=255)] = 0
    """Subindex; 0 if the object has none."""

    def __post_init__(self) -> None:
        low = -(1 << self.bits - 1) if self.signed else 0
        if not low <= self.value < low + (1 << self.bits):
            raise ValueError(f"value {self.value} is no {self.type}")

    @property
    def bits(self) -> int:
        """Length of the value."""
        return int(self.type[1:])

    @property
    def signed(self) -> bool:
        """Whether the type has a sign."""
        return self.type[0] == "i"


class Drive(Struct, frozen=True, forbid_unknown_fields=True):
    """One drive: section [drives.A], [drives.B] or [drives.C]."""

    node: NodeId
    """The drive's node id: 1 to 127 on CANopen, 0 to 62 of an ODrive."""
    counts_per_metre: CountsPerMetre
    """The drive's own unit of position, per metre of the slider: counts of a CiA 402 drive, turns of an ODrive."""
    direction: Literal[1, -1] = 1
    """-1 where counts fall as the slider position rises."""
    offset: Coordinate = 0.0
    """Slider position at zero counts [m]; after homing, at the home position."""
    homing: Homing | None = None
    """None if the encoder is absolute."""
    eds: Name | None = None
    """The maker's EDS, relative to this file: mappable objects, and data types that the drive does not report."""
    velocity_unit: UnitName | None = None
    """Unit of velocity, as "0.1 counts/s", "rpm", "deg/s", "mm/s", if the drive reports none (60A9h, 6096h); refused
    if it contradicts the drive."""
    acceleration_unit: UnitName | None = None
    """Unit of acceleration, as "counts/s2", "rpm/s", "rev/s2", "mm/s2", under the same rules (60AAh, 6097h)."""
    revolutions_per_metre: Annotated[float, Meta(ge=1e-6, le=1e9)] | None = None
    """Revolutions per metre of the slider, if velocities are in rpm or similar and the drive does not report its counts
    per revolution."""
    endpoints: Name | None = None
    """An ODrive's flat_endpoints.json, relative to this file, for firmware or hardware that trirail does not know."""
    accept_without: tuple[ProtectionName, ...] = ()
    """Protections that the drive may lack, from the tables in drivers/requirements.md: objects, as ["1006", "6007"], or
    an ODrive's settings, as ["enable_watchdog"]; "6041" if bit 12 of its statusword is never set."""
    allow_replacement: bool = False
    """Whether a drive with another serial number or firmware may replace it while the service runs; otherwise it is
    refused until the service is restarted."""
    write: tuple[ObjectWrite, ...] = ()
    """Objects of the maker's to write at set-up."""


class DigitalIo(NamedTuple):
    """Digital outputs and inputs of one drive, as bits of 60FEh and 60FDh."""

    outputs: int = 0
    """Bits that the service switches."""
    safe: int = 0
    """Values of those bits without power, in a fault and at the end."""
    inputs: int = 0
    """Bits that the service reads."""


DriveIo = tuple[DigitalIo, DigitalIo, DigitalIo]
NO_IO: DriveIo = (DigitalIo(), DigitalIo(), DigitalIo())


class Drives(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [drives]: settings of all three drives, and one table for each."""

    protocol: Literal["cia402", "odrive"]
    """Protocol of the drives: CiA 402 on CANopen, or ODrive's CANSimple."""
    A: Drive
    B: Drive
    C: Drive
    master_node: NodeId = 126
    """Node id of the service itself, for its heartbeat on CANopen."""
    heartbeat: Annotated[float, Meta(ge=0.001, le=21.845)] = 0.1
    """Heartbeat period of drives and service [s]; an ODrive must be set to it. Three missed heartbeats are a loss."""
    missed_positions: Annotated[int, Meta(ge=1, le=1000)] = 3
    """Number of consecutive cycles without a drive's position that are a loss of the drive."""
    following_error: Distance = 0.005
    """The drives' own window [m], object 6065h; the driver's for ODrives. Wider than `[limits.slider] following_error`,
    so that the service stops all three drives before one of them faults."""
    quick_stop_deceleration: Acceleration = 10.0
    """Deceleration of the quick-stop ramp [m/s²]: the drives' own, object 6085h; the driver's for ODrives."""
    stop_timeout: Timeout = 1.0
    """Longest time until a drive has lost its power, after a quick stop or when it is disabled [s]."""
    sdo_timeout: Timeout = 0.5
    """Longest time until a drive answers at set-up, or a written value takes effect [s]; ten times that to boot."""

    @property
    def each(self) -> tuple[Drive, Drive, Drive]:
        """The three drives in the order of the sliders."""
        return self.A, self.B, self.C
