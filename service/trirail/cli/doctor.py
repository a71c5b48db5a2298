"""Judges a machine and a configuration: each check is a function of what was read, see trirail.cli.probes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from msgspec import Struct
from trirail_drivers.bus.frames import bits_of
from trirail_drivers.bus.load import HIGH
from trirail_drivers.interface import NAMES
from trirail_drivers.protocols import PROTOCOLS

from trirail.cli import units
from trirail.cli.key_folder import Issued
from trirail.config import Config, as_built
from trirail.processes.clock import Tick
from trirail.processes.guard import Guard
from trirail.wire.endpoints import ReachableBy, endpoint_of, reach
from trirail.wire.vocabulary import Role

Verdict = Literal["ok", "warning", "failure"]

RELIABLE_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter", "riscv_clocksource")
"""Clock sources that are read without leaving the processor, or its virtual machine."""
COARSE = 1e-6
"""A clock of a coarser resolution cannot wake anybody in time [s]."""
LATE = 0.1
"""Share of the period by which one tick in a thousand may be late."""


class Check(Struct, frozen=True):
    """What was looked at, what is so, and what to do about it."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""


class Passed(Struct, frozen=True):
    """What the kernel counted on a network interface."""

    seconds: float
    """For how long [s]."""
    frames: int
    """Sent and received, whoever listens."""
    data: int
    """Bytes in them."""


class Machine(Struct, frozen=True):
    """What was read of the machine; None where it does not say."""

    release: str
    preempt_rt: bool
    af_can: bool
    lacking: tuple[str, ...]
    """Real-time rights that the loop would lack, each with its remedy: trirail.processes.realtime.acquire."""
    clock_source: str | None
    resolution: float
    """Of the monotonic clock [s]."""
    cpu: int
    """The processor that the loop would stay on."""
    governor: str | None
    isolated: tuple[int, ...]
    link: dict[str, Any] | None
    """The CAN interface as `ip -details -json link` has it."""
    ticks: tuple[Tick, ...]
    passed: Passed | None = None
    """What passed on the CAN interface meanwhile."""
    adapter: str = ""
    """What python-can's interface would lack, with the remedy; "" for nothing."""
    guard: Guard | str | None = None
    """Who may do what over the network, or why its certificates cannot be used."""
    routers: tuple[tuple[str, str], ...] = ()
    """Each endpoint of zenoh.connect with why it cannot be reached, "" where it can."""
    issued: tuple[Issued, ...] | None = None
    """The certificates of the authority whose folder is that of [zenoh.tls]; None where it is elsewhere."""


def examine(config: Config, machine: Machine) -> list[Check]:
    """Return every check, in order."""
    simulated = config.can.interface in {"simulated", "unix"}
    return [
        kernel(machine, simulated=simulated),
        rights(machine.lacking, config.loop.realtime),
        clock(machine.clock_source, machine.resolution),
        governor(machine.cpu, machine.governor),
        isolation(machine.cpu, machine.isolated, simulated=simulated),
        *can_interface(config, machine),
        *protections(config),
        *corrected(config),
        *windows(config),
        load(config),
        *network(config, machine),
        *routers(machine.routers),
        *metrics(config),
        lateness(machine.ticks, config),
    ]


def kernel(machine: Machine, *, simulated: bool) -> Check:
    """PREEMPT_RT bounds how late a tick can be; simulated drives do not mind."""
    if machine.preempt_rt:
        return Check("kernel", "ok", f"{machine.release}, PREEMPT_RT")
    found = f"{machine.release}, without PREEMPT_RT"
    if simulated:
        return Check("kernel", "ok", f"{found}: enough for simulated drives")
    return Check("kernel", "warning", found, "for a bounded lateness boot one with it: Debian's linux-image-rt-amd64")


def rights(lacking: tuple[str, ...], realtime: str) -> Check:
    """What loop.realtime asks for, and whether the loop would get it."""
    if not lacking:
        return Check("rights", "ok", "SCHED_FIFO, locked memory, a processor of its own")
    if realtime == "off":
        return Check("rights", "warning", lacking[0], 'loop.realtime = "prefer" takes what it gets')
    found = ", ".join(lack.split(";")[0] for lack in lacking)
    remedy = "; ".join(lack.split("; ", 1)[1] for lack in lacking)
    return Check("rights", "failure" if realtime == "enforce" else "warning", f"without {found}", remedy)


def clock(source: str | None, resolution: float) -> Check:
    """The clock that the ticks come from."""
    if resolution > COARSE:
        found = f"{source or 'unknown source'}, resolution {resolution * 1e3:g} ms"
        return Check("clock", "failure", found, "boot a kernel with high-resolution timers (CONFIG_HIGH_RES_TIMERS)")
    if source is None:
        return Check("clock", "ok", f"resolution {resolution * 1e9:g} ns; the machine does not name its source")
    if source in RELIABLE_CLOCKS:
        return Check("clock", "ok", f"{source}, resolution {resolution * 1e9:g} ns")
    remedy = "each reading takes microseconds: look in dmesg why the kernel left tsc; clocksource=tsc asks for it"
    return Check("clock", "warning", f"{source}, resolution {resolution * 1e9:g} ns", remedy)


def governor(cpu: int, name: str | None) -> Check:
    """A processor that sleeps or slows down wakes late."""
    if name is None:
        return Check("governor", "ok", f"processor {cpu} has no frequency scaling to be seen")
    if name == "performance":
        return Check("governor", "ok", f"processor {cpu}: performance")
    return Check("governor", "warning", f"processor {cpu}: {name}", "cpupower frequency-set --governor performance")


def isolation(cpu: int, isolated: tuple[int, ...], *, simulated: bool) -> Check:
    """The loop's processor, for it alone."""
    if cpu in isolated:
        return Check("processor", "ok", f"{cpu}, isolated")
    if simulated:
        return Check("processor", "ok", f"{cpu}, shared: enough for simulated drives")
    elsewhere = f"loop.cpu = {isolated[0]} is isolated; name it" if isolated else "none is isolated"
    remedy = f"boot with isolcpus={cpu} nohz_full={cpu} and set loop.cpu = {cpu}"
    return Check("processor", "warning", f"{cpu}, shared; {elsewhere}", "" if isolated else remedy)


def corrected(config: Config) -> list[Check]:
    """What as-built errors are corrected by: nobody should have to guess that it is on."""
    section = config.correction
    told = as_built.told(section.map, section.as_built, section.backlash)
    return [] if told is None else [Check("correction", "ok", units.correction(told))]


def windows(config: Config) -> list[Check]:
    """Who notices a following error first: the service, which then stops all three, or one drive, by its own fault."""
    ours, theirs = config.limits.slider.following_error, config.drives.following_error
    if theirs > ours:
        return []
    found = f"drives.following_error = {theirs:g} m is not more than limits.slider.following_error, {ours:g} m"
    remedy = f"a drive faults before the service stops all three: drives.following_error beyond {ours:g}"
    return [Check("following error", "warning", found, remedy)]


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
    return [Check("CAN", "ok", "SocketCAN"), *_link(config, machine.link), *_traffic(config, machine.passed)]


def _link(config: Config, link: dict[str, Any] | None) -> list[Check]:
    name, bitrate = config.can.channel, config.can.bitrate
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
    return [_bitrate(name, bitrate, data, up), _state(name, data, up), queue]


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


def protections(config: Config) -> list[Check]:
    """What the configuration lets the drives lack of what would stop them where the service cannot."""
    known = PROTOCOLS[config.drives.protocol].protections
    drives: dict[str, list[str]] = {}
    for name, drive in zip(NAMES, config.drives.each, strict=True):
        for protection in drive.accept_without:
            drives.setdefault(protection, []).append(name)
    remedy = "named in accept_without; trirail drives CONFIG tells what each drive lacks"
    return [
        Check(f"lacking {name}", "warning", f"drives {', '.join(of)} may lack {name}, {known[name]}", remedy)
        for name, of in drives.items()
    ] or [Check("protections", "ok", "no drive may lack any")]


def load(config: Config) -> Check:
    """The share of the bus that the cycle takes at worst, as the driver counts it."""
    rate, bitrate, drives = config.loop.rate_hz, config.can.bitrate, config.drives
    traffic = PROTOCOLS[drives.protocol].traffic
    share = traffic.bus_load(rate, bitrate, drives.heartbeat)
    found = f"{share:.0%} of {bitrate} bit/s at {rate} Hz"
    if share <= HIGH:
        return Check("bus load", "ok", found)
    remedy = f"loop.rate_hz below {HIGH * traffic.highest_rate(bitrate, drives.heartbeat):.0f}, or a higher bitrate"
    return Check("bus load", "failure" if share > 1.0 else "warning", found, remedy)


def network(config: Config, machine: Machine) -> list[Check]:
    """Who can command the robot, endpoint by endpoint, and what is to be said of certificates and users."""
    remedies = {
        ReachableBy.MACHINE: "where others log in too: unixsock-stream/PATH lets in the socket's owner and group alone",
        ReachableBy.NETWORK: "trirail keys init makes certificates for [zenoh.tls]",
    }
    found = []
    for endpoint in config.zenoh.listen:
        by = reach(endpoint)
        verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
        found.append(Check("network", verdict, f"{endpoint}: {by} can command", remedies.get(by, "")))
    if config.zenoh.tls is None:
        return found
    if isinstance(machine.guard, str):
        return [*found, Check("certificates", "failure", machine.guard)]
    if machine.guard is not None:
        users = ", ".join(f"{user} {role}" for user, role in machine.guard.users.items())
        found.append(Check("users", "ok" if users else "warning", users or "none, so nobody can do anything"))
        warnings = machine.guard.certificate_warnings()
        found += [Check("certificates", "warning", warning) for warning in warnings]
        found += without_certificate(machine.guard.users, machine.issued)
    return found


def without_certificate(users: Mapping[str, Role], issued: Sequence[Issued] | None) -> list[Check]:
    """Who has a role and no certificate with which to use it, as far as the authority's folder is here."""
    if issued is None:
        return []
    known = {each.name: each for each in issued}
    found = []
    for user, role in users.items():
        if user not in known:
            found.append(
                Check(
                    "certificates",
                    "warning",
                    f"{user} has a role and no certificate",
                    f"trirail keys add {user} --role {role}",
                )
            )
        elif trouble := known[user].trouble():
            found.append(Check("certificates", "warning", f"{user} cannot connect: {trouble}"))
    return found


def routers(found: Sequence[tuple[str, str]]) -> list[Check]:
    """Whether the routers answer that users come through: without them the robot goes on for who is beside it."""
    remedy = "start trirail router there, or correct zenoh.connect, zenoh.router and certificates"
    return [
        Check("router", "warning", f"{endpoint}: {why}", remedy)
        if why
        else Check("router", "ok", f"{endpoint} answers")
        for endpoint, why in found
    ]


def metrics(config: Config) -> list[Check]:
    """Who can read the metrics, where there are any."""
    telemetry = config.telemetry
    if not telemetry.metrics_port:
        return []
    endpoint = endpoint_of(telemetry.metrics_address, telemetry.metrics_port)
    by = reach(endpoint)
    if by is ReachableBy.NETWORK and config.zenoh.tls is not None:
        by = ReachableBy.CERTIFICATE
    verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
    remedy = "trirail keys init makes certificates for [zenoh.tls]" if by is ReachableBy.NETWORK else ""
    return [Check("metrics", verdict, f"{endpoint}: {by} can read them", remedy)]


def lateness(ticks: Sequence[Tick], config: Config) -> Check:
    """How late ticks come on this machine, as it is now."""
    late = sorted(tick.lateness_ns / 1000.0 for tick in ticks)
    missed, in_a_row = sum(tick.missed for tick in ticks), _longest_streak(ticks)
    p50, p99, p999 = (late[min(len(late) - 1, int(share * len(late)))] for share in (0.5, 0.99, 0.999))
    found = f"p50 {p50:.0f}, p99 {p99:.0f}, p99.9 {p999:.0f}, max {late[-1]:.0f} µs in {len(ticks)} ticks"
    found += f", {missed} missed" if missed else ""
    remedy = "see the lines above; end other programs, or isolate a processor; or lower loop.rate_hz"
    if in_a_row > config.watchdogs.max_overruns:
        return Check("lateness", "failure", f"{found}, {in_a_row} in a row: the service would stop", remedy)
    if missed or p999 > LATE * 1e6 * config.period:
        return Check("lateness", "warning", found, remedy)
    return Check("lateness", "ok", found)


def _longest_streak(ticks: Sequence[Tick]) -> int:
    longest = streak = 0
    for tick in ticks:
        streak = streak + tick.missed if tick.missed else 0
        longest = max(longest, streak)
    return longest
