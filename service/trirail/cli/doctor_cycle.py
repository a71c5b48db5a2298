"""Evaluation of the measured cycles: the rates at which this machine can run the service's loop."""

from __future__ import annotations

from msgspec import Struct

from trirail.cli.terminal import budget_share
from trirail.config import Config
from trirail.diagnosis import Check
from trirail.diagnosis.bus_timing import MeasuredTiming
from trirail.diagnosis.cycle_timing import Cycles, compute_percentiles
from trirail.diagnosis.drive_checks import setpoint_budget_us
from trirail.wire.state import Percentiles

MAX_PERIOD_SHARE = 0.5
"""Share of a period within which 999 of 1000 cycles must send their setpoints. The rest is for decisions."""
RATES = (100, 250, 500, 1000, 2000)
"""Rates that are evaluated in addition to the configured one [Hz]."""


class HeldRate(Struct, frozen=True):
    """Result of the measurement in a form for programs; times are in microseconds."""

    rate_hz: int
    cycles: int
    lateness_us: Percentiles
    """Lateness of the cycles, including the ticks missed before them."""
    cycle_us: Percentiles
    """Time from SYNC to the setpoints."""
    record_us: Percentiles
    """Time from SYNC to the end of the record."""
    over_us: Percentiles
    """Time from the deadline to the setpoints, which is the sum of lateness and cycle time for each cycle."""
    missed: int
    """Number of missed ticks."""
    missed_in_a_row: int
    answers_missing: int
    """Number of SYNCs that a drive did not answer, out of three per cycle."""
    up_to_hz: int | None
    """Highest rate that the machine can run; None if it can run none."""


def compute_held_rate(cycles: Cycles) -> HeldRate:
    """Compute the percentiles and the highest possible rate from measured cycles."""
    over, rate = compute_percentiles(cycles.lateness + cycles.work), 1_000_000_000 // cycles.period
    missed = [int(each) for each in cycles.missed]
    held = [each for each in {*RATES, rate} if over.p999 <= MAX_PERIOD_SHARE * 1e6 / each]
    return HeldRate(
        rate_hz=rate,
        cycles=len(missed),
        lateness_us=compute_percentiles(cycles.lateness),
        cycle_us=compute_percentiles(cycles.work),
        record_us=compute_percentiles(cycles.to_record),
        over_us=over,
        missed=sum(missed),
        missed_in_a_row=_longest_streak(missed),
        answers_missing=cycles.unanswered,
        up_to_hz=max(held, default=None),
    )


def cycle(cycles: Cycles | str, config: Config) -> Check:
    """Check whether the machine can keep the configured period."""
    if isinstance(cycles, str):
        if cycles:
            reason, _, remedy = cycles.partition("; ")
            return Check("cycle", "warning", f"not measured: {reason}", remedy)
        return Check("cycle", "ok", "not measured: --quick")
    held = compute_held_rate(cycles)
    period = 1e6 / held.rate_hz
    budget = setpoint_budget_us(config)
    summary = (
        f"{_frequency(held.rate_hz)}: cycle p99.9 {held.cycle_us.p999:.0f} µs, "
        f"with record {held.record_us.p999:.0f} µs, lateness p99.9 {held.lateness_us.p999:.0f} µs; "
        f"setpoints {budget_share(held.over_us, budget)}"
    )
    lost = f"{held.missed} of {held.cycles} ticks missed" if held.missed else ""
    remedy = "see the lines above; end other programs, or isolate a processor"
    if held.up_to_hz is None or held.up_to_hz < held.rate_hz:
        lower = "no rate can be held" if held.up_to_hz is None else f"loop.rate_hz = {held.up_to_hz} can be held"
        remedy = f"{remedy}; {lower}"
    if held.missed_in_a_row > config.watchdogs.max_overruns:
        return Check(
            "cycle", "failure", f"{summary}: {lost}, {held.missed_in_a_row} in a row, the service would stop", remedy
        )
    if cycles.fault:
        return Check("cycle", "failure", f"{summary}: the robot stopped: {cycles.fault}", remedy)
    if held.over_us.p999 > period:
        return Check("cycle", "failure", f"{summary}: the period of {period:.0f} µs is not held, {lost}", remedy)
    if held.over_us.p999 > MAX_PERIOD_SHARE * period:
        left = f"little of the period of {period:.0f} µs is left for decisions" + (f", {lost}" if lost else "")
        return Check("cycle", "warning", f"{summary}: {left}", remedy)
    if held.over_us.p999 > budget:
        return Check("cycle", "warning", f"{summary}: late setpoints take effect a cycle later", remedy)
    if lost:
        return Check("cycle", "warning", f"{summary}: {lost}", remedy)
    return Check("cycle", "ok", f"{summary}: fine; up to {_frequency(held.up_to_hz or held.rate_hz)}")


def on_bus(timing: MeasuredTiming | str, config: Config) -> list[Check]:
    """Check the timing of cycles on the bus, if it was measured: each setpoint must be sent before the next SYNC."""
    name = f"{config.can.channel} timing"
    if isinstance(timing, str):
        return [Check(name, "ok", f"not measured: {timing}")] if timing else []
    period, error = 1e6 / timing.rate_hz, timing.interval_error_us
    sender = "the running service" if timing.source == "service" else "test frames, which no drive uses"
    finding = (
        f"{timing.timestamps} loopback timestamps, {timing.syncs} SYNCs of {sender} at {_frequency(timing.rate_hz)}: "
        f"SYNC off its period p50 {error.p50:.0f}, p99 {error.p99:.0f}, p99.9 {error.p999:.0f}, "
        f"worst {error.max:.0f} µs"
    )
    if timing.setpoints_us is None:
        return [Check(name, "warning", f"{finding}; no setpoints were sent", "see the faults in trirail status")]
    last = timing.setpoints_us
    p50, p999, worst = (f"{value / period:.0%}" for value in (last.p50, last.p999, last.max))
    finding = f"{finding}; last setpoint p50 {p50}, p99.9 {p999}, worst {worst} of the period after SYNC"
    if timing.without_setpoints:
        lacking = f"{timing.without_setpoints} cycles without a setpoint before the next SYNC"
        remedy = "see the lines above; end other programs, isolate a processor, or set a lower loop.rate_hz"
        return [Check(name, "warning", f"{finding}; {lacking}", remedy)]
    return [Check(name, "ok", finding)]


def _frequency(hertz: int) -> str:
    return f"{hertz / 1000:g} kHz" if hertz >= 1000 else f"{hertz} Hz"


def _longest_streak(missed: list[int]) -> int:
    longest = streak = 0
    for each in missed:
        streak = streak + each if each else 0
        longest = max(longest, streak)
    return longest
