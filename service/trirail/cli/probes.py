"""Probes of the machine for trirail.cli.doctor: kernel, rights, clock, CAN interface and duration of a cycle."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import platform
import re
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from msgspec import structs
from trirail_drivers.bus import adapters
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.timing import BusTiming

from trirail.cli.key_folder import AUTHORITY_KEY, IssuedCertificate, KeyFolder
from trirail.cli.machine import BusTraffic, Machine, ReceiveCoalescing
from trirail.config import Config, LoopTable
from trirail.diagnosis import bus_timing, cycle_timing
from trirail.diagnosis.bus_timing import MeasuredTiming
from trirail.diagnosis.cycle_timing import Cycles
from trirail.errors import ServiceError
from trirail.processes import realtime
from trirail.processes.operating_system import title
from trirail.processes.session_guard import Guard

SYSTEM = Path("/sys")
PROCESSES = Path("/proc")
_SIOCETHTOOL, _GCOALESCE, _COALESCE = 0x8946, 0x0E, 23
"""Request from linux/sockios.h, command from linux/ethtool.h, and number of 32-bit words in struct ethtool_coalesce."""
MEASUREMENT_S = 10.0
"""Duration of the measurement of cycles [s]."""
COMMAND_TIMEOUT_S = 5.0
"""Time-out of a command that reads properties of the machine [s]."""
COUNTING_S = 1.0
"""Time for which frames are counted if cycles are not measured [s]."""


def machine(config: Config, *, quick: bool = False, progress: Callable[[float], None] | None = None) -> Machine:
    """Run all probes; `quick` skips the measurement of cycles, and `progress` receives the share of measured cycles.

    This process has the loop's real-time rights only while it tries them and while it measures the bus, so that it does
    not disturb other programs on the processor, such as the measured cycles.
    """
    cpu = realtime.processor(config.loop)
    running = loop_on(cpu)
    measures = not quick and running is None
    channel = config.can.channel if config.can.interface == "socketcan" else ""
    before = read_counters(channel)
    cycles: Cycles | str = ""
    with _rights_of(config.loop) as lacking:
        pass  # the measured cycles run in a process of their own, with its own rights
    if measures:
        preferring = structs.replace(config, loop=_with_available_rights(config.loop))
        cycles = cycle_timing.measure(preferring, MEASUREMENT_S, progress)
    if running is not None:
        loop = f"a service's loop, process {running}, runs on processor {cpu}"
        cycles = f"{loop}; end that service, then run trirail doctor again"
    if not measures and before is not None:
        time.sleep(COUNTING_S)
    traffic = traffic_between(before, read_counters(channel))
    reported = link(channel) if channel else None
    timing: MeasuredTiming | str = ""
    if not quick and reported is not None and "UP" in reported.get("flags", ()):
        with _rights_of(config.loop):
            timing = measure_bus(config, reported, progress)
    checked = guard(config)
    return Machine(
        release=platform.release(),
        preempt_rt=_text(SYSTEM / "kernel/realtime") == "1" or "PREEMPT_RT" in platform.version(),
        af_can=_has_can(),
        lacking=lacking,
        clock_source=_text(SYSTEM / "devices/system/clocksource/clocksource0/current_clocksource"),
        resolution=time.clock_getres(time.CLOCK_MONOTONIC),
        cpu=cpu,
        governors=governors(),
        isolated=processors(_text(SYSTEM / "devices/system/cpu/isolated") or ""),
        link=reported,
        cycles=cycles,
        traffic=traffic,
        bus_timing=timing,
        coalescing=read_coalescing(channel) if channel else None,
        adapter=adapters.missing_support(config.can.interface),
        unwritable=why_unwritable(Path(config.telemetry.directory)),
        guard=checked,
        issued=issued(config),
        limited_ports=limited_ports() if config.zenoh.tls is not None else None,
        routers=()
        if isinstance(checked, str)
        else tuple((each, checked.why_not_linked(each)) for each in config.zenoh.connect),
    )


def why_unwritable(folder: Path) -> str:
    """Return why this user cannot write files to a folder, which need not exist yet; "" if this user can."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.exists(path))
    if not existing.is_dir():
        return f"{existing} is not a folder"
    return "" if os.access(existing, os.W_OK | os.X_OK) else f"this user may not write in {existing}"


def measure_bus(
    config: Config, report: dict[str, Any], progress: Callable[[float], None] | None = None
) -> MeasuredTiming | str:
    """Measure the timing of cycles on the configuration's SocketCAN interface, or return why that is not possible.

    `report` is the kernel's report on the interface, from `link`.
    """
    protocol, can = PROTOCOLS[config.drives.protocol], config.can
    identifiers = protocol.sync, protocol.setpoints
    return bus_timing.measure(can.channel, can.timing, config.loop, *identifiers, unfit(report, can.timing), progress)


def unfit(report: dict[str, Any], timing: BusTiming) -> str:
    """Return why nothing must be sent on an interface, given the kernel's report on it, or "".

    At another bit rate than that of the drives, even one frame would disturb the bus. Test frames are classical frames.
    """
    if timing.fd:
        return "no service runs on it, and test frames are not sent on a CAN FD bus"
    info = report.get("linkinfo", {})
    data = info.get("info_data", {})
    if info.get("info_kind") == "vcan":
        return ""
    if data.get("bittiming", {}).get("bitrate") != timing.bitrate:
        return "no service runs on it, and its bit rate is not can.bitrate, so no test frames were sent"
    if data.get("state") != "ERROR-ACTIVE":
        return "no service runs on it, and it is not error-active, so no test frames were sent"
    return ""


def guard(config: Config) -> Guard | str:
    """Read the certificates, or return the reason why they cannot be used."""
    try:
        return Guard(config)
    except ServiceError as error:
        return str(error)


def limited_ports() -> tuple[int, ...] | None:
    """Return the ports at which the rules of configs/trirail.nft limit connections.

    Returns None if the rules cannot be read, for example because nft or the right to use it is missing.
    """
    try:
        listed = subprocess.run(
            ("nft", "--json", "list", "tables"), capture_output=True, check=True, timeout=COMMAND_TIMEOUT_S
        )
        tables = [each["table"] for each in json.loads(listed.stdout)["nftables"] if "table" in each]
        if not any(table["family"] == "inet" and table["name"] == "trirail" for table in tables):
            return ()
        command = ("nft", "--json", "list", "set", "inet", "trirail", "ports")
        listed = subprocess.run(command, capture_output=True, check=True, timeout=COMMAND_TIMEOUT_S)
        (ports,) = [each["set"] for each in json.loads(listed.stdout)["nftables"] if "set" in each]
        return tuple(port for each in ports.get("elem", ()) for port in _ports_of(each))
    except (OSError, ValueError, KeyError, TypeError, subprocess.SubprocessError):
        return None


def _ports_of(element: Any) -> Sequence[int]:
    """Return the ports of an element of a set of nft: a port, a range, or either of them with further properties."""
    if isinstance(element, dict) and "elem" in element:
        return _ports_of(element["elem"]["val"])
    first, last = element["range"] if isinstance(element, dict) else (element, element)
    return range(first, last + 1)


def issued(config: Config) -> tuple[IssuedCertificate, ...] | None:
    """Return the issued certificates if the folder in [zenoh.tls] is the authority's folder."""
    if config.zenoh.tls is None:
        return None
    folder = Path(config.zenoh.tls.directory)
    try:
        return tuple(KeyFolder(folder).issued()) if (folder / AUTHORITY_KEY).exists() else None
    except ServiceError:  # the guard has already reported it
        return None


def processors(text: str) -> tuple[int, ...]:
    """Parse a set of processors in the kernel's notation, such as "2-4,7"."""
    numbers: list[int] = []
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        numbers += range(int(first), int(last or first) + 1)
    return tuple(numbers)


def link(name: str) -> dict[str, Any] | None:
    """Return the kernel's report on a network interface, or None if there is none.

    Raises ServiceError if the program `ip` is missing.
    """
    if not (SYSTEM / "class/net" / name).exists():
        return None
    command = ("ip", "-details", "-json", "link", "show", "dev", name)
    try:
        result = subprocess.run(command, capture_output=True, check=True)
    except FileNotFoundError as error:
        raise ServiceError(
            "the program ip, which reports a CAN interface's state, is missing: install iproute2"
        ) from error
    except subprocess.CalledProcessError as error:
        raise ServiceError(f"{' '.join(command)}: {error.stderr.decode(errors='replace').strip()}") from error
    (report,) = json.loads(result.stdout)
    return dict(report)


def is_interface(name: Path) -> bool:
    """Return True if this is the name of a CAN interface and not of a file."""
    return not name.exists() and re.fullmatch(r"[a-z]*can\d+", str(name)) is not None


def on_interface(config: Config, channel: str) -> Config:
    """Return the configuration for the SocketCAN interface `channel`, with the bit rate that the interface has."""
    info = (link(channel) or {}).get("linkinfo", {}).get("info_data", {})
    bitrate = info.get("bittiming", {}).get("bitrate", config.can.bitrate)
    can = structs.replace(config.can, interface="socketcan", channel=channel, bitrate=bitrate)
    return structs.replace(config, can=can)


def read_coalescing(name: str) -> ReceiveCoalescing | None:
    """Return the receive coalescing of a network interface, or None if its driver does not report it.

    The request is defined in linux/ethtool.h.
    """
    settings = (ctypes.c_uint32 * _COALESCE)(_GCOALESCE)
    request = struct.pack("16sP", name.encode(), ctypes.addressof(settings))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            fcntl.ioctl(asking, _SIOCETHTOOL, request)
    except OSError:
        return None
    _, time_of_any, any_frames, time_of_irq, irq_frames, *_ = settings
    return ReceiveCoalescing(max(any_frames, irq_frames), max(time_of_any, time_of_irq))


def read_counters(name: str) -> BusTraffic | None:
    """Return the counters of a network interface since its creation, or None if the kernel has none."""
    at = time.monotonic()
    statistics = SYSTEM / "class/net" / name / "statistics"
    texts = [_text(statistics / file) for file in ("rx_packets", "tx_packets", "rx_bytes", "tx_bytes")] if name else []
    if not texts or not all(text and text.isdecimal() for text in texts):
        return None
    received, sent, received_bytes, sent_bytes = (int(text) for text in texts if text)
    return BusTraffic(at, received + sent, received_bytes + sent_bytes)


def traffic_between(before: BusTraffic | None, after: BusTraffic | None) -> BusTraffic | None:
    """Return the traffic between two counts, or None if either is missing."""
    if before is None or after is None:
        return None
    return BusTraffic(after.seconds - before.seconds, after.frames - before.frames, after.data - before.data)


def governors() -> dict[int, str]:
    """Return the frequency governor of each processor that has one."""
    files = SYSTEM.glob("devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")
    names = {int(file.parts[-3].removeprefix("cpu")): _text(file) for file in files}
    return {cpu: name for cpu, name in sorted(names.items()) if name}


def loop_on(cpu: int) -> int | None:
    """Return the process id of a service's loop that may run on a processor, or None if no such loop is visible."""
    for process in PROCESSES.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # the process has ended, or is hidden
            if (process / "cmdline").read_bytes().rstrip(b"\0").decode(errors="replace") != title("loop"):
                continue
            allowed = re.search(r"^Cpus_allowed_list:\s*(\S+)", (process / "status").read_text(), re.MULTILINE)
            if allowed and cpu in processors(allowed[1]):
                return int(process.name)
    return None


@contextlib.contextmanager
def _rights_of(loop: LoopTable) -> Iterator[tuple[str, ...]]:
    """Acquire the loop's rights and processor until the context ends; yield the rights that the loop would lack."""
    allowed, policy, priority = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield realtime.acquire(_with_available_rights(loop))
    finally:
        os.sched_setscheduler(0, policy, priority)
        os.sched_setaffinity(0, allowed)


def _with_available_rights(loop: LoopTable) -> LoopTable:
    # The doctor reports missing rights; with "enforce", the loop refuses to run without them.
    return loop if loop.realtime == "off" else structs.replace(loop, realtime="prefer")


def _has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def _text(path: Path) -> str | None:
    """Return the content of one of the kernel's files, or None if it cannot be read."""
    try:
        return path.read_text().strip()
    except OSError:
        return None
