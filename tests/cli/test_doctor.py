"""The doctor: each check judges what was read as it should, names the remedy, and the command says it all."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.cli import app, doctor, doctor_cycle, probes
from trirail.cli.machine import BusTraffic, Machine, ReceiveCoalescing
from trirail.config import SIM, Config, Tls, everything, impossible, load
from trirail.diagnosis import Check, cycle_timing, diagnose, drive_checks
from trirail.diagnosis.bus_timing import MeasuredTiming
from trirail.diagnosis.cycle_timing import Cycles
from trirail.errors import ServiceError
from trirail.wire.state import Percentiles
from trirail_drivers.config import Homing, Simulated
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.errors import BusError
from trirail_drivers.protocols import PROTOCOLS
from trirail_drivers.timing import DEFAULT_TIMING, BusTiming, frame_bits

CONFIGS = SIM.parent
SIMULATED = load(SIM)
REAL = load(CONFIGS / "socketcan.toml")
ODRIVE = CONFIGS / "drives/odrive_s1.toml"


def cycles(lateness: list[int], work: int, rate: int = 1000) -> Cycles:
    """Cycles that were so late and took so long [ns], and 1 µs more with their record; one SYNC was not answered."""
    late, took = np.array(lateness, np.int64), np.full(len(lateness), work, np.int64)
    return Cycles(late, took, took + 1000, 1_000_000_000 // rate, 1)


# What `ip -details -json link` says of an interface, shortened.
LINK: dict[str, Any] = {
    "ifname": "can0",
    "flags": ["NOARP", "UP", "LOWER_UP", "ECHO"],
    "txqlen": 100,
    "linkinfo": {
        "info_kind": "can",
        "info_data": {
            "state": "ERROR-ACTIVE",
            "berr_counter": {"tx": 0, "rx": 0},
            "bittiming": {"bitrate": 1_000_000},
        },
    },
}
GOOD = Machine(
    release="6.1.0-rt",
    preempt_rt=True,
    af_can=True,
    lacking=(),
    clock_source="tsc",
    resolution=1e-9,
    cpu=3,
    governors=dict.fromkeys(range(4), "performance"),
    isolated=(2, 3),
    link=LINK,
    coalescing=ReceiveCoalescing(1, 0),
    cycles=cycles([20_000] * 2000, 50_000),
)


def changed(config: Config, section: str, **values: object) -> Config:
    return msgspec.structs.replace(config, **{section: msgspec.structs.replace(getattr(config, section), **values)})


def link(state: str = "ERROR-ACTIVE", bitrate: int = 1_000_000, **values: object) -> dict[str, Any]:
    data = {"state": state, "berr_counter": {"tx": 136, "rx": 7}, "bittiming": {"bitrate": bitrate}}
    return LINK | {"linkinfo": {"info_kind": "can", "info_data": data}} | values


def bad(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks if check.verdict != "ok"}


@pytest.mark.parametrize("config", [SIMULATED, REAL], ids=["simulated", "real"])
def test_nothing_is_wrong_with_a_good_machine(config: Config) -> None:
    checks = doctor.examine(config, GOOD)
    assert not bad(checks)
    assert len({check.name for check in checks}) == len(checks)


@pytest.mark.parametrize(
    ("values", "name", "verdict", "remedy"),
    [
        ({"preempt_rt": False}, "kernel", "warning", "linux-image-rt"),
        ({"lacking": ("SCHED_FIFO: not permitted; run as root",)}, "rights", "failure", "run as root"),
        ({"clock_source": "hpet"}, "clock", "warning", "clocksource=tsc"),
        ({"resolution": 0.004}, "clock", "failure", "CONFIG_HIGH_RES_TIMERS"),
        ({"governors": {0: "performance", 3: "schedutil"}}, "governor", "warning", "cpupower"),
        ({"isolated": ()}, "processor", "warning", "isolcpus=3"),
        ({"af_can": False}, "CAN", "failure", "modprobe can_raw"),
        ({"link": None}, "can0", "failure", "adapter"),
        ({"link": link(flags=["NOARP"])}, "can0", "failure", "ip link set can0 up type can bitrate 1000000"),
        ({"link": link(bitrate=500_000)}, "can0 bitrate", "failure", "ip link set can0 down"),
        ({"link": link("ERROR-WARNING")}, "can0 state", "warning", "termination"),
        ({"link": link("ERROR-PASSIVE")}, "can0 state", "warning", "termination"),
        ({"link": link("BUS-OFF")}, "can0 state", "failure", "ip link set can0 down"),
        ({"link": link("STOPPED")}, "can0 state", "failure", ""),
        ({"link": link(txqlen=10)}, "can0 queue", "warning", "txqueuelen"),
        (
            {"coalescing": ReceiveCoalescing(8, 0)},
            "can0 coalescing",
            "warning",
            "ethtool -C can0 rx-usecs-irq 0 rx-frames-irq 1",
        ),
        ({"coalescing": ReceiveCoalescing(0, 50)}, "can0 coalescing", "warning", "ip link set can0 down"),
        ({"unwritable": "this user may not write in /srv"}, "recordings", "failure", "telemetry.directory"),
        ({"cycles": cycles([10_000] * 50, 600_000)}, "cycle", "warning", "loop.rate_hz = 500"),
        ({"cycles": cycles([10_000] * 50, 1_100_000)}, "cycle", "failure", "loop.rate_hz = 250"),
        ({"cycles": cycles([10_000] * 50, 90_000_000)}, "cycle", "failure", "no rate can be held"),
        ({"cycles": cycles([0, 11_000_000, 0], 0)}, "cycle", "failure", "isolate"),
        ({"cycles": "the loop of a service runs there; end that service"}, "cycle", "warning", "end that service"),
    ],
)
def test_each_fault_of_a_machine_is_named_with_its_remedy(
    values: dict[str, Any], name: str, verdict: str, remedy: str
) -> None:
    (found,) = bad(doctor.examine(REAL, msgspec.structs.replace(GOOD, **values))).values()
    assert (found.name, found.verdict) == (name, verdict)
    assert remedy in found.remedy
    assert "\n" not in found.found + found.remedy


@pytest.mark.parametrize(("protocol", "verdict"), [("cia402", "warning"), ("odrive", "ok")])
def test_the_queue_takes_two_cycles_of_the_protocol(protocol: str, verdict: str) -> None:
    machine = msgspec.structs.replace(GOOD, link=link(txqlen=21))
    checks = doctor.examine(changed(REAL, "drives", protocol=protocol), machine)
    assert [check.verdict for check in checks if check.name == "can0 queue"] == [verdict]


@pytest.mark.parametrize(("window", "bad_ones"), [(0.002, 1), (0.0015, 1), (0.0021, 0)])
def test_the_drives_window_is_to_be_behind_the_services(window: float, bad_ones: int) -> None:
    """REAL has limits.slider.following_error = 0.002."""
    found = bad(doctor.examine(changed(REAL, "drives", following_error=window), GOOD))
    assert [(each.name, each.verdict) for each in found.values()] == [("following error", "warning")] * bad_ones


@pytest.mark.parametrize(
    ("was", "now", "read"),
    [
        ("velocity = 0.1\n", "velocity = -0.1\n", True),
        ("rate_hz = 1000 ", "rate_hz = 0 ", False),
        ('channel = "can0"', "channel = 0", False),
        ("node = 1\n", "node = 2\n", True),
    ],
)
def test_the_machine_is_judged_beside_mistakes_that_are_none_of_it(
    was: str, now: str, read: bool, tmp_path: Path
) -> None:
    text = (CONFIGS / "socketcan.toml").read_text()
    assert was in text
    (tmp_path / "robot.toml").write_text(text.replace(was, now, 1))
    asked: list[Config] = []

    def machine(config: Config) -> Machine:
        asked.append(config)
        return msgspec.structs.replace(GOOD, governors={0: "powersave"})

    checks = bad(doctor.run_checks(tmp_path / "robot.toml", everything(tmp_path / "robot.toml"), machine))
    assert {"configuration", "the rest"} <= checks.keys()
    assert ("governor" in checks, bool(asked)) == (read, read)
    assert ("the machine" in checks["the rest"].found) == (not read)


def test_simulated_drives_need_no_real_machine() -> None:
    desktop = msgspec.structs.replace(GOOD, preempt_rt=False, af_can=False, isolated=(), link=None)
    assert not bad(doctor.examine(SIMULATED, desktop))


def test_rights_are_a_failure_only_where_they_are_demanded() -> None:
    lacking = ("SCHED_FIFO: not permitted; run as root",)
    assert doctor.rights(lacking, "enforce").verdict == "failure"
    assert doctor.rights(lacking, "prefer").verdict == "warning"
    assert doctor.rights(("switched off",), "off").verdict == "warning"


def test_missed_ticks_are_a_streak_only_in_a_row() -> None:
    """SIMULATED has watchdogs.max_overruns = 10."""
    apart, in_a_row = [0] * 10_000, [0] * 10_000
    apart[10] = apart[12] = in_a_row[10] = in_a_row[11] = 6_000_000
    assert doctor_cycle.cycle(cycles(apart, 0), REAL).verdict == "warning"
    assert doctor_cycle.cycle(cycles(in_a_row, 0), REAL).verdict == "failure"


def test_a_period_that_is_held_is_told_with_the_highest_rate_that_would_be() -> None:
    """88 µs late and 110 µs of work leave half of 500 µs, and not half of 250."""
    check = doctor_cycle.cycle(cycles([88_000] * 10, 110_000), REAL)
    assert check.verdict == "ok"
    assert check.found == (
        "1 kHz: cycle p99.9 110 µs, with record 111 µs, lateness p99.9 88 µs; setpoints p50 79%, p99.9 79%, worst 79% "
        "of the 250 µs that the bus leaves: fine; up to 2 kHz"
    )


@given(st.integers(1, 2_000_000))
def test_setpoints_beyond_the_time_that_the_bus_leaves_are_warned_of(work: int) -> None:
    """The frames of a cycle take 75 % of 1 Mbit/s at 1 kHz, and leave 250 µs."""
    budget = drive_checks.setpoint_budget_us(REAL)
    assert budget == pytest.approx(250.0, abs=1.0)
    check = doctor_cycle.cycle(cycles([0] * 10, work), REAL)
    assert (check.verdict == "ok") == (work / 1e3 <= budget)


def test_a_full_bus_leaves_no_time() -> None:
    full = changed(REAL, "can", bitrate=500_000)
    assert drive_checks.setpoint_budget_us(full) == 0.0
    assert "leaves no time" in doctor_cycle.cycle(cycles([0] * 10, 1000), full).found


def test_what_was_not_measured_is_said() -> None:
    assert doctor_cycle.cycle("", REAL).found == "not measured: --quick"
    assert "process 7" in doctor_cycle.cycle("a service's loop, process 7, runs", REAL).found


@given(
    st.lists(st.integers(0, 5_000_000), min_size=1, max_size=50),
    st.integers(0, 5_000_000),
    st.sampled_from([500, 1000, 4000]),
)
def test_the_numbers_are_those_of_the_samples(lateness: list[int], work: int, rate: int) -> None:
    found = doctor_cycle.compute_held_rate(cycles(lateness, work, rate))
    assert found.cycles == len(lateness)
    assert found.missed == sum(late * rate // 1_000_000_000 for late in lateness)
    assert found.missed_in_a_row <= found.missed
    assert found.over_us.max == pytest.approx(max(lateness) / 1e3 + work / 1e3)
    assert found.record_us.max == pytest.approx(work / 1e3 + 1.0)
    assert found.answers_missing == 1
    if found.up_to_hz is not None:
        assert found.over_us.p999 <= doctor_cycle.MAX_PERIOD_SHARE * 1e6 / found.up_to_hz


def test_a_virtual_interface_has_no_bitrate_to_be_wrong() -> None:
    config = changed(REAL, "can", channel="vcan0")
    virtual = {"flags": ["NOARP", "UP"], "linkinfo": {"info_kind": "vcan"}}
    assert not bad(doctor.examine(config, msgspec.structs.replace(GOOD, link=virtual)))
    (missing,) = bad(doctor.examine(config, msgspec.structs.replace(GOOD, link=None))).values()
    assert "type vcan" in missing.remedy


def test_another_interface_is_said_to_be_unknown() -> None:
    checks = doctor.examine(changed(REAL, "can", interface="pcan"), GOOD)
    assert bad(checks)["CAN"].verdict == "warning"


@pytest.mark.parametrize(("frames", "verdict"), [(0, "ok"), (100, "ok"), (11_000, "ok"), (13_000, "warning")])
def test_what_passes_on_the_bus_is_counted_whoever_sends_it(frames: int, verdict: str) -> None:
    """At 1 Mbit/s frames of eight bytes fill the bus at 7407 a second."""
    machine = msgspec.structs.replace(GOOD, traffic=BusTraffic(2.0, frames, 8 * frames))
    (check,) = [check for check in doctor.examine(REAL, machine) if check.name == "can0 traffic"]
    assert check.verdict == verdict
    assert float(check.found.partition("%")[0]) == pytest.approx(frames * frame_bits(8) / 2e4, abs=0.6)


@given(st.lists(st.integers(0, 8), max_size=50))
def test_bits_are_those_of_the_frames_one_a_frame_at_most_too_many(lengths: list[int]) -> None:
    bits = sum(map(frame_bits, lengths))
    assert bits <= BusTiming(1).total_seconds(len(lengths), sum(lengths)) < bits + len(lengths) + 1


@given(st.lists(st.integers(0, 16), max_size=50))
def test_the_time_of_frames_of_can_fd_is_the_sum_of_theirs(lengths: list[int]) -> None:
    timing = BusTiming(1_000_000, 5_000_000)
    total = timing.total_seconds(len(lengths), sum(lengths))
    assert total == pytest.approx(sum(map(timing.frame_ns, lengths)) * 1e-9)


def test_the_kernels_counters_are_read_and_subtracted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "SYSTEM", tmp_path)
    assert probes.read_counters("can0") is None
    assert probes.read_counters("") is None
    folder = tmp_path / "class/net/can0/statistics"
    folder.mkdir(parents=True)
    for name, value in {"rx_packets": 30, "tx_packets": 12, "rx_bytes": 200, "tx_bytes": 96}.items():
        (folder / name).write_text(f"{value}\n")
    now = probes.read_counters("can0")
    assert now is not None
    assert (now.frames, now.data) == (42, 296)
    difference = probes.traffic_between(now, BusTraffic(now.seconds + 2.0, 142, 1096))
    assert difference is not None
    assert difference.seconds == pytest.approx(2.0)
    assert (difference.frames, difference.data) == (100, 800)
    assert probes.traffic_between(None, now) is None


def test_protections_that_drives_may_lack_are_listed_once_each_with_their_drives() -> None:
    a, _, c = REAL.drives.each
    config = changed(
        REAL,
        "drives",
        A=msgspec.structs.replace(a, accept_without=("1006",)),
        C=msgspec.structs.replace(c, accept_without=("1006", "6041")),
    )
    found = bad(doctor.examine(config, GOOD))
    assert {name: check.found for name, check in found.items()} == {
        "lacking 1006": "drives A, C may lack 1006, its monitoring of SYNC; without: it continues without SYNC",
        "lacking 6041": "drives C may lack 6041, its report that it follows setpoints; without: that is not checked",
    }
    assert {check.verdict for check in found.values()} == {"warning"}
    assert all("trirail drives" in check.remedy for check in found.values())


@pytest.mark.parametrize(
    ("bitrate", "rate", "verdict"),
    [(1_000_000, 1000, "ok"), (500_000, 1000, "failure"), (800_000, 1000, "warning"), (500_000, 500, "ok")],
)
@pytest.mark.parametrize("setting", ["auto", "always"])
def test_bus_load(bitrate: int, rate: int, verdict: str, setting: str) -> None:
    config = changed(changed(REAL, "can", bitrate=bitrate), "loop", rate_hz=rate)
    assert next(drive_checks.load(changed(config, "drives", velocity_offset=setting))).verdict == verdict


LEFT = " are left to the loop"


@pytest.mark.parametrize(
    ("setting", "rate", "verdict", "found", "remedy"),
    [
        ("auto", 1000, "ok", "1 kHz uses 75 % of can0 at 1000000 bit/s; 250 µs of each cycle" + LEFT, ""),
        ("never", 1000, "ok", "1 kHz uses 63 % of can0 at 1000000 bit/s; 370 µs of each cycle" + LEFT, ""),
        ("auto", 500, "ok", "500 Hz uses 38 % of can0 at 1000000 bit/s; 1245 µs of each cycle" + LEFT, ""),
        (
            "auto", 1250, "warning",
            "1.25 kHz uses 79 % of can0 at 1000000 bit/s: setpoints without velocity offset (4 bytes), because 8 bytes "
            "would use 94 %; 171 µs of each cycle" + LEFT,
            "the drives follow with more lag; for the velocity offset, set loop.rate_hz below 1067; if the lag is "
            'acceptable, set drives.velocity_offset = "never"',
        ),
        (
            "always", 1250, "warning",
            "1.25 kHz uses 94 % of can0 at 1000000 bit/s; 51 µs of each cycle" + LEFT,
            'set loop.rate_hz below 1069, or a higher bitrate; or drives.velocity_offset = "auto" uses 79 %, or CAN FD '
            "(can.fd = true), if the drives and the adapter have it, uses 44 %",
        ),
        (
            "always", 2000, "failure", "2 kHz uses 149 % of can0 at 1000000 bit/s",
            "set loop.rate_hz below 1069, or a higher bitrate; or CAN FD (can.fd = true), if the drives and the "
            "adapter have it, uses 70 %",
        ),
    ],
)  # fmt: skip
def test_the_bus_line_says_why_setpoints_are_short(
    setting: str, rate: int, verdict: str, found: str, remedy: str
) -> None:
    config = changed(changed(REAL, "loop", rate_hz=rate), "drives", velocity_offset=setting)
    (check,) = drive_checks.load(config)
    assert (check.verdict, check.found, check.remedy) == (verdict, found, remedy)
    use = drive_checks.bus_use(config)
    assert (use.channel, use.bitrate, use.rate_hz) == ("can0", 1_000_000, rate)
    assert f"{100 * use.load:.0f} % of can0" in found
    assert use.budget_us == drive_checks.setpoint_budget_us(config)
    assert use.setpoint_bytes == (8 if use.velocity_offset else 4)
    assert (use.load_with_velocity_offset is not None) == ("because 8 bytes" in found)


@pytest.mark.parametrize("setting", ["always", "never"])
def test_odrives_have_no_velocity_offset(setting: str) -> None:
    config = load(ODRIVE)
    found = impossible.mistakes(changed(config, "drives", velocity_offset=setting))[0]
    assert [mistake.key for mistake in found] == ["drives.velocity_offset"]
    assert "omit the key" in found[0].text


def test_the_lag_of_simulated_drives_without_velocity_offset_is_judged() -> None:
    """Without feed-forward, the shipped servos lag 4 ms behind: more than the following error allows."""
    found = {}
    for setting in ("auto", "never"):
        checks = diagnose(changed(SIMULATED, "drives", velocity_offset=setting))
        found[setting] = [check.remedy for check in checks if check.name == "simulated"]
    assert found["auto"] == []
    assert found["never"] == ['set a shorter time_constant, or drives.velocity_offset = "always"']


RATES = st.sampled_from([1, 10, 50, 100, 125, 200, 250, 400, 500, 800, 1000, 1250, 2000, 4000])
BITRATES = st.sampled_from([10_000, 20_000, 50_000, 125_000, 250_000, 500_000, 800_000, 1_000_000]) | st.integers(
    10_000, 2_000_000
)


@pytest.mark.parametrize("protocol", PROTOCOLS)
@settings(max_examples=25)
@example(rate=500, bitrate=500_000, heartbeat=0.1)
@given(rate=RATES, bitrate=BITRATES, heartbeat=st.floats(0.01, 1.0))
def test_the_bus_load_is_judged_as_the_driver_does(protocol: str, rate: int, bitrate: int, heartbeat: float) -> None:
    heartbeat = max(heartbeat, 1.0 / rate)  # else the configuration is refused
    config = changed(SIMULATED, "can", bitrate=bitrate)
    scaled = {"B": msgspec.structs.replace(config.drives.B, counts_per_metre=25.0)} if protocol == "odrive" else {}
    config = changed(config, "drives", protocol=protocol, heartbeat=heartbeat, **scaled)
    config = changed(config, "loop", rate_hz=rate)
    clock = count(1000.0, 1e-6)
    bus = simulated_bus(config.can, config.drives, lambda: next(clock))
    driver = PROTOCOLS[protocol].driver(bus, BusTiming(bitrate), config.drives, lambda: next(clock))
    check = next(drive_checks.load(config))
    refused = ""
    try:
        driver.configure(config.period)
    except BusError as error:
        refused = str(error)
    bus.shutdown()
    warned = any("CAN bus" in warning for warning in driver.read().warnings)
    assert check.verdict == ("failure" if refused else "warning" if warned else "ok")
    (used,) = re.findall(r" uses (\d+) % of the bus ", check.found)
    assert f"{used}%" in (refused or f"{driver.bus_load:.0%}")


@pytest.mark.parametrize(("text", "found"), [("", ()), ("3", (3,)), ("1-3,6,8-9", (1, 2, 3, 6, 8, 9))])
def test_sets_of_processors(text: str, found: tuple[int, ...]) -> None:
    assert probes.processors(text) == found


def test_an_interface_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "SYSTEM", tmp_path)
    assert probes.link("can7") is None


def test_without_ip_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "class/net/can0").mkdir(parents=True)
    monkeypatch.setattr(probes, "SYSTEM", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ServiceError, match="iproute2"):
        probes.link("can0")


@pytest.mark.slow
@pytest.mark.parametrize("file", ["sim.toml", "socketcan.toml", "drives/odrive_s1.toml"])
def test_the_services_cycle_is_measured_without_the_configured_bus(file: str) -> None:
    config, shares = load(CONFIGS / file), list[float]()
    if config.drives.protocol == "cia402":  # a drive that must be homed is measured as if it were homed
        homed = msgspec.structs.replace(config.drives.A, homing=Homing(1, 0.1, 0.01, 1.0))
        config = changed(config, "drives", A=homed)
    config = changed(changed(config, "loop", realtime="off", rate_hz=200), "can", channel="no_such_bus")
    found = cycle_timing.measure(config, 0.5, shares.append)
    assert isinstance(found, Cycles), found
    assert found.fault == ""
    assert shares == pytest.approx([0.5, 1.0])
    assert len(found.lateness) == len(found.work) == len(found.to_record) == 100
    assert found.period == 5_000_000
    assert all(found.lateness >= 0)
    assert all(found.work > 0)
    assert all(found.to_record >= found.work)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("section", "values", "reason"),
    [
        ("can", {"bitrate": 100_000}, "simulated drives: "),
        (
            "can",
            {"simulated": Simulated(start=(9.0, 9.0, 9.0))},
            "the robot with simulated drives could not be enabled",
        ),
    ],
    ids=["drives", "robot"],
)
def test_drives_or_robots_that_do_not_start_are_one_line(
    section: str, values: dict[str, Any], reason: str, capfd: pytest.CaptureFixture[str]
) -> None:
    found = cycle_timing.measure(changed(changed(SIMULATED, "loop", realtime="off"), section, **values), 0.1)
    assert isinstance(found, str)
    assert found.startswith(reason)
    assert "\n" not in found
    assert capfd.readouterr() == ("", "")
    assert doctor_cycle.cycle(found, SIMULATED).verdict == "warning"


def test_a_process_that_ends_early_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cycle_timing, "python", lambda *_: [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"])
    found = cycle_timing.measure(SIMULATED, 0.1)
    assert found == "the process that runs the cycles has ended: killed by SIGKILL"


@pytest.mark.slow
def test_an_interrupted_measurement_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []

    class Kept(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            started.append(self.pid)

    def interrupt(_: float) -> None:
        (process,) = started
        started.extend(int(each) for each in Path(f"/proc/{process}/task/{process}/children").read_text().split())
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Kept)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(KeyboardInterrupt):
        cycle_timing.measure(changed(SIMULATED, "loop", realtime="off"), 600.0, interrupt)
    assert len(started) == 2
    assert list(tmp_path.iterdir()) == []
    deadline = time.monotonic() + 30.0
    while any(is_alive(process) for process in started):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_an_interrupted_measurement_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object, **__: object) -> Machine:
        raise KeyboardInterrupt

    monkeypatch.setattr(probes, "machine", interrupt)
    with pytest.raises(KeyboardInterrupt):
        app.doctor()
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert "the measurement was interrupted" in told.err


def is_alive(process: int) -> bool:
    """Whether a process runs; a zombie does not."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def test_a_fault_during_the_measurement_is_a_failure() -> None:
    check = doctor_cycle.cycle(cycles([0] * 10, 1000)._replace(fault="drive A: frozen"), REAL)
    assert check.verdict == "failure"
    assert "the robot stopped: drive A: frozen" in check.found


def test_the_governor_of_every_processor_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "SYSTEM", tmp_path)
    assert probes.governors() == {}
    for cpu, name in {0: "performance", 10: "schedutil", 2: "schedutil"}.items():
        folder = tmp_path / f"devices/system/cpu/cpu{cpu}/cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(f"{name}\n")
    (tmp_path / "devices/system/cpu/cpufreq").mkdir()
    assert probes.governors() == {0: "performance", 2: "schedutil", 10: "schedutil"}
    check = doctor.governor(probes.governors())
    assert (check.verdict, check.found) == ("warning", "schedutil on processor 2, 10")
    assert check.remedy == "cpupower frequency-set --governor performance"


TIMING = MeasuredTiming(
    source="service",
    timestamps="hardware",
    rate_hz=500,
    syncs=2500,
    interval_error_us=Percentiles(1.0, 2.0, 3.0, 4.0),
    setpoints_us=Percentiles(400.0, 500.0, 600.0, 1000.0),
    without_setpoints=0,
)


def test_the_timing_on_the_bus_is_a_share_of_the_period() -> None:
    checks = doctor.examine(REAL, msgspec.structs.replace(GOOD, bus_timing=TIMING))
    (check,) = [each for each in checks if each.name == "can0 timing"]
    assert check == Check(
        "can0 timing",
        "ok",
        "hardware loopback timestamps, 2500 SYNCs of the running service at 500 Hz: SYNC off its period p50 1, p99 2, "
        "p99.9 3, worst 4 µs; last setpoint p50 20%, p99.9 30%, worst 50% of the period after SYNC",
    )


@pytest.mark.parametrize(
    ("timing", "verdict", "said"),
    [
        ("", None, ""),
        ("Network is down", "ok", "not measured: Network is down"),
        (msgspec.structs.replace(TIMING, without_setpoints=3), "warning", "3 cycles without a setpoint"),
        (msgspec.structs.replace(TIMING, setpoints_us=None), "warning", "no setpoints were sent"),
        (msgspec.structs.replace(TIMING, source="test frames"), "ok", "SYNCs of test frames, which no drive uses"),
    ],
)
def test_what_the_timing_on_the_bus_lacks_is_told(timing: MeasuredTiming | str, verdict: str | None, said: str) -> None:
    checks = doctor_cycle.on_bus(timing, REAL)
    assert [check.verdict for check in checks] == ([verdict] if verdict else [])
    assert all(said in check.found for check in checks)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [({}, ""), ({"bitrate": 500_000}, "bit rate"), ({"state": "ERROR-PASSIVE"}, "not error-active")],
)
def test_nothing_is_sent_on_an_interface_that_would_disturb_its_bus(changes: dict[str, Any], reason: str) -> None:
    found = probes.unfit(link(**changes), DEFAULT_TIMING)
    assert reason in found
    assert bool(found) == bool(reason)
    assert probes.unfit({"linkinfo": {"info_kind": "vcan"}}, DEFAULT_TIMING) == ""
    assert "on a CAN FD bus" in probes.unfit(link(), BusTiming(1_000_000, 5_000_000))


def test_the_bus_is_measured_only_if_it_is_up_and_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "loop_on", lambda cpu: 7)
    monkeypatch.setattr(probes, "measure_bus", lambda *_: TIMING)
    config = changed(REAL, "loop", realtime="off", cpu=1)
    for report, quick, measured in ((LINK, False, TIMING), (LINK, True, ""), (link(flags=["NOARP"]), False, "")):
        monkeypatch.setattr(probes, "link", lambda name, report=report: report)
        assert probes.machine(config, quick=quick).bus_timing == measured


def test_an_interface_stands_for_the_shipped_configuration_on_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(probes, "link", lambda name: link(bitrate=250_000))
    assert all(probes.is_interface(Path(name)) for name in ("can0", "vcan12", "slcan1"))
    assert not any(probes.is_interface(Path(name)) for name in ("can0.toml", "robot.toml", "can", "x/can0"))
    config = probes.on_interface(REAL, "can3")
    assert (config.can.interface, config.can.channel, config.can.bitrate) == ("socketcan", "can3", 250_000)
    (tmp_path / "can0").write_text("")
    assert not probes.is_interface(Path("can0"))


def test_a_loop_on_the_same_processor_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "PROCESSES", tmp_path)
    for pid, called, allowed in ((7, "trirail: loop", "2-3"), (8, "trirail: planner", "1"), (9, "sh", "0-3")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "cmdline").write_bytes(called.encode() + b"\0\0")
        (tmp_path / str(pid) / "status").write_text(f"Name:\tx\nCpus_allowed:\tf\nCpus_allowed_list:\t{allowed}\n")
    (tmp_path / "10").mkdir()
    assert {cpu: probes.loop_on(cpu) for cpu in range(4)} == {0: None, 1: None, 2: 7, 3: 7}


def test_beside_a_loop_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "loop_on", lambda cpu: 7)
    config = changed(SIMULATED, "loop", realtime="off", cpu=1)
    assert str(probes.machine(config).cycles).startswith("a service's loop, process 7, runs on processor 1; end that")


def test_a_quick_look_measures_nothing_and_gives_the_rights_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "loop_on", lambda cpu: None)
    before = os.sched_getaffinity(0), os.sched_getscheduler(0)
    assert probes.machine(SIMULATED, quick=True).cycles == ""
    assert (os.sched_getaffinity(0), os.sched_getscheduler(0)) == before


@pytest.mark.slow
@pytest.mark.parametrize("json_wanted", [True, False], ids=["json", "words"])
def test_the_command(json_wanted: bool) -> None:
    command = [sys.executable, "-m", "trirail", "doctor", str(SIM), *(["--json"] if json_wanted else [])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.stderr == ""
    if json_wanted:
        said = json.loads(done.stdout)
        verdicts = {check["name"]: check["verdict"] for check in said["checks"]}
        assert verdicts["CAN"] == "ok"
        assert said["bus_timing"] is None
        if said["cycle"] is not None:  # another service may run here
            assert said["cycle"]["rate_hz"] == 1000
            assert 0 < said["cycle"]["cycles"] <= 10_000  # a stall of the machine may end it by a fault
            assert said["cycle"]["cycle_us"]["p50"] <= said["cycle"]["record_us"]["p50"]
        assert said["bus"]["rate_hz"] == 1000
        assert said["bus"]["setpoint_bytes"] == 8
        assert (done.returncode == 0) == said["ok"] == ("failure" not in verdicts.values())
    else:
        assert "simulated: no hardware is used" in done.stdout


@pytest.mark.parametrize(
    ("address", "tls", "verdict", "by"),
    [
        ("127.0.0.1", False, "ok", "every user of this machine"),
        ("0.0.0.0", True, "ok", "users with a certificate and a role"),
        ("0.0.0.0", False, "warning", "everybody in the network"),
    ],
)
def test_who_can_read_the_metrics_is_told(address: str, tls: bool, verdict: str, by: str) -> None:
    config = changed(SIMULATED, "telemetry", metrics_port=9464, metrics_address=address)
    (check,) = doctor.metrics(changed(config, "zenoh", tls=Tls() if tls else None))
    assert (check.verdict, check.found) == (verdict, f"tcp/{address}:9464: {by} can read them")
    assert doctor.metrics(SIMULATED) == []


def test_whether_the_routers_answer_is_told() -> None:
    good, bad = doctor.routers([("tls/192.0.2.9:7447", ""), ("tls/192.0.2.8:7447", "connection refused")])
    assert (good.verdict, good.found) == ("ok", "tls/192.0.2.9:7447 answers")
    assert (bad.verdict, bad.found) == ("warning", "tls/192.0.2.8:7447: connection refused")
    assert bad.remedy


def test_the_routers_are_asked() -> None:
    nobody = "tcp/127.0.0.1:1"
    config = changed(SIMULATED, "zenoh", connect=(nobody,))
    config = changed(config, "loop", realtime="off")
    assert probes.machine(config, quick=True).routers == ((nobody, "connection refused"),)


PORTS = st.integers(1, 65535)


@given(
    single=st.lists(PORTS, max_size=3),
    ranges=st.lists(st.tuples(PORTS, st.integers(0, 20)), max_size=3),
    counted=st.lists(PORTS, max_size=2),
)
def test_ports_of_the_firewall_may_be_ranges(
    single: list[int], ranges: list[tuple[int, int]], counted: list[int]
) -> None:
    elements = [
        *single,
        *({"range": [first, first + more]} for first, more in ranges),
        *({"elem": {"val": port, "comment": "x"}} for port in counted),
    ]
    answers = {
        "tables": {"nftables": [{"table": {"family": "inet", "name": "trirail"}}]},
        "set": {"nftables": [{"set": {"elem": elements}}]},
    }

    def run(command: tuple[str, ...], **_: object) -> subprocess.CompletedProcess[bytes]:
        return subprocess.CompletedProcess(command, 0, json.dumps(answers[command[3]]).encode())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "run", run)
        assert set(probes.limited_ports() or ()) == {
            *single,
            *counted,
            *(port for first, more in ranges for port in range(first, first + more + 1)),
        }
