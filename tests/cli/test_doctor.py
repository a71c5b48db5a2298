"""The doctor: each check judges what was read as it should, names the remedy, and the command says it all."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.cli import doctor, doctor_network, probes
from trirail.cli.machine import Gathered, Machine, Passed
from trirail.config import SIM, Config, Tls, everything, load
from trirail.diagnosis import Check, drives
from trirail.errors import ServiceError
from trirail.processes.clock import Tick
from trirail_drivers.bus.frames import bits_of, frame_bits
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.errors import BusError
from trirail_drivers.protocols import PROTOCOLS

CONFIGS = SIM.parent
SIMULATED = load(SIM)
REAL = load(CONFIGS / "socketcan.toml")

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
    governor="performance",
    isolated=(2, 3),
    link=LINK,
    gathered=Gathered(1, 0),
    ticks=(Tick(0, 20_000, 0),) * 2000,
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
        ({"governor": "powersave"}, "governor", "warning", "cpupower"),
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
        ({"gathered": Gathered(8, 0)}, "can0 coalescing", "warning", "ethtool -C can0 rx-usecs-irq 0 rx-frames-irq 1"),
        ({"gathered": Gathered(0, 50)}, "can0 coalescing", "warning", "ip link set can0 down"),
        ({"ticks": (Tick(0, 0, 0), *(Tick(0, 900_000, 0),) * 3)}, "lateness", "warning", "loop.rate_hz"),
        ({"ticks": (Tick(0, 0, 0), Tick(0, 0, 1), Tick(0, 0, 0))}, "lateness", "warning", "isolate"),
        ({"ticks": (Tick(0, 0, 6), Tick(0, 0, 5), Tick(0, 0, 0))}, "lateness", "failure", "isolate"),
    ],
)
def test_each_fault_of_a_machine_is_named_with_its_remedy(
    values: dict[str, Any], name: str, verdict: str, remedy: str
) -> None:
    (found,) = bad(doctor.examine(REAL, msgspec.structs.replace(GOOD, **values))).values()
    assert (found.name, found.verdict) == (name, verdict)
    assert remedy in found.remedy
    assert "\n" not in found.found + found.remedy


@pytest.mark.parametrize(("protocol", "verdict"), [("cia402", "ok"), ("odrive", "warning")])
def test_the_queue_takes_two_cycles_of_the_protocol(protocol: str, verdict: str) -> None:
    machine = msgspec.structs.replace(GOOD, link=link(txqlen=20))
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
        return msgspec.structs.replace(GOOD, governor="powersave")

    checks = bad(doctor.whole(tmp_path / "robot.toml", everything(tmp_path / "robot.toml"), machine))
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
    apart = (Tick(0, 0, 6), Tick(0, 0, 0), Tick(0, 0, 6))
    assert doctor.lateness(apart, REAL).verdict == "warning"


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
    machine = msgspec.structs.replace(GOOD, passed=Passed(2.0, frames, 8 * frames))
    (check,) = [check for check in doctor.examine(REAL, machine) if check.name == "can0 traffic"]
    assert check.verdict == verdict
    assert float(check.found.partition("%")[0]) == pytest.approx(frames * frame_bits(8) / 2e4, abs=0.6)


@given(st.lists(st.integers(0, 8), max_size=50))
def test_bits_are_those_of_the_frames_one_a_frame_at_most_too_many(lengths: list[int]) -> None:
    bits = sum(map(frame_bits, lengths))
    assert bits <= bits_of(len(lengths), sum(lengths)) < bits + len(lengths) + 1


def test_the_kernels_counters_are_read_and_subtracted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "SYSTEM", tmp_path)
    assert probes.counted("can0") is None
    assert probes.counted("") is None
    folder = tmp_path / "class/net/can0/statistics"
    folder.mkdir(parents=True)
    for name, value in {"rx_packets": 30, "tx_packets": 12, "rx_bytes": 200, "tx_bytes": 96}.items():
        (folder / name).write_text(f"{value}\n")
    now = probes.counted("can0")
    assert now is not None
    assert (now.frames, now.data) == (42, 296)
    difference = probes.passed(now, Passed(now.seconds + 2.0, 142, 1096))
    assert difference is not None
    assert difference.seconds == pytest.approx(2.0)
    assert (difference.frames, difference.data) == (100, 800)
    assert probes.passed(None, now) is None


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
        "lacking 1006": "drives A, C may lack 1006, its watch on SYNC; without: it goes on without SYNC",
        "lacking 6041": "drives C may lack 6041, saying that it follows setpoints; without: that is not looked at",
    }
    assert {check.verdict for check in found.values()} == {"warning"}
    assert all("trirail drives" in check.remedy for check in found.values())


@pytest.mark.parametrize(
    ("bitrate", "rate", "verdict"),
    [(1_000_000, 1000, "ok"), (500_000, 1000, "failure"), (800_000, 1000, "warning"), (500_000, 500, "ok")],
)
def test_bus_load(bitrate: int, rate: int, verdict: str) -> None:
    config = changed(changed(REAL, "can", bitrate=bitrate), "loop", rate_hz=rate)
    assert next(drives.load(config)).verdict == verdict


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
    driver = PROTOCOLS[protocol].driver(bus, bitrate, config.drives, lambda: next(clock))
    check = next(drives.load(config))
    refused = ""
    try:
        driver.configure(config.period)
    except BusError as error:
        refused = str(error)
    bus.shutdown()
    warned = any("CAN bus" in warning for warning in driver.read().warnings)
    assert check.verdict == ("failure" if refused else "warning" if warned else "ok")
    assert check.found.split(" ")[0] in (refused or f"{driver.bus_load:.0%}")


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


def test_ticks_are_those_of_the_period(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "MEASURED", 0.02)
    found = probes.ticks(0.001)
    assert len(found) == 20
    assert all(tick.deadline_ns > 0 and tick.lateness_ns >= 0 for tick in found)


@pytest.mark.slow
@pytest.mark.parametrize("json_wanted", [True, False], ids=["json", "words"])
def test_the_command(json_wanted: bool) -> None:
    command = [sys.executable, "-m", "trirail", "doctor", str(SIM), *(["--json"] if json_wanted else [])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""
    if json_wanted:
        said = json.loads(done.stdout)
        verdicts = {check["name"]: check["verdict"] for check in said["checks"]}
        assert verdicts["CAN"] == "ok"
        assert (done.returncode == 0) == said["ok"] == ("failure" not in verdicts.values())
    else:
        assert "simulated: no hardware is used" in done.stdout


@pytest.mark.parametrize(
    ("address", "tls", "verdict", "by"),
    [
        ("127.0.0.1", False, "ok", "every user of this machine"),
        ("0.0.0.0", True, "ok", "who has a role, by his certificate,"),
        ("0.0.0.0", False, "warning", "everybody in the network"),
    ],
)
def test_who_can_read_the_metrics_is_told(address: str, tls: bool, verdict: str, by: str) -> None:
    config = changed(SIMULATED, "telemetry", metrics_port=9464, metrics_address=address)
    (check,) = doctor_network.metrics(changed(config, "zenoh", tls=Tls() if tls else None))
    assert (check.verdict, check.found) == (verdict, f"tcp/{address}:9464: {by} can read them")
    assert doctor_network.metrics(SIMULATED) == []


def test_whether_the_routers_answer_is_told() -> None:
    good, bad = doctor_network.routers([("tls/192.0.2.9:7447", ""), ("tls/192.0.2.8:7447", "connection refused")])
    assert (good.verdict, good.found) == ("ok", "tls/192.0.2.9:7447 answers")
    assert (bad.verdict, bad.found) == ("warning", "tls/192.0.2.8:7447: connection refused")
    assert bad.remedy


def test_the_routers_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probes, "MEASURED", 0.02)
    nobody = "tcp/127.0.0.1:1"
    config = changed(SIMULATED, "zenoh", connect=(nobody,))
    config = changed(config, "loop", realtime="off")
    assert probes.machine(config).routers == ((nobody, "connection refused"),)
