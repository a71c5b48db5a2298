"""Check of a log of CAN frames against CiA 301, CiA 402 and the robot's limits.

    python tools/bus_log.py LOG CONFIG [--missed N]

LOG is in candump's format (candump -L can0), and CONFIG is the robot's configuration. The program prints the problems,
one line each, and exits 1 if there are any. hil.py uses the same functions.

The check has its own tables of the standards, and shares no code with the driver except the layout of the frames.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from can import CanutilsLogReader
from trirail.config import Config, load
from trirail.errors import TrirailError
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.config import Drive
from trirail_drivers.interface import NAMES
from trirail_drivers.timing import BusTiming

HELD = {
    "SYNC": "every SYNC is a tick of the period: none too early, none in a burst, none but the missed ones lacking",
    "setpoints": "one per drive and SYNC, within the limits, without a step in position, velocity or acceleration",
    "power": "controlwords and states in CiA 402's order, each state asked for, no power without a setpoint",
    "order": "SDO requests follow the setpoints of their cycle, except controlwords that stop a drive",
    "gap": "the service sends nothing in the frame time before a tick, except in a cycle with late setpoints, and "
    "controlwords for a quick stop",
    "capture": "the service's own log has the same frames in the same order",
}
"""Properties that are proved if `problems` and `differences` find nothing."""

STATES = {
    0x00: "not ready to switch on",
    0x40: "switch on disabled",
    0x21: "ready to switch on",
    0x23: "switched on",
    0x27: "operation enabled",
    0x07: "quick stop active",
    0x0F: "fault reaction active",
    0x08: "fault",
}
"""States by bits 0 to 3, 5 and 6 of the statusword 6041h. Bit 5 has no meaning in the first state, nor in the states
with bit 3 or 6.
"""

ASKED_BY = {
    ("not ready to switch on", "switch on disabled"): None,
    ("switch on disabled", "ready to switch on"): {0x06},
    ("ready to switch on", "switched on"): {0x07},
    ("switched on", "operation enabled"): {0x0F},
    ("operation enabled", "switched on"): {0x07},
    ("switched on", "ready to switch on"): {0x06},
    ("operation enabled", "ready to switch on"): {0x06},
    ("operation enabled", "switch on disabled"): {0x00},
    ("switched on", "switch on disabled"): {0x00, 0x02},
    ("ready to switch on", "switch on disabled"): {0x00, 0x02},
    ("operation enabled", "quick stop active"): {0x02},
    ("quick stop active", "switch on disabled"): None,
    ("fault reaction active", "fault"): None,
    ("fault", "switch on disabled"): {0x80},
}
"""Controlwords that command each transition of CiA 402; None for a transition that a drive makes by itself."""

GRID_TOLERANCE = 1e-3
"""Rounding of timestamps and of the grid of ticks, as a fraction of the period."""
STALLED = 100
"""One SYNC in this number may be late by more than half a period, because the machine stalled."""

ALLOWED_PREDECESSORS = {0x07: {0x06, 0x0F}, 0x0F: {0x07}}
"""Controlwords that may precede each of these controlwords during a power-up."""


class Frame(NamedTuple):
    """Data frame with an 11-bit identifier."""

    t: float
    """Time since 1970 [s]."""
    identifier: int
    data: bytes


class Setpoint(NamedTuple):
    """Setpoint of one drive."""

    t: float
    position: float
    """Position of the slider [m]."""
    velocity: float
    """Velocity feed-forward [m/s]."""


def read(path: Path) -> list[Frame]:
    """Read a log in candump's format."""
    with CanutilsLogReader(path) as log:
        return [Frame(message.timestamp, message.arbitration_id, bytes(message.data)) for message in log]


def problems(log: Sequence[Frame], config: Config, missed: int, until: float) -> list[str]:
    """Return the errors in the frames before the time `until`, one line each; `missed` ticks were reported missing."""
    log = [frame for frame in log if frame.t < until]
    lines = [*sync_problems(log, config.period, missed, until), *order_problems(log)]
    lines += gap_problems(log, config.period, config.can.timing, config.drives.master_node)
    for name, drive in zip(NAMES, config.drives.each, strict=True):
        lines += (f"drive {name}: {problem}" for problem in _setpoint_problems(log, drive, config))
        lines += (f"drive {name}: {problem}" for problem in _power_problems(log, drive.node))
    return lines


def sync_problems(log: Sequence[Frame], period: float, missed: int, until: float) -> list[str]:
    """Return the errors of the SYNCs before the time `until`, given the period [s] and the reported missed ticks."""
    syncs = [frame.t for frame in log if frame.identifier == layout.SYNC and frame.t < until]
    if len(syncs) < 3:
        return [f"SYNC: {len(syncs)} in the log: nothing ran"]
    return list(_sync_problems(syncs, period, missed))


def differences(own: Sequence[Frame], log: Sequence[Frame], until: float) -> list[str]:
    """Return a line for each identifier whose frames in the service's log and on the bus differ before `until`.

    The frames of the service's log must be a contiguous part of those on the bus.
    """
    here, there = _by_identifier([frame for frame in own if frame.t < until]), _by_identifier(log)
    if layout.SYNC not in here:
        return ["the service's log has no SYNC: nothing was captured"]
    lines = []
    for identifier, frames in here.items():
        heard = there.get(identifier, [])
        # The two logs begin and end at different times.
        if not any(heard[start : start + len(frames)] == frames for start in range(len(heard) - len(frames) + 1)):
            problem = f"{len(frames)} frames in the service's log, but others on the bus"
            lines.append(f"identifier {identifier:03X}: {problem}")
    return lines


def statistics(log: Sequence[Frame], config: Config, until: float) -> dict[str, float]:
    """Return statistics of the frames before `until`: numbers of frames, and intervals between SYNCs [ms]."""
    log = [frame for frame in log if frame.t < until]
    syncs = [frame.t for frame in log if frame.identifier == layout.SYNC]
    intervals = sorted(after - before for before, after in itertools.pairwise(syncs))
    return {
        "frames": len(log),
        "syncs": len(syncs),
        "period_ms": round(config.period * 1e3, 3),
        "interval_median_ms": round(intervals[len(intervals) // 2] * 1e3, 3),
        "interval_p99_ms": round(intervals[len(intervals) * 99 // 100] * 1e3, 3),
        "interval_max_ms": round(intervals[-1] * 1e3, 3),
    }


def _by_identifier(log: Sequence[Frame]) -> dict[int, list[bytes]]:
    sorted_out: defaultdict[int, list[bytes]] = defaultdict(list)
    for frame in log:
        sorted_out[frame.identifier].append(frame.data)
    return sorted_out


def _sync_problems(syncs: Sequence[float], period: float, missed: int) -> Iterator[str]:
    """Yield the deviations of the SYNCs from the grid of ticks that begins with the first SYNC.

    A tick that is too late must be skipped, not caught up.
    """
    began = syncs[0]
    for number, t in enumerate(syncs):
        # The grid begins late if the first tick was late, so later ticks may seem early by this lateness.
        if t - began < (number - 1) * period:
            early = number * period - (t - began)
            yield f"SYNC {number} comes {early:.4f} s too early: ticks were caught up in a burst"
            return
    ticks = round((syncs[-1] - began) / period)
    lacking = ticks + 1 - len(syncs)
    # A tick may be late by nearly a period at either end.
    if abs(lacking - missed) > 2:
        yield f"SYNC: {lacking} of {ticks} ticks have none, but the service says that it missed {missed}"


def order_problems(log: Sequence[Frame]) -> Iterator[str]:
    """Yield the SDO requests that are sent between a SYNC and a setpoint of its cycle.

    A frame between them would delay the setpoint. After the setpoints, a request has most of the period for its way.
    """
    request: Frame | None = None
    for frame in log:
        service = frame.identifier & ~0x7F
        if frame.identifier == layout.SYNC:
            request = None
        elif service == layout.SDO_REQUEST and not frame.data.startswith(layout.CONTROLWORD_DOWNLOAD):
            request = request or frame
        elif service == layout.RPDO2 and request is not None:
            yield f"SDO request {request.data.hex()} precedes a setpoint of its cycle, at {request.t:.6f}"
            request = None


def gap_problems(log: Sequence[Frame], period: float, timing: BusTiming, master: int) -> Iterator[str]:
    """Yield the service's frames that are sent in the frame time before a tick, or after it and before its SYNC.

    Such a frame can still be on the bus at the time of the SYNC, and would delay it. The ticks are not in the log: each
    SYNC is late by an unknown time, so the grid of the period begins with the SYNC that is earliest in its period,
    except for one in STALLED: a SYNC that is late by more than half a period seems to be early. A cycle with setpoints
    that are sent so late is late as a whole, and the service counts its setpoints.

    Parameters
    ----------
    period
        Period [s].
    timing
        Bit rates of the bus.
    master
        Node id of the service.

    """
    syncs = [frame.t for frame in log if frame.identifier == layout.SYNC]
    if not syncs:
        return
    began = syncs[0]
    offsets = sorted(t - began - round((t - began) / period) * period for t in syncs)
    began += offsets[len(offsets) // STALLED]
    frame_time = timing.frame_ns(8) * 1e-9
    for cycle in _cycles(log):
        number = math.floor((cycle[0].t - began) / period + GRID_TOLERANCE)
        latest = began + (number + 1) * period - frame_time
        if any(frame.identifier & ~0x7F == layout.RPDO2 and frame.t > latest for frame in cycle):
            continue
        for frame in cycle:
            if frame.t > latest and _is_of_service(frame, master) and not _stops(frame):
                early = (latest + frame_time - frame.t) * 1e6
                yield f"frame {frame.identifier:03X} is sent {early:.0f} µs before the next tick, at {frame.t:.6f}"


def _cycles(log: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
    """Yield the frames of each cycle that the log contains completely: its SYNC and the frames before the next SYNC."""
    at = [number for number, frame in enumerate(log) if frame.identifier == layout.SYNC]
    for first, end in itertools.pairwise(at):
        yield log[first:end]


def _is_of_service(frame: Frame, master: int) -> bool:
    """Return whether the service sends frames with this identifier: NMT, RPDOs, SDO requests and its heartbeat."""
    service, node = frame.identifier & ~0x7F, frame.identifier & 0x7F
    rpdos = (layout.RPDO1, layout.RPDO2, layout.RPDO3, layout.RPDO3 + 0x100)
    return (
        frame.identifier == layout.NMT
        or service in {*rpdos, layout.SDO_REQUEST}
        or (service == layout.HEARTBEAT and node == master)
    )


def _stops(frame: Frame) -> bool:
    """Return whether a frame is a controlword that stops a drive in motion."""
    by_pdo = frame.identifier & ~0x7F == layout.RPDO1 and len(frame.data) == layout.CONTROLWORD.size
    by_sdo = frame.identifier & ~0x7F == layout.SDO_REQUEST and frame.data.startswith(layout.CONTROLWORD_DOWNLOAD)
    word = frame.data if by_pdo else frame.data[4:6] if by_sdo else b"\xff\xff"
    return word == layout.CONTROLWORD.pack(layout.QUICK_STOP)


def _setpoints(log: Sequence[Frame], drive: Drive) -> list[Setpoint]:
    setpoints = []
    for frame in log:
        if frame.identifier == layout.RPDO2 + drive.node:
            position, velocity = layout.SETPOINT.unpack(frame.data)
            factor = drive.direction / drive.counts_per_metre
            setpoints.append(Setpoint(frame.t, position * factor + drive.offset, velocity * factor))
    return setpoints


def _setpoint_problems(log: Sequence[Frame], drive: Drive, config: Config) -> Iterator[str]:
    """Yield violations of limits and of continuity: steps of position must fit the velocity and acceleration limits."""
    limits, period, leg = config.limits.slider, config.period, config.drives.each.index(drive)
    velocity, acceleration = limits.velocities[leg], limits.accelerations[leg]
    count = 1.0 / drive.counts_per_metre
    points = _setpoints(log, drive)
    if not points:
        yield "no setpoint at all"
        return
    low, high = limits.positions[leg]
    for point in points:
        if not low - count <= point.position <= high + count:
            yield f"setpoint {point.position:.6f} m is outside of [{low:g}, {high:g}]"
        if abs(point.velocity) > velocity + count:
            yield f"velocity feed-forward {point.velocity:.6f} m/s is above {velocity:g}"
    for before, after in itertools.pairwise(points):
        step = after.position - before.position
        if abs(step) > velocity * period + 2 * count:
            yield f"step of {step * 1e3:.4f} mm at {after.t:.6f}: {abs(step) / period:.3f} m/s"
        # The velocity changes by at most a·T within the step, so the step is about the mean velocity times the period.
        mean = 0.5 * (before.velocity + after.velocity) * period
        if abs(step - mean) > 0.25 * acceleration * period**2 + 3 * count:
            yield f"step of {step * 1e3:.4f} mm at {after.t:.6f}, but its feed-forward says {mean * 1e3:.4f} mm"
        if abs(after.velocity - before.velocity) > acceleration * period * 1.01 + 2 * count:
            yield f"velocity feed-forward jumps by {after.velocity - before.velocity:.6f} m/s at {after.t:.6f}"
    since_sync = 0
    for frame in log:
        if frame.identifier == layout.SYNC:
            since_sync = 0
        elif frame.identifier == layout.RPDO2 + drive.node:
            since_sync += 1
            if since_sync > 1:
                yield f"two setpoints between one SYNC and the next, at {frame.t:.6f}"


def _power_problems(log: Sequence[Frame], node: int) -> Iterator[str]:
    """Yield errors in the order of controlwords and in the resulting states."""
    word, state = 0x00, ""
    words = {0x00}  # controlwords sent since the drive last reported a change
    setpoint = started = False
    for frame in log:
        if frame.identifier == layout.NMT and frame.data[0] == layout.NMT_START and frame.data[1] in {0, node}:
            started = True
        elif frame.identifier == layout.RPDO2 + node:
            setpoint = True
        elif frame.identifier == layout.RPDO1 + node:
            (new,) = layout.CONTROLWORD.unpack(frame.data)
            if word not in ALLOWED_PREDECESSORS.get(new, {word}):
                yield f"controlword {new:04X} after {word:04X}, at {frame.t:.6f}"
            if new == 0x0F and not setpoint:
                yield f"operation is enabled before there is a setpoint, at {frame.t:.6f}"
            if not started:
                yield f"controlword {new:04X} before NMT start, at {frame.t:.6f}"
            word = new
            words.add(new)
        elif frame.identifier == layout.TPDO1 + node:
            (status,) = layout.STATUSWORD.unpack(frame.data)
            new_state = _state(status)
            if new_state is None:
                yield f"statusword {status:04X} is that of no state"
            elif new_state != state:
                if state:
                    yield from _transition_problems(state, new_state, words, frame.t)
                state, words = new_state, {word}
    if "operation enabled" not in {
        _state(layout.STATUSWORD.unpack(f.data)[0]) for f in log if f.identifier == layout.TPDO1 + node
    }:
        yield "was never in operation enabled"


def _state(status: int) -> str | None:
    return STATES.get(status & 0x6F) or STATES.get(status & 0x4F)


def _transition_problems(before: str, after: str, words: set[int], t: float) -> Iterator[str]:
    if after == "fault reaction active":
        yield f"fault at {t:.6f}"
    elif (before, after) not in ASKED_BY:
        yield f"from {before} to {after} at {t:.6f}: no transition of CiA 402"
    else:
        asked = ASKED_BY[before, after]
        if asked is not None and not asked & words:
            yield f"from {before} to {after} at {t:.6f}, which no controlword asked for"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the problems of a log; return 1 if there are any. Exits with 2 if a file cannot be read."""
    parser = argparse.ArgumentParser(description="Checks a log of CAN frames against CiA 301, CiA 402 and the limits.")
    parser.add_argument("log", type=Path, help="log in candump's format: candump -L can0 > LOG")
    parser.add_argument("config", type=Path, help="configuration of the robot")
    parser.add_argument("--missed", type=int, default=0, help="ticks that the service missed (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        lines = problems(read(options.log), load(options.config), options.missed, math.inf)
    except TrirailError as error:
        parser.error(str(error))
    except OSError as error:
        parser.error(f"{options.log}: {error.strerror}")
    except (ValueError, IndexError):  # python-can has no error of its own for this
        parser.error(f"{options.log} is not in candump's format: write it with candump -L")
    for line in lines:
        print(line)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
