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
    """How the simulated sliders A, B, C are built and wired, for `trirail commission` to find out where [drives] says
    otherwise; faults on demand start from it. As [drives] says, if absent."""


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
    """Bits per second: for the bus load, and for interfaces that set it themselves. A wire has at most 1 Mbit/s."""
    options: dict[OptionName, bool | OptionNumber | Name] = {}
    """Handed to python-can as they are: `index` of gs_usb, `host` and `port` of socketcand, `tty_baudrate` of slcan."""
    simulated: Simulated = Simulated()


class Homing(Struct, frozen=True, forbid_unknown_fields=True):
    """How a drive with an incremental encoder finds its zero, in homing mode: [drives.A.homing], and so on."""

    method: Annotated[int, Meta(ge=-128, le=127)]
    """Object 6098h. Its directions are those of the drive's own counts; negative ones are the maker's."""
    speed_switch: Velocity
    """Object 6099h:01, while the switch is searched [m/s]."""
    speed_zero: Velocity
    """Object 6099h:02, while its edge or the index pulse is searched [m/s]."""
    acceleration: Acceleration
    """Object 609Ah [m/s²]."""
    timeout: Annotated[float, Meta(ge=0.01, le=180.0)] = 60.0
    """How long it may take [s]; so it bounds the way that a slider goes where it meets no switch."""

    def __post_init__(self) -> None:
        if self.method == 0:
            raise ValueError("method 0 is no homing: leave the table out where the encoder is absolute")


class ObjectWrite(Struct, frozen=True, forbid_unknown_fields=True):
    """An object of the drive's maker that is given a value when the drive is set up, and read back: for what the set-up
    does not do itself. Node id, bitrate and what stores are refused."""

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
    """Its maker's EDS, relative to the configuration file: which objects are mappable, and what types those have that
    cannot be read. All else the drive is asked for."""
    velocity_unit: UnitName | None = None
    """The drive's unit of velocity, as "counts/s", "0.1 counts/s", "rpm", "deg/s", "mm/s": wanted where it does not
    tell (objects 60A9h, 6096h); refused where it contradicts the drive."""
    acceleration_unit: UnitName | None = None
    """The drive's unit of acceleration, as "counts/s2", "rpm/s", "rev/s2", "mm/s2": wanted where it does not tell
    (objects 60AAh, 6097h); refused where it contradicts the drive."""
    revolutions_per_metre: Annotated[float, Meta(ge=1e-6, le=1e9)] | None = None
    """Revolutions by which the drive counts velocities, per metre of the slider: wanted where these are in rpm or
    the like and the drive does not tell how many counts a revolution has."""
    endpoints: Name | None = None
    """An ODrive's flat_endpoints.json, relative to the configuration file: the maker's, for its firmware and hardware,
    where trirail has not the numbers of its settings."""
    accept_without: tuple[ProtectionName, ...] = ()
    """Protections that the drive may lack, each named by its object, as ["1006", "6007"], or an ODrive's setting, as
    ["enable_watchdog"]: those of the tables in drivers/README.md; "6041" where bit 12 of its statusword says
    nothing."""
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
    """Period of everyone's heartbeat [s]; three missed ones are a loss. An ODrive must have been given it."""
    missed_positions: Annotated[int, Meta(ge=1, le=1000)] = 3
    """So many cycles in a row without a drive's position are a loss of that drive."""
    following_error: Distance = 0.005
    """The following error window [m]: the drives' own, object 6065h; for ODrives, which have none, the driver's. Wider
    than `[limits.slider] following_error`, so that the service stops all three before one of them faults."""
    quick_stop_deceleration: Acceleration = 10.0
    """The quick-stop ramp [m/s²]: the drives' own, object 6085h; for ODrives, which have none, the driver's."""
    stop_timeout: Timeout = 1.0
    """How long a drive may take to lose its power, down the quick-stop ramp or when it is disabled [s]."""
    sdo_timeout: Timeout = 0.5
    """How long a drive may take to answer a configuration request, and to have what was written [s]; CiA 402 drives ten
    times that to boot."""

    @property
    def each(self) -> tuple[Drive, Drive, Drive]:
        """The three drives in the order of the sliders."""
        return self.A, self.B, self.C
