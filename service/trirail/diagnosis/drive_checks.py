"""Checks of the drives: differences between them, zero position, missing protections, following error and bus load."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from statistics import median

from msgspec import Struct
from trirail_drivers.bus.load import HIGH_LOAD, TrafficPlan, usage
from trirail_drivers.config import Can
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS

from trirail.config import Config
from trirail.diagnosis.check import Check, ConfigCheck
from trirail.diagnosis.stopping import each_stops

MAX_SCALE_RATIO = 8.0
"""Greatest plausible ratio between the scales of two drives of one robot."""
_NUMBERS = ("counts_per_metre", "revolutions_per_metre")
_UNITS = ("velocity_unit", "acceleration_unit")
_BUS = ("can.bitrate", "can.fd", "can.data_bitrate")


def _alike(config: Config) -> Iterator[Check]:
    """Find drives with a scale or a unit that differs from the other drives."""
    drives = dict(zip(NAMES, config.drives.each, strict=True))
    wrong = False
    for key in _NUMBERS:
        numbers = {name: getattr(drive, key) for name, drive in drives.items() if getattr(drive, key) is not None}
        usual = median(numbers.values()) if len(numbers) == len(NAMES) else 0.0
        for name, number in numbers.items():
            if usual and not 1.0 / MAX_SCALE_RATIO < number / usual < MAX_SCALE_RATIO:
                wrong = True
                finding = f"drives.{name}.{key} = {number:g} is {number / usual:.3g} times that of the others"
                remedy = "check it: counts per turn * gear ratio / lead of the screw [m]"
                yield Check("drives alike", "warning", finding, remedy, f"drives.{name}.{key}")
    for key in _UNITS:
        usual_unit, times = Counter(getattr(drive, key) for drive in drives.values()).most_common(1)[0]
        for name, drive in drives.items():
            if times > 1 and (unit := getattr(drive, key)) != usual_unit:
                wrong = True
                finding = f"drives.{name}.{key} is {unit or 'none'}, that of the others {usual_unit or 'none'}"
                yield Check(
                    "drives alike",
                    "warning",
                    finding,
                    "correct it if all three are of one make",
                    f"drives.{name}.{key}",
                )
    if not wrong:
        yield Check("drives alike", "ok", "all three have similar scales and units")


def _zero(config: Config) -> Iterator[Check]:
    """Check that the zero or home position of each drive is on the rail.

    The result is only a warning for drives without homing, since the zero of an absolute encoder may be off the rail.
    """
    for name, drive, stop in zip(NAMES, config.drives.each, each_stops(config), strict=True):
        low, high = stop.rail or stop.travel
        if min(low, stop.travel[0]) <= drive.offset <= max(high, stop.travel[1]):
            continue
        homes, key = drive.homing is not None, f"drives.{name}.offset"
        zero = "its home" if homes else "its zero count"
        finding = f"{key} = {drive.offset:g} m: {zero} would be off the rail, which is [{low:.4g}, {high:.4g}]"
        remedy = "use metres, with the sign of slider positions"
        remedy += "" if homes else "; correct only for an absolute encoder with its zero there"
        yield Check("offset", "failure" if homes else "warning", finding, remedy, key)


def protections(config: Config) -> Iterator[Check]:
    """Report the protections that the drives may lack according to `accept_without`.

    Protections stop a drive when the service cannot stop it.
    """
    known = PROTOCOLS[config.drives.protocol].protections
    drives: dict[str, list[str]] = {}
    for name, drive in zip(NAMES, config.drives.each, strict=True):
        for protection in drive.accept_without:
            drives.setdefault(protection, []).append(name)
    remedy = "listed in accept_without; trirail drives CONFIG shows the missing protections of each drive"
    for name, lacking in drives.items():
        finding = f"drives {', '.join(lacking)} may lack {name}, {known[name]}"
        yield Check(f"lacking {name}", "warning", finding, remedy, f"drives.{lacking[0]}.accept_without")
    if not drives:
        yield Check("protections", "ok", "no drive may lack a protection")


def windows(config: Config) -> Iterator[Check]:
    """Check that the service detects a following error before the drive detects it.

    The service then stops all three drives. A drive would stop only itself.
    """
    ours, theirs = config.limits.slider.following_error, config.drives.following_error
    if theirs > ours:
        return
    finding = f"drives.following_error = {theirs:g} m is not more than limits.slider.following_error, {ours:g} m"
    remedy = f"set it above {ours:g}: else a drive faults before the service stops all three"
    yield Check("following error", "warning", finding, remedy, "drives.following_error")


class BusUse(Struct, frozen=True):
    """Use of the bus by the cycle, in the worst case, in a form for programs."""

    channel: str
    bitrate: int
    """Bit rate [bit/s]."""
    rate_hz: int
    load: float
    """Fraction of the bus capacity in use; 1.0 is a full bus."""
    budget_us: float
    """Part of each cycle that the bus leaves to the loop [µs]."""
    setpoint_bytes: int
    """Data length of a setpoint [bytes]."""
    velocity_offset: bool
    """True if the setpoints contain a velocity for feed-forward, in drives that accept one."""
    load_with_velocity_offset: float | None
    """Load that is the reason to leave the velocity offset out; None if it is not left out for this reason."""


def plan_traffic(config: Config) -> TrafficPlan:
    """Return the frames that a configuration puts on the bus if the drives have every optional object."""
    protocol = PROTOCOLS[config.drives.protocol]
    return protocol.plan_traffic(config.drives, config.drive_io, config.loop.rate_hz, config.can.timing)


def bus_use(config: Config) -> BusUse:
    """Return the expected use of the bus by a configuration."""
    plan, can, rate = plan_traffic(config), config.can, config.loop.rate_hz
    return BusUse(
        channel=can.channel,
        bitrate=can.bitrate,
        rate_hz=rate,
        load=plan.traffic.bus_load(rate, can.timing, config.drives.heartbeat),
        budget_us=setpoint_budget_us(config),
        setpoint_bytes=plan.setpoint_bytes,
        velocity_offset=plan.velocity_offset,
        load_with_velocity_offset=plan.full_load,
    )


def usage_of(config: Config, load: float) -> str:
    """Return the share of the configured bus that the cycle uses in the worst case, such as "1 kHz uses 75 % of can0".

    For a channel whose name says little, such as an address, the bus has no name.
    """
    return usage(config.loop.rate_hz, load, config.can.channel if config.can.interface == "socketcan" else "the bus")


def setpoint_budget_us(config: Config) -> float:
    """Return the part of the cycle that the bus leaves to the loop [µs], as in trirail.wire.state.LoopState."""
    share = plan_traffic(config).traffic.bus_load(config.loop.rate_hz, config.can.timing, config.drives.heartbeat)
    return max(0.0, 1.0 - share) * config.period * 1e6


def _faster(section: Can) -> str:
    """Return the setting of the bus that lets its frames take less time."""
    return "a higher data_bitrate" if section.fd else "a higher bitrate"


def load(config: Config) -> Iterator[Check]:
    """Check the fraction of the bus capacity that the cycle uses in the worst case."""
    rate, timing, drives = config.loop.rate_hz, config.can.timing, config.drives
    plan = plan_traffic(config)
    frames = plan.traffic
    share = frames.bus_load(rate, timing, drives.heartbeat)
    left = f"{setpoint_budget_us(config):.0f} µs of each cycle are left to the loop" if share < 1.0 else ""
    finding = f"{usage_of(config, share)} at {timing}"
    finding = "; ".join(filter(None, (": ".join(filter(None, (finding, plan.omission))), left)))
    if share > HIGH_LOAD:
        highest = HIGH_LOAD * frames.highest_rate(timing, drives.heartbeat)
        remedy = f"set loop.rate_hz below {highest:.0f}, or {_faster(config.can)}"
        remedy = "; or ".join(filter(None, (remedy, plan.remedy)))
        yield Check("bus load", "failure" if share > 1.0 else "warning", finding, remedy, "loop.rate_hz")
    elif plan.full_load is not None:
        # The load minus the background is proportional to the rate.
        background = frames.background(timing, drives.heartbeat)
        highest = rate * (HIGH_LOAD - background) / (plan.full_load - background)
        remedy = (
            f"the drives follow with more lag; for the velocity offset, set loop.rate_hz below {highest:.0f}; "
            'if the lag is acceptable, set drives.velocity_offset = "never"'
        )
        yield Check("bus load", "warning", finding, remedy, "drives.velocity_offset")
    else:
        yield Check("bus load", "ok", finding)


def _each(*keys: str) -> tuple[str, ...]:
    return tuple(f"drives.{name}.{key}" for name in NAMES for key in keys)


CONFIG_CHECKS = (
    ConfigCheck(_each(*_NUMBERS, *_UNITS), _alike),
    ConfigCheck((*_each("offset", "homing"), "limits.slider", "drives.quick_stop_deceleration", "geometry"), _zero),
    ConfigCheck(("drives.protocol", *_each("accept_without")), protections),
    ConfigCheck(("limits.slider.following_error", "drives.following_error"), windows),
    ConfigCheck(("loop.rate_hz", *_BUS, "drives.protocol", "drives.heartbeat", "drives.velocity_offset"), load),
)
