"""Description of the exchange of setpoints and feedback with one drive: mode, PDOs, statusword and supervision."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Final

from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.load import HIGH_LOAD, Traffic, TrafficPlan, percent
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.config import DATA_BITRATE, NO_IO, DigitalIo, Drives
from trirail_drivers.timing import BusTiming

INTERPOLATED_POSITION: Final = 7
CYCLIC_SYNCHRONOUS_POSITION: Final = 8

CONTROLWORD: Final = 0x6040_00_10
STATUSWORD: Final = 0x6041_00_10
ACTUAL_POSITION: Final = 0x6064_00_20
TARGET_POSITION: Final = 0x607A_00_20
VELOCITY_OFFSET: Final = 0x60B1_00_20
INTERPOLATION_DATA: Final = 0x60C1_01_20
DIGITAL_INPUTS: Final = 0x60FD_00_20
DIGITAL_OUTPUTS: Final = 0x60FE_01_20
"""Entries of PDO mappings: index, subindex, number of bits (CiA 301, 1600h)."""

POSITIONS: Final = {CYCLIC_SYNCHRONOUS_POSITION: TARGET_POSITION, INTERPOLATED_POSITION: INTERPOLATION_DATA}
"""Mapping entry of the position setpoint in each mode."""

_FORMATS: Final = {8: "b", 16: "h", 32: "i", 64: "q"}


class SetpointPdo:
    """RPDO of the setpoints: its identifier, and the layout of position, velocity and controlword."""

    __slots__ = ("_layout", "_order", "entries", "identifier", "size")

    def __init__(self, identifier: int, entries: tuple[int, ...]) -> None:
        self.identifier = identifier
        self.entries = entries
        fields = {
            TARGET_POSITION: (0, "i"),
            INTERPOLATION_DATA: (0, "i"),
            VELOCITY_OFFSET: (1, "i"),
            CONTROLWORD: (2, "H"),
        }
        self._order = tuple(fields[entry][0] for entry in entries)
        self._layout = Struct("<" + "".join(fields[entry][1] for entry in entries))
        self.size = self._layout.size

    def frame(self) -> Frame:
        """Return an empty frame, which `fill` then fills in each cycle."""
        return Frame(self.identifier, bytes(self.size))

    def fill(self, frame: Frame, counts: int, velocity: int, controlword: int) -> None:
        """Fill a frame. Raises struct.error if a number is too large."""
        values = counts, velocity, controlword
        frame.fill(self._layout, *[values[field] for field in self._order])

    def offset(self, field: int) -> int:
        """Return the offset of the position (0) or velocity (1) in a frame's data [bytes]; -1 if it is not mapped."""
        if field not in self._order:
            return -1
        before = self.entries[: self._order.index(field)]
        return sum((entry & 0xFF) // 8 for entry in before)

    @property
    def has_velocity(self) -> bool:
        """Whether the setpoint includes a velocity."""
        return VELOCITY_OFFSET in self.entries

    @property
    def has_controlword(self) -> bool:
        """Whether the setpoint's PDO contains the controlword, because there is no separate PDO for the controlword."""
        return CONTROLWORD in self.entries


class FeedbackPdo:
    """TPDO that contains the position, and also the statusword if both are mapped to the same PDO."""

    __slots__ = ("_layout", "_position", "_status", "entries", "has_status", "identifier", "size")

    def __init__(self, identifier: int, entries: tuple[int, ...]) -> None:
        self.identifier = identifier
        self.entries = entries
        self._position = entries.index(ACTUAL_POSITION)
        self.has_status = STATUSWORD in entries
        self._status = entries.index(STATUSWORD) if self.has_status else -1
        formats = ("H" if entry == STATUSWORD else _FORMATS[entry & 0xFF] for entry in entries)
        self._layout = Struct("<" + "".join(formats))
        self.size = self._layout.size

    def offset(self, entry: int) -> int:
        """Return the offset of an entry in a frame's data [bytes]; -1 if the entry is not mapped."""
        if entry not in self.entries:
            return -1
        return sum((each & 0xFF) // 8 for each in self.entries[: self.entries.index(entry)])

    def unpack(self, data: bytes | bytearray) -> tuple[int, int | None]:
        """Return the position [counts], and the statusword or None. Raises struct.error for a wrong length."""
        values = self._layout.unpack(data)
        return values[self._position], values[self._status] if self.has_status else None


def fits_setpoints(entries: tuple[int, ...], mode: int) -> bool:
    """Whether a fixed mapping contains the position setpoint, and no object whose value this service does not know."""
    known = {POSITIONS[mode], VELOCITY_OFFSET, CONTROLWORD}
    return POSITIONS[mode] in entries and set(entries) <= known


def fits_feedback(entries: tuple[int, ...]) -> bool:
    """Whether a fixed mapping contains the position, and only objects of a known length."""
    return ACTUAL_POSITION in entries and all(entry & 0xFF in _FORMATS for entry in entries)


@dataclass(frozen=True, slots=True)
class Exchange:
    """Frames that exchange setpoints and feedback with one drive, and the expected behaviour of the drive."""

    mode: int
    """Mode 6060h: cyclic synchronous position, or interpolated position."""
    setpoints: SetpointPdo
    controlword: int | None
    """Identifier of the controlword's RPDO; None if the controlword is mapped in the setpoint's RPDO."""
    feedback: FeedbackPdo
    status: int | None
    """Identifier of the event-driven TPDO of the statusword; None if the statusword is mapped in the position's TPDO.
    """
    polled: bool = False
    """Whether the statusword is requested by SDO, because no PDO repeats it."""
    guarded: bool = False
    """Whether node guarding is used, because the drive has no heartbeat consumer."""
    heard: bool = True
    """Whether the drive sends heartbeats or answers node guarding."""
    emergency: int = 0
    """Identifier of the drive's EMCY."""
    tells_following: bool = True
    """Whether bit 12 of the statusword must show that the drive follows setpoints."""
    mode_shown: bool = True
    """Whether the drive shows its mode in 6061h even without power."""
    outputs: int | None = None
    """Identifier of the RPDO of the digital outputs, which take effect at the SYNC. None if there are no outputs, or if
    they are written by SDO.
    """
    outputs_kept: int = 0
    """Bits of 60FEh:01 that the robot does not use; they are sent as they were at the set-up."""
    inputs: int | None = None
    """Identifier of the event-driven TPDO of the digital inputs, which may be the statusword's TPDO; None if there are
    no inputs.
    """
    inputs_polled: bool = False
    """Whether the digital inputs are also requested by SDO, because their PDO may be late or is not repeated."""
    unused_rpdos: frozenset[int] = frozenset()
    """Identifiers of the unused RPDOs that cannot be switched off."""
    unused_tpdos: frozenset[int] = frozenset()
    """Identifiers of the unused TPDOs that cannot be switched off."""

    @property
    def status_size(self) -> int:
        """Length of the statusword's TPDO [bytes]."""
        return 6 if self.inputs is not None and self.inputs == self.status else 2

    @property
    def identifiers(self) -> set[int]:
        """Identifiers of the used PDOs and of the EMCY of the drive."""
        each = (
            self.setpoints.identifier,
            self.controlword,
            self.outputs,
            self.feedback.identifier,
            self.status,
            self.inputs,
            self.emergency,
        )
        return {identifier for identifier in each if identifier}

    @property
    def name(self) -> str:
        """Description of the exchange for people."""
        mode = "interpolated position" if self.mode == INTERPOLATED_POSITION else "cyclic synchronous position"
        offset = " with velocity offset" if self.setpoints.has_velocity else ""
        status = "with the position" if self.feedback.has_status else "event-driven" if self.status else ""
        polled = " and polled" if self.polled and status else "polled" if self.polled else ""
        return f"{mode}{offset}, statusword {status}{polled}, {'node guarding' if self.guarded else 'heartbeat'}"


def default_exchange(node: int, io: DigitalIo = NO_IO[0], *, velocity_offset: bool = True) -> Exchange:
    """Return the PDOs for a drive that has every optional object of CiA 301 and CiA 402-2."""
    entries = (TARGET_POSITION, VELOCITY_OFFSET) if velocity_offset else (TARGET_POSITION,)
    return Exchange(
        CYCLIC_SYNCHRONOUS_POSITION,
        SetpointPdo(canopen_frames.RPDO2 + node, entries),
        canopen_frames.RPDO1 + node,
        FeedbackPdo(canopen_frames.TPDO2 + node, (ACTUAL_POSITION,)),
        canopen_frames.TPDO1 + node,
        emergency=canopen_frames.EMCY + node,
        outputs=canopen_frames.RPDO3 + node if io.outputs else None,
        inputs=canopen_frames.TPDO1 + node if io.inputs else None,
    )


def traffic(exchanges: Iterable[Exchange]) -> Traffic:
    """Return the bus traffic of the service and of the drives with these exchanges."""
    exchanges = tuple(exchanges)
    repeated = [exchange.status_size for exchange in exchanges if exchange.status]
    repeated += [canopen_frames.INPUTS.size for exchange in exchanges if exchange.inputs not in (None, exchange.status)]
    polls = 2 * sum(exchange.polled + exchange.inputs_polled for exchange in exchanges)
    return Traffic(
        cycle=(0, *(size for exchange in exchanges for size in (exchange.setpoints.size, exchange.feedback.size))),
        periodic=(
            *((size, canopen_frames.STATUS_PERIOD) for size in repeated),
            *(polls * ((8, canopen_frames.POLL_PERIOD),)),
        ),
        heartbeats=(1,) * (1 + sum(1 + exchange.guarded for exchange in exchanges)),
        most_sent=11 + sum(exchange.guarded + (exchange.polled or exchange.inputs_polled) for exchange in exchanges),
        output=canopen_frames.TRAFFIC.output,
    ).with_outputs(sum(exchange.outputs is not None for exchange in exchanges))


def plan_traffic(drives: Drives, io: Sequence[DigitalIo], rate_hz: float, timing: BusTiming) -> TrafficPlan:
    """Decide whether the setpoints contain the velocity offset, and return the traffic that results.

    The decision assumes that every drive has the velocity offset and is the same for all three drives: a drive without
    velocity feed-forward follows later than the others, which would bend the path of the platform. It depends only on
    the configuration, so that a drive that appears later is set up like the others.
    """
    full, short = (
        traffic(
            default_exchange(drive.node, digital, velocity_offset=velocity_offset)
            for drive, digital in zip(drives.each, io, strict=True)
        )
        for velocity_offset in (True, False)
    )
    load = full.bus_load(rate_hz, timing, drives.heartbeat)
    if drives.velocity_offset == "never":
        plan = TrafficPlan(short, 4, velocity_offset=False)
    elif load <= HIGH_LOAD or drives.velocity_offset == "always":
        plan = TrafficPlan(full)
    else:
        plan = TrafficPlan(short, 4, velocity_offset=False, full_load=load)
    return plan._replace(remedy=", or ".join(_remedies(plan.traffic, short, rate_hz, timing, drives.heartbeat)))


def _remedies(used: Traffic, short: Traffic, rate_hz: float, timing: BusTiming, heartbeat: float) -> Iterator[str]:
    """Yield the settings with which the traffic fits on a bus that is now loaded too highly.

    `short` is the traffic without the velocity offset.
    """
    if used.bus_load(rate_hz, timing, heartbeat) <= HIGH_LOAD:
        return
    if used != short and (load := short.bus_load(rate_hz, timing, heartbeat)) <= 1.0:
        yield f'drives.velocity_offset = "auto" uses {percent(load)}'
    fd = BusTiming(timing.bitrate, DATA_BITRATE)
    if not timing.fd and (load := used.bus_load(rate_hz, fd, heartbeat)) <= HIGH_LOAD:
        yield f"CAN FD (can.fd = true), if the drives and the adapter have it, uses {percent(load)}"
