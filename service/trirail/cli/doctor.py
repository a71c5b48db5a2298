"""Checks of a machine and its network for a configuration. Each check is a function of data from trirail.cli.probes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from trirail_drivers.bus.can_frame import CANFD_FRAME
from trirail_drivers.bus.load import HIGH_LOAD
from trirail_drivers.config import Can

from trirail.cli import notation
from trirail.cli.doctor_cycle import cycle, on_bus
from trirail.cli.key_folder import IssuedCertificate
from trirail.cli.machine import BusTraffic, Machine, ReceiveCoalescing
from trirail.config import Config, Findings, as_built, overlap
from trirail.diagnosis import Check, Verdict, diagnose, failed_checks
from trirail.diagnosis.drive_checks import plan_traffic
from trirail.wire.endpoints import ReachableBy, endpoint_of, reach, tcp_address
from trirail.wire.vocabulary import Role


def network(config: Config, machine: Machine) -> list[Check]:
    """Return the users that can command the robot at each endpoint, and the findings on certificates and users."""
    remedies = {
        ReachableBy.MACHINE: "if others log in here: unixsock-stream/PATH admits only the socket's owner and group",
        ReachableBy.NETWORK: "create certificates for [zenoh.tls] with trirail keys init",
    }
    checks = []
    for endpoint in config.zenoh.listen:
        by = reach(endpoint)
        verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
        checks.append(Check("network", verdict, f"{endpoint}: {by} can command", remedies.get(by, "")))
    if config.zenoh.tls is None:
        return checks
    checks.extend(_connection_limits(config, machine))
    if isinstance(machine.guard, str):
        return [*checks, Check("certificates", "failure", machine.guard)]
    if machine.guard is not None:
        users = ", ".join(f"{user} {role}" for user, role in machine.guard.users.items())
        checks.append(Check("users", "ok" if users else "warning", users or "none: no user can command the robot"))
        warnings = machine.guard.certificate_warnings()
        checks += [Check("certificates", "warning", warning) for warning in warnings]
        checks += without_certificate(machine.guard.users, machine.issued)
    return checks


def _connection_limits(config: Config, machine: Machine) -> list[Check]:
    """Check that the firewall limits the number of connections per address, as far as its rules can be read."""
    ports = {address[1] for each in config.zenoh.listen if (address := tcp_address(each)) is not None}
    if machine.limited_ports is None or not ports:
        return []
    if missing := ports - set(machine.limited_ports):
        listed = ", ".join(map(str, sorted(missing)))
        remedy = f"trirail config copy trirail.nft, set the ports in this file to {listed}, then nft -f trirail.nft"
        return [Check("firewall", "warning", f"one address can keep others from connecting to port {listed}", remedy)]
    return [Check("firewall", "ok", "limits the connections of one address")]


def without_certificate(users: Mapping[str, Role], issued: Sequence[IssuedCertificate] | None) -> list[Check]:
    """Return the users that have a role but no valid certificate in the authority's folder, if it is on this machine.

    A user without a folder may have a certificate, because the folder may have been moved to the user's machine.
    """
    if issued is None:
        return []
    known = {each.name: each for each in issued}
    checks = []
    for user, role in users.items():
        if user not in known:
            checks.append(
                Check(
                    "certificates",
                    "warning",
                    f"{user} has a role, but this machine has no copy of a certificate of {user}",
                    f"if none was issued: trirail keys add {user} --role {role}",
                )
            )
        elif trouble := known[user].trouble():
            checks.append(Check("certificates", "warning", f"{user} cannot connect: {trouble}"))
    return checks


def routers(links: Sequence[tuple[str, str]]) -> list[Check]:
    """Check the routers through which users connect; without routers, the robot serves local users only."""
    remedy = "start the router at this address, or correct zenoh.connect, zenoh.router and certificates"
    return [
        Check("router", "warning", f"{endpoint}: {why}", remedy)
        if why
        else Check("router", "ok", f"{endpoint} answers")
        for endpoint, why in links
    ]


def metrics(config: Config) -> list[Check]:
    """Check which users can read the metrics, if metrics are on."""
    telemetry = config.telemetry
    if not telemetry.metrics_port:
        return []
    endpoint = endpoint_of(telemetry.metrics_address, telemetry.metrics_port)
    by = reach(endpoint)
    if by is ReachableBy.NETWORK and config.zenoh.tls is not None:
        by = ReachableBy.CERTIFICATE
    verdict: Verdict = "warning" if by is ReachableBy.NETWORK else "ok"
    remedy = "create certificates for [zenoh.tls] with trirail keys init" if by is ReachableBy.NETWORK else ""
    return [Check("metrics", verdict, f"{endpoint}: {by} can read them", remedy)]


RELIABLE_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter", "riscv_clocksource")
"""Clock sources that can be read without leaving the processor or its virtual machine."""
MAX_CLOCK_RESOLUTION_S = 1e-6
"""Coarsest clock resolution that can wake the loop in time [s]."""
PERFORMANCE = "performance"
"""Governor of the kernel's cpufreq that keeps a processor at its full frequency."""


READS: Final = (
    "loop", "can", "zenoh", "watchdogs", "correction", "drives.protocol",
    "telemetry.metrics_port", "telemetry.metrics_address",
)  # fmt: skip
"""Keys of a configuration on which the checks of the machine depend."""


def run_checks(path: Path, findings: Findings, read: Callable[[Config], Machine]) -> list[Check]:
    """Return each mistake in a file, and the results of all checks that do not depend on the wrong keys.

    `read` reads the properties of the machine. It is not called if a key that it needs is wrong.
    """
    wrong = [mistake.key for mistake in findings.mistakes]
    checks = failed_checks(path, findings.mistakes)
    if overlap(READS, wrong):
        checks += diagnose(findings.config, wrong)
    else:
        checks += examine(findings.config, read(findings.config), wrong)
    if wrong:
        machine = ", and those of the machine," if overlap(READS, wrong) else ""
        later = f"checks that depend on the above{machine} were skipped"
        checks.append(Check("the rest", "warning", later, "correct the above, then run trirail doctor again"))
    return checks


def examine(config: Config, machine: Machine, impossible: Sequence[str] = ()) -> list[Check]:
    """Return all checks in order, without the checks of the configuration that read an `impossible` key."""
    simulated = config.can.interface in {"simulated", "unix"}
    return [
        kernel(machine, simulated=simulated),
        rights(machine.lacking, config.loop.realtime),
        clock(machine.clock_source, machine.resolution),
        governor(machine.governors),
        isolation(machine.cpu, machine.isolated, simulated=simulated),
        *can_interface(config, machine),
        *correction(config),
        *diagnose(config, impossible),
        *network(config, machine),
        *routers(machine.routers),
        *metrics(config),
        recordings(config, machine),
        cycle(machine.cycles, config),
    ]


def recordings(config: Config, machine: Machine) -> Check:
    """Check that the service can write its recordings."""
    if machine.unwritable:
        remedy = "set telemetry.directory to a folder that can be written, or change its rights"
        return Check("recordings", "failure", machine.unwritable, remedy)
    return Check("recordings", "ok", f"in {config.telemetry.directory}")


def kernel(machine: Machine, *, simulated: bool) -> Check:
    """Check for PREEMPT_RT, which bounds the lateness of ticks. Simulated drives do not need it."""
    if machine.preempt_rt:
        return Check("kernel", "ok", f"{machine.release}, PREEMPT_RT")
    release = f"{machine.release}, without PREEMPT_RT"
    if simulated:
        return Check("kernel", "ok", f"{release}: enough for simulated drives")
    return Check(
        "kernel", "warning", release, "to bound the lateness, boot a kernel with it: Debian's linux-image-rt-amd64"
    )


def rights(lacking: tuple[str, ...], realtime: str) -> Check:
    """Check that the loop gets the rights that loop.realtime requests."""
    if not lacking:
        return Check("rights", "ok", "SCHED_FIFO, locked memory, a dedicated processor")
    if realtime == "off":
        return Check("rights", "warning", lacking[0], 'loop.realtime = "prefer" uses the rights that are available')
    finding = ", ".join(lack.split(";")[0] for lack in lacking)
    remedy = "; ".join(lack.split("; ", 1)[1] for lack in lacking)
    return Check("rights", "failure" if realtime == "enforce" else "warning", f"without {finding}", remedy)


def clock(source: str | None, resolution: float) -> Check:
    """Check the clock that times the loop's ticks."""
    if resolution > MAX_CLOCK_RESOLUTION_S:
        reading = f"{source or 'unknown source'}, resolution {resolution * 1e3:g} ms"
        return Check("clock", "failure", reading, "boot a kernel with high-resolution timers (CONFIG_HIGH_RES_TIMERS)")
    if source is None:
        return Check("clock", "ok", f"resolution {resolution * 1e9:g} ns; the machine does not report the clock source")
    if source in RELIABLE_CLOCKS:
        return Check("clock", "ok", f"{source}, resolution {resolution * 1e9:g} ns")
    remedy = "each reading takes microseconds: see dmesg why the kernel does not use tsc; boot with clocksource=tsc"
    return Check("clock", "warning", f"{source}, resolution {resolution * 1e9:g} ns", remedy)


def governor(governors: Mapping[int, str]) -> Check:
    """Check the frequency governors, because a processor that sleeps or slows down wakes up late."""
    if not governors:
        return Check("governor", "ok", "no processor reports frequency scaling")
    others = sorted({name for name in governors.values() if name != PERFORMANCE})
    if not others:
        return Check("governor", "ok", f"{PERFORMANCE} on every processor")
    of = {name: ", ".join(str(cpu) for cpu, finding in governors.items() if finding == name) for name in others}
    finding = "; ".join(f"{name} on processor {cpus}" for name, cpus in of.items())
    return Check("governor", "warning", finding, f"cpupower frequency-set --governor {PERFORMANCE}")


def isolation(cpu: int, isolated: tuple[int, ...], *, simulated: bool) -> Check:
    """Check that the loop has its processor to itself."""
    if cpu in isolated:
        return Check("processor", "ok", f"{cpu}, isolated")
    if simulated:
        return Check("processor", "ok", f"{cpu}, shared: enough for simulated drives")
    elsewhere = f"set loop.cpu = {isolated[0]}, which is isolated" if isolated else "no processor is isolated"
    remedy = f"boot with isolcpus={cpu} nohz_full={cpu} and set loop.cpu = {cpu}"
    return Check("processor", "warning", f"{cpu}, shared; {elsewhere}", "" if isolated else remedy)


def correction(config: Config) -> list[Check]:
    """Report the correction of as-built errors, if it is on."""
    section = config.correction
    words = as_built.summary(section.map, section.as_built, section.backlash)
    return [] if words is None else [Check("correction", "ok", notation.correction(words, config.geometry.labels))]


def can_interface(config: Config, machine: Machine) -> list[Check]:
    """Check SocketCAN and the CAN interface using the kernel's reports."""
    section = config.can
    if section.interface in {"simulated", "unix"}:
        return [Check("CAN", "ok", f"{section.interface}: no hardware is used")]
    if section.interface != "socketcan":
        if machine.adapter:
            return [Check("CAN", "failure", f"{section.interface} needs {machine.adapter}")]
        state = f"{section.interface}, channel {section.channel or 'by default'}: its state cannot be read"
        return [
            Check("CAN", "warning", state, "check it with the manufacturer's tools; only SocketCAN reports the state")
        ]
    if not machine.af_can:
        return [Check("CAN", "failure", "this kernel has no SocketCAN", "modprobe can_raw")]
    return [
        Check("CAN", "ok", "SocketCAN"),
        *_link(config, machine),
        *_traffic(config, machine.traffic),
        *on_bus(machine.bus_timing, config),
    ]


def _link(config: Config, machine: Machine) -> list[Check]:
    name, section, link = config.can.channel, config.can, machine.link
    virtual = name.startswith("vcan")
    mtu = f"mtu {CANFD_FRAME.size} " if section.fd else ""
    up = f"ip link set {name} {f'{mtu}up' if virtual else section.timing.link_settings}"
    if link is None:
        make = f"ip link add {name} type vcan && {up}" if virtual else "plug the adapter in, load its driver"
        return [Check(name, "failure", "no such interface", make)]
    if "UP" not in link.get("flags", ()):
        return [Check(name, "failure", "down", up)]
    if section.fd and link.get("mtu", CANFD_FRAME.size) < CANFD_FRAME.size:
        return [Check(name, "failure", "up for classical CAN only; can.fd is true", f"ip link set {name} down && {up}")]
    info = link.get("linkinfo", {})
    if info.get("info_kind") == "vcan":
        return [Check(name, "ok", "up; virtual, without bitrate and error states")]
    data = info.get("info_data", {})
    queue = _queue(name, link.get("txqlen"), plan_traffic(config).traffic.most_sent)
    return [
        _bitrate(name, section, data, up),
        _state(name, data, up),
        queue,
        *_coalescing(name, machine.coalescing, up),
    ]


def _traffic(config: Config, passed: BusTraffic | None) -> list[Check]:
    """Report the current traffic of all nodes on the bus; the service counts only the frames of its own drives."""
    if passed is None:
        return []
    share = config.can.timing.total_seconds(passed.frames, passed.data) / passed.seconds
    name = f"{config.can.channel} traffic"
    load = f"{share:.1%} of {config.can.timing}, {passed.frames} frames in {passed.seconds:.1f} s, from all nodes"
    if share <= HIGH_LOAD:
        return [Check(name, "ok", load)]
    return [Check(name, "warning", load, f"find out which node sends: candump {config.can.channel}")]


def _bitrate(name: str, section: Can, data: dict[str, Any], up: str) -> Check:
    remedy = f"ip link set {name} down && {up}; the drives must have the same bitrate"
    wanted = {"bitrate": section.timing.bitrate, "data_bitrate": section.timing.data_bitrate}
    actual = {
        "bitrate": data.get("bittiming", {}).get("bitrate"),
        "data_bitrate": data.get("data_bittiming", {}).get("bitrate"),
    }
    for key, value in wanted.items():
        if value is not None and actual[key] != value:
            return Check(f"{name} bitrate", "failure", f"{actual[key]} bit/s; can.{key} is {value}", remedy)
    return Check(f"{name} bitrate", "ok", str(section.timing))


def _state(name: str, data: dict[str, Any], up: str) -> Check:
    """Check the state of the CAN controller. A node that detects too many errors leaves the bus (ISO 11898-1)."""
    state = str(data.get("state", "unknown")).lower()
    errors = data.get("berr_counter", {})
    counted = f"; errors sent {errors['tx']}, received {errors['rx']}" if errors else ""
    wiring = "check the termination (60 ohm across the bus without power), the cable, and the bitrate of every node"
    if state == "error-active":
        return Check(f"{name} state", "ok", f"{state}{counted}")
    if state == "bus-off":
        return Check(f"{name} state", "failure", state, f"{wiring}; then ip link set {name} down && {up}")
    verdict: Verdict = "warning" if state in {"error-warning", "error-passive"} else "failure"
    return Check(f"{name} state", verdict, f"{state}{counted}", wiring)


def _queue(name: str, length: int | None, most_sent: int) -> Check:
    """Check that the kernel's queue can hold the frames of two cycles, since a late cycle may meet the next one."""
    wanted = 2 * most_sent
    if length is None or length >= wanted:
        return Check(f"{name} queue", "ok", f"{length or 'unknown number of'} frames")
    size = f"{length} frames; two cycles may coincide and need {wanted}"
    return Check(f"{name} queue", "warning", size, f"ip link set {name} txqueuelen 100")


def _coalescing(name: str, gathered: ReceiveCoalescing | None, up: str) -> list[Check]:
    """Check that receive coalescing does not delay frames.

    With coalescing, a position that waits for later frames arrives late, and the last position of a cycle may have to
    wait for the next cycle.
    """
    if gathered is None:
        return []
    waits = [f"{gathered.frames} frames"] if gathered.frames > 1 else []
    waits += [f"{gathered.microseconds} µs"] if gathered.microseconds else []
    if not waits:
        return [Check(f"{name} coalescing", "ok", "each frame is delivered as it arrives")]
    # ethtool reports "off" as no time and one frame (Linux, mcp251xfd_ring_alloc).
    remedy = f"ip link set {name} down && ethtool -C {name} rx-usecs-irq 0 rx-frames-irq 1 && {up}"
    return [Check(f"{name} coalescing", "warning", f"frames are delivered after {' or '.join(waits)}", remedy)]
