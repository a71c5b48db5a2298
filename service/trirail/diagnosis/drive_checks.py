"""What is said of the drives: whether they are alike, their zero, what they may lack, and the load of their bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from statistics import median

from trirail_drivers.bus.load import HIGH
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS

from trirail.config import Config
from trirail.diagnosis.check import Check, Judgement
from trirail.diagnosis.stopping import stops

GROSS = 8.0
"""Three drives of one robot differ by less in what a metre is to them, if all are meant."""
_NUMBERS = ("counts_per_metre", "revolutions_per_metre")
_UNITS = ("velocity_unit", "acceleration_unit")


def _alike(config: Config) -> Iterator[Check]:
    """The one that differs from the other two."""
    drives = dict(zip(NAMES, config.drives.each, strict=True))
    wrong = False
    for key in _NUMBERS:
        given = {name: getattr(drive, key) for name, drive in drives.items() if getattr(drive, key) is not None}
        usual = median(given.values()) if len(given) == len(NAMES) else 0.0
        for name, number in given.items():
            if usual and not 1.0 / GROSS < number / usual < GROSS:
                wrong = True
                said = f"drives.{name}.{key} = {number:g} is {number / usual:.3g} times that of the others"
                remedy = "would it move as far? counts a turn * gear ratio / lead of the screw [m]"
                yield Check("drives alike", "warning", said, remedy, f"drives.{name}.{key}")
    for key in _UNITS:
        usual_unit, times = Counter(getattr(drive, key) for drive in drives.values()).most_common(1)[0]
        for name, drive in drives.items():
            if times > 1 and (unit := getattr(drive, key)) != usual_unit:
                wrong = True
                said = f"drives.{name}.{key} is {unit or 'none'}, of the others {usual_unit or 'none'}"
                yield Check("drives alike", "warning", said, "are they of one make?", f"drives.{name}.{key}")
    if not wrong:
        yield Check("drives alike", "ok", "the three count alike")


def _zero(config: Config) -> Iterator[Check]:
    """Where a drive counts zero, or is homed, its slider is on the rail, or an absolute encoder's zero is elsewhere."""
    found = stops(config)
    low, high = found.rail or found.travel
    for name, drive in zip(NAMES, config.drives.each, strict=True):
        if min(low, found.travel[0]) <= drive.offset <= max(high, found.travel[1]):
            continue
        homes, key = drive.homing is not None, f"drives.{name}.offset"
        what = "its home" if homes else "zero counts"
        said = f"{key} = {drive.offset:g} m: {what} would be off the rail, which is [{low:.4g}, {high:.4g}]"
        remedy = "metres, with the sign of slider positions"
        remedy += "" if homes else "; right only where an absolute encoder has its zero there"
        yield Check("offset", "failure" if homes else "warning", said, remedy, key)


def protections(config: Config) -> Iterator[Check]:
    """What the configuration lets the drives lack of what would stop them where the service cannot."""
    known = PROTOCOLS[config.drives.protocol].protections
    drives: dict[str, list[str]] = {}
    for name, drive in zip(NAMES, config.drives.each, strict=True):
        for protection in drive.accept_without:
            drives.setdefault(protection, []).append(name)
    remedy = "named in accept_without; trirail drives CONFIG tells what each drive lacks"
    for name, of in drives.items():
        said = f"drives {', '.join(of)} may lack {name}, {known[name]}"
        yield Check(f"lacking {name}", "warning", said, remedy, f"drives.{of[0]}.accept_without")
    if not drives:
        yield Check("protections", "ok", "no drive may lack any")


def windows(config: Config) -> Iterator[Check]:
    """Who notices a following error first: the service, which then stops all three, or one drive, by its own fault."""
    ours, theirs = config.limits.slider.following_error, config.drives.following_error
    if theirs > ours:
        return
    found = f"drives.following_error = {theirs:g} m is not more than limits.slider.following_error, {ours:g} m"
    remedy = f"a drive faults before the service stops all three: drives.following_error beyond {ours:g}"
    yield Check("following error", "warning", found, remedy, "drives.following_error")


def load(config: Config) -> Iterator[Check]:
    """The share of the bus that the cycle takes at worst, as the driver counts it."""
    rate, bitrate, drives = config.loop.rate_hz, config.can.bitrate, config.drives
    traffic = PROTOCOLS[drives.protocol].traffic
    share = traffic.bus_load(rate, bitrate, drives.heartbeat)
    found = f"{share:.0%} of {bitrate} bit/s at {rate} Hz"
    if share <= HIGH:
        yield Check("bus load", "ok", found)
        return
    remedy = f"loop.rate_hz below {HIGH * traffic.highest_rate(bitrate, drives.heartbeat):.0f}, or a higher bitrate"
    yield Check("bus load", "failure" if share > 1.0 else "warning", found, remedy, "loop.rate_hz")


def _each(*keys: str) -> tuple[str, ...]:
    return tuple(f"drives.{name}.{key}" for name in NAMES for key in keys)


JUDGEMENTS = (
    Judgement(_each(*_NUMBERS, *_UNITS), _alike),
    Judgement((*_each("offset", "homing"), "limits.slider", "drives.quick_stop_deceleration", "geometry"), _zero),
    Judgement(("drives.protocol", *_each("accept_without")), protections),
    Judgement(("limits.slider.following_error", "drives.following_error"), windows),
    Judgement(("loop.rate_hz", "can.bitrate", "drives.protocol", "drives.heartbeat"), load),
)
