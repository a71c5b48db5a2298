"""Sections [can] and [drives] of the configuration file."""

from __future__ import annotations

from typing import Annotated, Final, Literal, NamedTuple

from msgspec import Meta, Struct

from trirail_drivers.timing import DEFAULT_BITRATE, BusTiming

# The bounds exclude values that no machine of this kind has, so that no later calculation overflows or loses precision.
Coordinate = Annotated[float, Meta(ge=-100.0, le=100.0)]
"""Position [m]."""
Distance = Annotated[float, Meta(ge=1e-6, le=1.0)]
"""Small length, such as a following error [m]."""
Velocity = Annotated[float, Meta(ge=1e-5, le=100.0)]
"""Velocity [m/s] or [rad/s]."""
Acceleration = Annotated[float, Meta(ge=1e-4, le=1e4)]
"""Acceleration [m/s²] or [rad/s²]."""
Timeout = Annotated[float, Meta(ge=0.01, le=600.0)]
"""Time [s]."""
NO_LINE_BREAK: Final = r"(?!\n)"
"""End of the patterns of names, since in Python "$" also matches before a line break at the end of a text."""
Name = Annotated[str, Meta(max_length=4096, pattern=r"^[^\x00-\x1f\x7f]*$(?!\n)")]
"""Name of a file or a device, without control characters."""
UnitName = Annotated[str, Meta(max_length=32)]
"""Unit of velocity or acceleration."""
ProtectionName = Annotated[str, Meta(max_length=64, pattern=r"^([0-9A-F]{4}(:[0-9A-F]{2})?|[a-z_]+)$(?!\n)")]
"""Index of an object in hexadecimal, such as 605A, or name of an ODrive setting, such as enable_watchdog."""
NodeId = Annotated[int, Meta(ge=0, le=127)]
"""Node id: CANopen allows 1 to 127, ODrive 0 to 62; the driver refuses other values."""

CountsPerMetre = Annotated[float, Meta(ge=1e-3, le=1e12)]


class SimulatedSlider(Struct, frozen=True, forbid_unknown_fields=True):
    """Actual axis of a simulated slider, which may differ from the settings in [drives]."""

    node: NodeId
    """Node id of the slider's drive."""
    counts_per_metre: CountsPerMetre
    """Resolution of the slider's encoder, as in [drives]."""
    direction: Literal[1, -1] = 1
    """-1 if the counts decrease as the slider position increases."""


class Simulated(Struct, frozen=True, forbid_unknown_fields=True):
    """Behaviour of the simulated drives; used only with interface = "simulated"."""

    time_constant: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.004
    """First-order lag of the servo behind its setpoint [s]."""
    feed_forward_gain: Annotated[float, Meta(ge=0.0, le=2.0)] = 1.0
    """Fraction of the velocity feed-forward that the servo uses; the servo follows the rest with a lag."""
    max_velocity: Velocity = 2.0
    """Largest velocity of the slider [m/s]."""
    max_acceleration: Acceleration = 100.0
    """Largest acceleration of the slider [m/s²]."""
    missed_syncs: Annotated[int, Meta(ge=1, le=100_000)] = 3
    """Number of consecutive missed SYNCs after which a CiA 402 drive stops by itself; an ODrive has its watchdog
    instead.
    """
    start: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    """Slider positions at power-on [m]."""
    built: tuple[SimulatedSlider, SimulatedSlider, SimulatedSlider] | None = None
    """Actual axes of the simulated sliders, if they differ from the settings in [drives]. `trirail commission` has to
    find these differences.
    """


OptionNumber = Annotated[int, Meta(ge=-(10**12), le=10**12)] | Annotated[float, Meta(ge=-1e12, le=1e12)]
OptionName = Annotated[str, Meta(max_length=64, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$(?!\n)")]
"""Keyword argument of a python-can bus."""


DATA_BITRATE: Final = 5_000_000
"""Data bit rate of a CAN FD bus if none is configured [bit/s]."""


class Can(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [can]: any python-can interface, or "simulated" (three drives inside the service)."""

    interface: Name
    """`simulated`, or the name of a python-can interface, such as `socketcan`."""
    channel: Name = ""
    """Channel of the interface, such as `can0`."""
    bitrate: Annotated[int, Meta(ge=10_000, le=8_000_000)] = DEFAULT_BITRATE
    """Bit rate [bit/s], at most 1 Mbit/s on a physical bus. The bus load is calculated from this value, and interfaces
    that set the bit rate themselves use it.
    """
    fd: bool = False
    """Whether the bus is a CAN FD bus: every data frame is sent as a CAN FD frame with bit rate switch, with at most 8
    data bytes. Only CiA 402 drives on `socketcan`, `unix` or `simulated`.
    """
    data_bitrate: Annotated[int, Meta(ge=10_000, le=8_000_000)] | None = None
    """Bit rate of the data phase of CAN FD frames [bit/s], at least `bitrate`; 5 Mbit/s if omitted. Not without `fd`.
    """
    options: dict[OptionName, bool | OptionNumber | Name] = {}
    """Options passed to python-can unchanged: `index` of gs_usb, `host` and `port` of socketcand, `tty_baudrate` of
    slcan.
    """
    simulated: Simulated = Simulated()

    @property
    def timing(self) -> BusTiming:
        """Bit rates of the bus."""
        return BusTiming(self.bitrate, (self.data_bitrate or DATA_BITRATE) if self.fd else None)


class Homing(Struct, frozen=True, forbid_unknown_fields=True):
    """Homing of a drive with an incremental encoder, in homing mode: sections [drives.A.homing], and so on."""

    method: Annotated[int, Meta(ge=-128, le=127)]
    """Homing method, object 6098h.

    Directions are those of the drive's counts; negative methods are manufacturer-specific.
    """
    speed_switch: Velocity
    """Speed during the search for the switch, object 6099h:01 [m/s]."""
    speed_zero: Velocity
    """Speed during the search for the edge of the switch or the index pulse, object 6099h:02 [m/s]."""
    acceleration: Acceleration
    """Homing acceleration, object 609Ah [m/s²]."""
    timeout: Annotated[float, Meta(ge=0.01, le=180.0)] = 60.0
    """Longest duration of homing [s], which limits the travel of a slider that reaches no switch."""

    def __post_init__(self) -> None:
        if self.method == 0:
            raise ValueError("method 0 means no homing: omit the table if the encoder is absolute")


class ObjectWrite(Struct, frozen=True, forbid_unknown_fields=True):
    """Manufacturer-specific object that is written and read back at set-up. An object is refused if the set-up itself
    writes it, if it changes the node id or the bit rate, or if it stores parameters.
    """

    object: Annotated[int, Meta(ge=0x1000, le=0xFFFF)]
    """Index, such as 0x208E."""
    value: Annotated[int, Meta(ge=-(2**31), le=2**32 - 1)]
    """Value to write to the object."""
    type: Literal["u8", "u16", "u32", "i8", "i16", "i32"]
    """Data type, as given in the manufacturer's manual."""
    why: Annotated[str, Meta(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$(?!\n)")]
    """Purpose, shown by `trirail drives`."""
    sub: Annotated[int, Meta(ge=0, le=255)] = 0
    """Subindex; 0 if the object has none."""

    def __post_init__(self) -> None:
        low = -(1 << self.bits - 1) if self.signed else 0
        if not low <= self.value < low + (1 << self.bits):
            raise ValueError(f"value {self.value} is not a valid {self.type}")

    @property
    def bits(self) -> int:
        """Length of the value [bits]."""
        return int(self.type[1:])

    @property
    def signed(self) -> bool:
        """Whether the type is signed."""
        return self.type[0] == "i"


class Drive(Struct, frozen=True, forbid_unknown_fields=True):
    """One drive: section [drives.A], [drives.B] or [drives.C]."""

    node: NodeId
    """Node id of the drive: 1 to 127 on CANopen, 0 to 62 for an ODrive."""
    counts_per_metre: CountsPerMetre
    """Drive units of position per metre of slider travel: counts of a CiA 402 drive, turns of an ODrive."""
    direction: Literal[1, -1] = 1
    """-1 if the counts decrease as the slider position increases."""
    offset: Coordinate = 0.0
    """Slider position at zero counts [m]; after homing, the slider position at the home position."""
    homing: Homing | None = None
    """Homing of the drive; None if its encoder is absolute."""
    eds: Name | None = None
    """Path of the manufacturer's EDS, relative to this file. The EDS states which objects can be mapped, and the data
    types that the drive does not report.
    """
    velocity_unit: UnitName | None = None
    """Unit of velocity, such as "0.1 counts/s", "rpm", "deg/s" or "mm/s", for a drive that does not report it (60A9h,
    6096h). A value that contradicts the drive is refused.
    """
    acceleration_unit: UnitName | None = None
    """Unit of acceleration, such as "counts/s2", "rpm/s", "rev/s2" or "mm/s2"; the same rules apply (60AAh, 6097h)."""
    revolutions_per_metre: Annotated[float, Meta(ge=1e-6, le=1e9)] | None = None
    """Revolutions per metre of slider travel. Needed if velocities are in rpm or a similar unit and the drive does not
    report its counts per revolution.
    """
    endpoints: Name | None = None
    """Path of an ODrive's flat_endpoints.json, relative to this file, for firmware or hardware that trirail does not
    know.
    """
    accept_without: tuple[ProtectionName, ...] = ()
    """Protections that the drive is allowed to lack, from the tables in drivers/requirements.md: objects, such as
    ["1006", "6007"], or ODrive settings, such as ["enable_watchdog"]; "6041" if the drive never sets bit 12 of its
    statusword.
    """
    allow_replacement: bool = False
    """Whether a drive with another serial number or firmware may replace this drive while the service runs. Otherwise
    another drive is refused until the service is restarted."""
    write: tuple[ObjectWrite, ...] = ()
    """Manufacturer-specific objects to write at set-up."""


class DigitalIo(NamedTuple):
    """Digital outputs and inputs of one drive that the robot uses, as bits of objects 60FEh and 60FDh."""

    outputs: int = 0
    """Mask of the outputs."""
    safe: int = 0
    """Safe values of the outputs, applied at set-up and when the service ends."""
    inputs: int = 0
    """Mask of the inputs."""


DriveIo = tuple[DigitalIo, DigitalIo, DigitalIo]
"""Digital outputs and inputs of the drives A, B, C."""
NO_IO: DriveIo = DigitalIo(), DigitalIo(), DigitalIo()
"""Digital I/O of three drives without outputs and inputs."""


class Drives(Struct, frozen=True, forbid_unknown_fields=True):
    """Section [drives]: settings of all three drives, and one table for each."""

    protocol: Literal["cia402", "odrive"]
    """Protocol of the drives: CiA 402 on CANopen, or CANSimple of ODrive."""
    A: Drive
    B: Drive
    C: Drive
    master_node: NodeId = 126
    """Node id of the service itself, used for its heartbeat on CANopen."""
    heartbeat: Annotated[float, Meta(ge=0.001, le=21.845)] = 0.1
    """Heartbeat period of the drives and the service [s]; an ODrive must be set to this period. A drive is lost after
    three missed heartbeats.
    """
    missed_positions: Annotated[int, Meta(ge=1, le=1000)] = 3
    """Number of consecutive cycles without a position from a drive after which the drive is lost. Statuswords of CiA
    402 drives may be missing for the same time, and for at least 0.3 s.
    """
    following_error: Distance = 0.005
    """Window of the following error [m] that the drives monitor, object 6065h; for ODrives, the driver monitors it. The
    window should be wider than `[limits.slider] following_error`, so that the service stops all three drives before a
    drive reports a fault; `trirail doctor` warns otherwise.
    """
    quick_stop_deceleration: Acceleration = 10.0
    """Deceleration of the quick-stop ramp [m/s²], object 6085h; for ODrives, the driver generates the ramp."""
    stop_timeout: Timeout = 1.0
    """Longest time until a drive has lost power after a quick stop or after it is disabled [s]."""
    sdo_timeout: Timeout = 0.5
    """Longest time until a drive answers at set-up, or until a written value takes effect [s]. A drive may take ten
    times as long to boot.
    """
    velocity_offset: Literal["auto", "always", "never"] = "auto"
    """Use of the velocity offset 60B1h as velocity feed-forward; it lengthens the setpoint PDO of a CiA 402 drive from
    4 to 8 bytes. With `"auto"`, all three drives use it unless the worst-case bus load would then exceed 80 %.
    Without it, drives follow with more lag. A drive without 60B1h, or with a fixed PDO mapping, keeps what it has.
    """

    @property
    def each(self) -> tuple[Drive, Drive, Drive]:
        """The three drives in the order of the sliders."""
        return self.A, self.B, self.C
