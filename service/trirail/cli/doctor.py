"""Judges a machine for a configuration: each check is a function of what was read, see trirail.cli.probes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from trirail.cli import notation
from trirail.cli.doctor_can import can_interface
from trirail.cli.doctor_cycle import cycle
from trirail.cli.doctor_network import metrics, network, routers
from trirail.cli.machine import Machine
from trirail.config import Config, Findings, as_built, overlap
from trirail.diagnosis import Check, diagnose, failed_checks

RELIABLE_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter", "riscv_clocksource")
"""Clock sources that are read without leaving the processor, or its virtual machine."""
COARSE = 1e-6
"""A clock of a coarser resolution cannot wake anybody in time [s]."""
PERFORMANCE = "performance"
"""The governor that keeps a processor at its full frequency: cpufreq of the kernel."""


READS: Final = (
    "loop", "can", "zenoh", "watchdogs", "correction", "drives.protocol",
    "telemetry.metrics_port", "telemetry.metrics_address",
)  # fmt: skip
"""What of a configuration the machine is read and judged by."""


def whole(path: Path, found: Findings, read: Callable[[Config], Machine]) -> list[Check]:
    """Return each mistake of a file, and every check that can do without what is impossible; `read` reads the machine.

    It is not called where what it needs to know is impossible.
    """
    wrong = [mistake.key for mistake in found.mistakes]
    checks = failed_checks(path, found.mistakes)
    if overlap(READS, wrong):
        checks += diagnose(found.config, wrong)
    else:
        checks += examine(found.config, read(found.config), wrong)
    if wrong:
        said = "what depends on the above" + (", and the machine," if overlap(READS, wrong) else "")
        checks.append(Check("the rest", "warning", f"{said} is looked at once that is right", "correct it, ask again"))
    return checks


def examine(config: Config, machine: Machine, impossible: Sequence[str] = ()) -> list[Check]:
    """Return every check, in order; of the configuration those that read no `impossible` key."""
    simulated = config.can.interface in {"simulated", "unix"}
    return [
        kernel(machine, simulated=simulated),
        rights(machine.lacking, config.loop.realtime),
        clock(machine.clock_source, machine.resolution),
        governor(machine.governors),
        isolation(machine.cpu, machine.isolated, simulated=simulated),
        *can_interface(config, machine),
        *corrected(config),
        *diagnose(config, impossible),
        *network(config, machine),
        *routers(machine.routers),
        *metrics(config),
        cycle(machine.cycles, config),
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


def governor(governors: Mapping[int, str]) -> Check:
    """A processor that sleeps or slows down wakes late; any may, for the loop's neighbours run on the others."""
    if not governors:
        return Check("governor", "ok", "no processor has frequency scaling to be seen")
    others = sorted({name for name in governors.values() if name != PERFORMANCE})
    if not others:
        return Check("governor", "ok", f"{PERFORMANCE} on every processor")
    of = {name: ", ".join(str(cpu) for cpu, found in governors.items() if found == name) for name in others}
    found = "; ".join(f"{name} on processor {cpus}" for name, cpus in of.items())
    return Check("governor", "warning", found, f"cpupower frequency-set --governor {PERFORMANCE}")


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
    words = as_built.summary(section.map, section.as_built, section.backlash)
    return [] if words is None else [Check("correction", "ok", notation.correction(words, config.geometry.labels))]
