"""Judges the CAN interface: what the kernel tells of it, and what passes on it."""

from __future__ import annotations

from typing import Any

from trirail_drivers.bus.frames import bits_of
from trirail_drivers.bus.load import HIGH
from trirail_drivers.protocols import PROTOCOLS

from trirail.cli.machine import Gathered, Machine, Passed
from trirail.config import Config
from trirail.diagnosis import Check, Verdict


def can_interface(config: Config, machine: Machine) -> list[Check]:
    """SocketCAN and the interface, as far as the kernel tells of it."""
    section = config.can
    if section.interface in {"simulated", "unix"}:
        return [Check("CAN", "ok", f"{section.interface}: no hardware is used")]
    if section.interface != "socketcan":
        if machine.adapter:
            return [Check("CAN", "failure", f"{section.interface} needs {machine.adapter}")]
        found = f"{section.interface}, channel {section.channel or 'by default'}: its state cannot be read"
        return [Check("CAN", "warning", found, "look at it with its maker's tools; SocketCAN tells its state")]
    if not machine.af_can:
        return [Check("CAN", "failure", "this kernel has no SocketCAN", "modprobe can_raw")]
    return [Check("CAN", "ok", "SocketCAN"), *_link(config, machine), *_traffic(config, machine.passed)]


def _link(config: Config, machine: Machine) -> list[Check]:
    name, bitrate, link = config.can.channel, config.can.bitrate, machine.link
    virtual = name.startswith("vcan")
    up = f"ip link set {name} up" + ("" if virtual else f" type can bitrate {bitrate}")
    if link is None:
        make = f"ip link add {name} type vcan && {up}" if virtual else "plug the adapter in, load its driver"
        return [Check(name, "failure", "no such interface", make)]
    if "UP" not in link.get("flags", ()):
        return [Check(name, "failure", "down", up)]
    info = link.get("linkinfo", {})
    if info.get("info_kind") == "vcan":
        return [Check(name, "ok", "up; virtual, without bitrate and error states")]
    data = info.get("info_data", {})
    queue = _queue(name, link.get("txqlen"), PROTOCOLS[config.drives.protocol].traffic.most_sent)
    return [_bitrate(name, bitrate, data, up), _state(name, data, up), queue, *_coalescing(name, machine.gathered, up)]


def _traffic(config: Config, passed: Passed | None) -> list[Check]:
    """What is on the bus now, of everybody: the service hears only its own drives, and shows no other load."""
    if passed is None:
        return []
    share = bits_of(passed.frames, passed.data) / passed.seconds / config.can.bitrate
    name = f"{config.can.channel} traffic"
    found = f"{share:.1%} of {config.can.bitrate} bit/s, {passed.frames} frames in {passed.seconds:.1f} s, by whomever"
    if share <= HIGH:
        return [Check(name, "ok", found)]
    return [Check(name, "warning", found, f"look who sends: candump {config.can.channel}")]


def _bitrate(name: str, bitrate: int, data: dict[str, Any], up: str) -> Check:
    found = data.get("bittiming", {}).get("bitrate")
    if found == bitrate:
        return Check(f"{name} bitrate", "ok", f"{bitrate} bit/s")
    remedy = f"ip link set {name} down && {up}; the drives must have the same"
    return Check(f"{name} bitrate", "failure", f"{found} bit/s; can.bitrate is {bitrate}", remedy)


def _state(name: str, data: dict[str, Any], up: str) -> Check:
    """The controller's state, ISO 11898-1: a node that sees too many errors leaves the bus."""
    state = str(data.get("state", "unknown")).lower()
    errors = data.get("berr_counter", {})
    counted = f"; errors sent {errors['tx']}, received {errors['rx']}" if errors else ""
    wiring = "look at termination (60 ohm across the bus without power), cable, and the bitrate of every node"
    if state == "error-active":
        return Check(f"{name} state", "ok", f"{state}{counted}")
    if state == "bus-off":
        return Check(f"{name} state", "failure", state, f"{wiring}; then ip link set {name} down && {up}")
    verdict: Verdict = "warning" if state in {"error-warning", "error-passive"} else "failure"
    return Check(f"{name} state", verdict, f"{state}{counted}", wiring)


def _queue(name: str, length: int | None, most_sent: int) -> Check:
    """The kernel's queue must take two cycles' frames, for a late one and the next on time come together."""
    wanted = 2 * most_sent
    if length is None or length >= wanted:
        return Check(f"{name} queue", "ok", f"{length or 'unknown number of'} frames")
    found = f"{length} frames; two cycles may come together and take {wanted}"
    return Check(f"{name} queue", "warning", found, f"ip link set {name} txqueuelen 100")


def _coalescing(name: str, gathered: Gathered | None, up: str) -> list[Check]:
    """A position that waits for frames after it is late, and the last of a cycle may wait for the next cycle."""
    if gathered is None:
        return []
    waits = [f"{gathered.frames} frames"] if gathered.frames > 1 else []
    waits += [f"{gathered.microseconds} µs"] if gathered.microseconds else []
    if not waits:
        return [Check(f"{name} coalescing", "ok", "each frame is handed over as it comes")]
    # ethtool's way to say off: no time, and one frame (Linux, mcp251xfd_ring_alloc).
    remedy = f"ip link set {name} down && ethtool -C {name} rx-usecs-irq 0 rx-frames-irq 1 && {up}"
    return [Check(f"{name} coalescing", "warning", f"frames are handed over after {' or '.join(waits)}", remedy)]
