"""What a configuration file says of the bus and the drives: sections [can] and [drives]."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

# Bounds keep out what no machine of this kind has, so that nothing overflows or loses its digits behind them.
Coordinate = Annotated[float, Meta(ge=-100.0, le=100.0)]
"""A place [m]."""
Distance = Annotated[float, Meta(ge=1e-6, le=1.0)]
"""A small length, as of a following error [m]."""
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
"""CANopen has 1 to 127, ODrive 0 to 62; the driver refuses the rest."""


CountsPerMetre = Annotated[float, Meta(ge=1e-3, le=1e12)]


class Built(Struct, frozen=True, forbid_unknown_fields=True):
    """What moves a simulated slider, whatever [drives] says of it."""

    node: NodeId
    """The drive's node id."""
    counts_per_metre: CountsPerMetre
    """What its encoder counts."""
    direction: Literal[1, -1] = 1
    """-1 where counts fall as the slider position rises."""


class Simulated(Struct, frozen=True, forbid_unknown_fields=True):
    """How the simulated drives behave; used only with interface = "simulated"."""

    time_constant: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.004
    """First-order lag of the servo behind its setpoint [s]."""
    feed_forward_gain: Annotated[float, Meta(ge=0.0, le=2.0)] = 1.0
    """Share of the velocity feed-forward that the servo makes use of; what it leaves is made up with a lag."""
    max_velocity: Velocity = 2.0
    """What the slider can do at most [m/s]."""
    max_acceleration: Acceleration = 100.0
    """What the slider can do at most [m/s²]."""
    missed_syncs: Annotated[int, Meta(ge=1, le=100_000)] = 3
    """So many SYNCs missed in a row make a CiA 402 drive stop by itself; an ODrive has its watchdog."""
    start: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """Slider positions at power-on [m]."""
    built: tuple[Built, Built, Built] | None = None
    """How the simulated sliders are built, where otherwise than [drives] says: `trirail commission` finds it out."""


OptionNumber = Annotated[int, Meta(ge=-(10**12), le=10**12)] | Annotated[float, Meta(ge=-1e12, le=1e12)]
OptionName = Annotated[str, Meta(max_length=64, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A keyword argument of a python-can bus."""


class Can(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [can]: any python-can interface, or "simulated" (three drives that the service brings along)."""

    interface: Name
    """`simulated`, or the name of a python-can interface, as `socketcan`."""
    channel: Name = ""
    """The interface's channel, as `can0`."""
    bitrate: Annotated[int, Meta(ge=10_000, le=8_000_000)] = 1_000_000
    """Bits per second: for the bus load, and for interfaces that set it themselves; 1 Mbit/s at most on a wire."""
    options: dict[OptionName, bool | OptionNumber | Name] = {}
    """Handed to python-can as they are: `index` of gs_usb, `host` and `port` of socketcand, `tty_baudrate` of slcan."""
    simulated: Simulated = Simulated()


class Homing(Struct, frozen=True, forbid_unknown_fields=True):
    """How a drive with an incremental encoder finds its zero, in homing mode: [drives.A.homing], and so on."""

    method: Annotated[int, Meta(ge=-128, le=127)]
    """Object 6098h; directions are those of the drive's counts, negative methods the maker's."""
    speed_switch: Velocity
    """Object 6099h:01, while the switch is searched [m/s]."""
    speed_zero: Velocity
    """Object 6099h:02, while its edge or the index pulse is searched [m/s]."""
    acceleration: Acceleration
    """Object 609Ah [m/s²]."""
    timeout: Annotated[float, Meta(ge=0.01, le=180.0)] = 60.0
    """How long it may take [s]: bounds the way of a slider that meets no switch."""

    def __post_init__(self) -> None:
        if self.method == 0:
            raise ValueError("method 0 is no homing: leave the table out where the encoder is absolute")


class ObjectWrite(Struct, frozen=True, forbid_unknown_fields=True):
    """An object of the maker's, written and read back at set-up. Refused: what set-up writes itself, node id, bitrate,
    storing."""

    object: Annotated[int, Meta(ge=0x1000, le=0xFFFF)]
    """Its index, as 0x208E."""
    value: Annotated[int, Meta(ge=-(2**31), le=2**32 - 1)]
    """What it is to hold."""
    type: Literal["u8", "u16", "u32", "i8", "i16", "i32"]
    """Its type, as the maker's manual has it."""
    why: Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
    """What for: `trirail drives` shows it."""
    sub: Annotated[int, Meta(ge=0, le=255)] = 0
    """Its subindex, 0 where it has none."""

    def __post_init__(self) -> None:
        low = -(1 << self.bits - 1) if self.signed else 0
        if not low <= self.value < low + (1 << self.bits):
            raise ValueError(f"value {self.value} is no {self.type}")

    @property
    def bits(self) -> int:
        """Its length."""
        return int(self.type[1:])

    @property
    def signed(self) -> bool:
        """Whether it has a sign."""
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
    """Slider position at zero counts [m]; after homing, that at home."""
    homing: Homing | None = None
    """None where the encoder is absolute."""
    eds: Name | None = None
    """Its maker's EDS, relative to this file: which objects are mappable, types that the drive cannot tell."""
    velocity_unit: UnitName | None = None
    """Unit of velocity, as "0.1 counts/s", "rpm", "deg/s", "mm/s", where the drive tells none (60A9h, 6096h); refused
    where it contradicts the drive."""
    acceleration_unit: UnitName | None = None
    """Likewise of acceleration, as "counts/s2", "rpm/s", "rev/s2", "mm/s2" (60AAh, 6097h)."""
    revolutions_per_metre: Annotated[float, Meta(ge=1e-6, le=1e9)] | None = None
    """Revolutions per metre of the slider, where velocities are in rpm or the like and the drive does not tell how many
    counts a revolution has."""
    endpoints: Name | None = None
    """An ODrive's flat_endpoints.json, relative to this file, for firmware or hardware that trirail does not know."""
    accept_without: tuple[ProtectionName, ...] = ()
    """Protections that the drive may lack, of the tables in drivers/requirements.md: objects, as ["1006", "6007"], or
    an ODrive's settings, as ["enable_watchdog"]; "6041" where bit 12 of its statusword is never set."""
    write: tuple[ObjectWrite, ...] = ()
    """Objects of its maker's that it is to be given."""


class Drives(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [drives]: what all three share, and one table for each."""

    protocol: Literal["cia402", "odrive"]
    """What the drives speak: CiA 402 on CANopen, or ODrive's CANSimple."""
    A: Drive
    B: Drive
    C: Drive
    master_node: NodeId = 126
    """The node id of the service itself, for its heartbeat on CANopen."""
    heartbeat: Annotated[float, Meta(ge=0.001, le=21.845)] = 0.1
    """Period of everyone's heartbeat [s], which an ODrive must have been given; three missed ones are a loss."""
    missed_positions: Annotated[int, Meta(ge=1, le=1000)] = 3
    """So many cycles in a row without a drive's position are a loss of that drive."""
    following_error: Distance = 0.005
    """The drives' own window [m], object 6065h; the driver's for ODrives. Wider than `[limits.slider] following_error`:
    the service stops all three before one of them faults."""
    quick_stop_deceleration: Acceleration = 10.0
    """The quick-stop ramp [m/s²]: the drives' own, object 6085h; the driver's for ODrives."""
    stop_timeout: Timeout = 1.0
    """How long a drive may take to lose its power, down the quick-stop ramp or when it is disabled [s]."""
    sdo_timeout: Timeout = 0.5
    """How long a drive may take to answer at set-up, and to have what was written [s]; ten times that to boot."""

    @property
    def each(self) -> tuple[Drive, Drive, Drive]:
        """The three drives in the order of the sliders."""
        return self.A, self.B, self.C
