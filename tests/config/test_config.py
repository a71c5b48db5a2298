"""Configuration files: what is right is taken, what is wrong is refused with key, value and remedy."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Annotated, get_args, get_origin

import msgspec
import numpy as np
import pytest
from conftest import Rig
from hypothesis import assume, example, given, reject, settings
from hypothesis import strategies as st
from msgspec import Meta, Struct
from msgspec.structs import fields
from trirail.config import (
    SIM,
    Config,
    FramesTable,
    GeometryTable,
    PlatformLimits,
    SliderLimits,
    Zenoh,
    everything,
    geometry,
    impossible,
    load,
    metrics_url,
    parse,
    wrong_values,
)
from trirail.config.impossible import check
from trirail.config.loading import parse_values
from trirail.config.tables import LegTable
from trirail.errors import ConfigError, KinematicsError
from trirail.kinematics.robot import forward, inverse
from trirail.motion import paths
from trirail.motion.backlash_reserve import planned_limits
from trirail.motion.limits import Bounds
from trirail.telemetry import provenance
from trirail.wire.goals import PoseGoal
from trirail.wire.text import printable
from trirail.wire.vocabulary import Mode
from trirail.workspace.singularity import distance_to_singularity
from trirail.workspace.violations import violations
from trirail.workspace.workspace import permitted_slice
from trirail_drivers.config import Can, Drive, ObjectWrite
from trirail_drivers.errors import MAX_MESSAGE_LENGTH, BusError, DriveError
from trirail_drivers.interface import Triple

TEXT = SIM.read_text()
LISTEN, TLS = 'listen = ["tcp/127.0.0.1:7447"]', 'listen = ["tls/0.0.0.0:7447"]\n[zenoh.tls]'
CONFIGS = sorted(SIM.parent.rglob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_configurations_load(path: Path) -> None:
    assert load(path).robot.name


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("rate_hz = 1000", "rate_hz = 'fast'", "loop.rate_hz = 'fast': expected integer, 1 to 4000"),
        ("rate_hz = 1000", "rate_hx = 1000", "loop.rate_hx: unknown key; did you mean rate_hz?"),
        ("rate_hz = 1000", "rate_hz = 5000", "loop.rate_hz = 5000: expected integer, 1 to 4000"),
        (
            "rate_hz = 1000",
            "rate_hz = 999",
            "loop.rate_hz = 999: a cycle must be a whole number of microseconds",
        ),
        ("rate_hz = 1000", "", "loop.rate_hz: missing key"),
        (
            LISTEN,
            'listen = ["tcp/0.0.0.0:7447"]',
            "zenoh.listen[0] = 'tcp/0.0.0.0:7447': anyone on its network can move",
        ),
        (LISTEN, 'listen = ["tcp/127.0.0.1:1", "tcp/[::]:2"]', "zenoh.listen[1] = 'tcp/[::]:2': anyone on its network"),
        (LISTEN, 'listen = ["tls/0.0.0.0:7447"]', "zenoh.listen[0] = 'tls/0.0.0.0:7447': tls needs [zenoh.tls]"),
        (
            LISTEN,
            'listen = ["tcp/127.0.0.1"]',
            "zenoh.listen[0] = 'tcp/127.0.0.1': the port is missing: an endpoint is",
        ),
        (
            LISTEN,
            'listen = ["127.0.0.1:7420"]',
            "= '127.0.0.1:7420': the protocol is missing: an endpoint is protocol/",
        ),
        (
            LISTEN,
            'listen = ["tcp/127.0.0.1:70000"]',
            "the port must be 1 to 65535: an endpoint is protocol/address, such as",
        ),
        (LISTEN, f'{LISTEN}\nconnect = ["tcp/hub"]', "zenoh.connect[0] = 'tcp/hub': the port is missing"),
        (
            LISTEN,
            'listen = ["tpc/127.0.0.1:7447"]',
            "zenoh.listen[0] = 'tpc/127.0.0.1:7447': the protocol tpc is unknown: use tcp, tls or unixsock-stream",
        ),
        (
            LISTEN,
            'listen = ["unixsock//tmp/x"]',
            "zenoh.listen[0] = 'unixsock//tmp/x': the protocol unixsock is unknown: use tcp, tls or unixsock-stream",
        ),
        (
            LISTEN,
            'listen = ["unixsock-stream/~/x"]',
            "zenoh.listen[0] = 'unixsock-stream/~/x': the path ~/x is relative: use an absolute path, such as",
        ),
        (
            LISTEN,
            'listen = ["unixsock-stream//tmp/x", "unixsock-stream//tmp/x.stop"]',
            "zenoh.listen[1]: /tmp/x.stop is also a file of zenoh.listen[0]; use another name for the socket",
        ),
        (
            LISTEN,
            'listen = ["unixsock-stream//tmp/x.lock", "tcp/127.0.0.1:7447", "unixsock-stream//tmp//x"]',
            "zenoh.listen[2]: /tmp/x.lock is also a file of zenoh.listen[0]; use another name for the socket",
        ),
        (
            LISTEN,
            'listen = ["unixsock-stream//tmp/x", "unixsock-stream//tmp/./x"]',
            "zenoh.listen[1]: /tmp/x is also a file of zenoh.listen[0]; use another name for the socket",
        ),
        (LISTEN, 'listen = ["tcp/127.0.0.1:9876"]', "telemetry.live_port: port 9876 is also that of zenoh.listen[0]"),
        ("live_port = 9876", "live_port = 7447", "telemetry.live_port: port 7447 is also that of zenoh.listen[0]; use"),
        (
            "[telemetry]",
            "[telemetry]\nmetrics_port = 9876",
            "telemetry.metrics_port: port 9876 is also that of telemetry.live",
        ),
        (
            "[telemetry]",
            "[telemetry]\nmetrics_port = 7447",
            "telemetry.metrics_port: port 7447 is also that of zenoh.listen[0]",
        ),
        (
            "live_port = 9876",
            "live_port = 8447",
            "telemetry.live_port: port 8447 is also the stop port of zenoh.",
        ),
        (
            "[telemetry]",
            "[telemetry]\nmetrics_port = 8447",
            "telemetry.metrics_port: port 8447 is also the stop port of zenoh.listen[0]; use different ports",
        ),
        (
            LISTEN,
            'listen = ["tcp/127.0.0.1:8447", "tcp/[::1]:7447", "tcp/127.0.0.1:7447"]',
            "zenoh.listen[0]: port 8447 is also the stop port of zenoh.listen[2]; use different ports",
        ),
        (
            LISTEN,
            'listen = ["tcp/127.0.0.1:62600", "tcp/127.0.0.1:64600"]',
            "zenoh.listen[1]: stop port 63600 is also the stop port of zenoh.listen[0]; use different ports",
        ),
        ("[loop]", "[poses]\n5mm = [0.0, 0.0, 0.0]\n[loop]", "poses.5mm: 5mm reads as a number or a quantity"),
        (LISTEN, f"{LISTEN}\n[zenoh.tls]", "with [zenoh.tls] every endpoint must be tls/ADDRESS:PORT"),
        (LISTEN, f"{TLS.replace(':7447', ':7447#enable_mtls=false')}", "settings after # would bypass [zenoh.tls]"),
        (
            LISTEN,
            TLS.replace("\n", '\nconnect = ["tls/192.0.2.9:7447"]\n', 1),
            "zenoh.connect: with [zenoh.tls], zenoh.router must be the name in the router's certificate",
        ),
        (LISTEN, f'{LISTEN}\nrouter = "hub"', "zenoh.router: this setting needs [zenoh.tls] and zenoh.connect"),
        (
            LISTEN,
            TLS.replace("\n", '\nconnect = ["tls/192.0.2.9:7447"]\nrouter = "hub"\n', 1)
            + '\n[zenoh.users]\nhub = "viewer"',
            "zenoh.router: hub is also a user; use another name for the router",
        ),
        (
            LISTEN,
            f'{LISTEN}\n[zenoh.users]\nann = "viewer"',
            "zenoh.users: without [zenoh.tls], the names of users are not verified",
        ),
        (
            LISTEN,
            f'{TLS}\n[zenoh.users]\nbob = "viewer"\nann = "boss"',
            "zenoh.users.ann = 'boss': expected one of 'viewer'",
        ),
        (
            LISTEN,
            f"{TLS}\n[zenoh.users]\nann = 3",
            "zenoh.users.ann = 3: expected one of 'viewer', 'operator'",
        ),
        (
            LISTEN,
            f'{TLS}\n[zenoh.users]\n"a b" = "viewer"',
            "zenoh.users: 'a b' is not a valid name here: expected text matching",
        ),
        ("[watchdogs]", "[watchdog]", "watchdog: unknown section; did you mean watchdogs?"),
        ("[zenoh]", "[drives.zenoh]", "drives.zenoh: unknown key; allowed are protocol"),
        ("[loop]", "[loop", "not TOML"),
        ("[loop]", "[frames]\ntools = 1\n[loop]", "frames.tools: unknown key; did you mean tool?"),
        (
            "[loop]",
            "[frames.tool]\ncamera = [0.1, 'x']\n[loop]",
            "frames.tool.camera[1] = 'x': expected number, -100 to 100",
        ),
        (
            "[loop]",
            "[frames.tool]\na = [0.1, 0.2]\ncamera = [0.1]\n[loop]",
            "frames.tool.camera = [0.1]: expected array",
        ),
        (
            "[loop]",
            "[frames.work]\npart = [0.1, 0.0, 9.0]\n[loop]",
            "frames.work.part[2] = 9.0: expected number, -6.28318 to 6.28318",
        ),
        (
            "[loop]",
            "[frames.tool]\n'my camera' = [0.1, 0.0]\n[loop]",
            "frames.tool: 'my camera' is not a valid name here: expected text matching",
        ),
        (
            "[loop]",
            "[frames.work]\nbase = [0.1, 0.0, 0.0]\n[loop]",
            "frames.work.base: the name is reserved",
        ),
        ("node = 3", "nod = 3", "drives.C.nod: unknown key; did you mean node?"),
        (
            "node = 2",
            "node = 1",
            "node ids must differ, but are drives.A.node = 1, drives.B.node = 1, drives.C.node = 3, ",
        ),
        ("node = 1", "node = 0", "drives.A.node = 0: on CANopen, 0 addresses all nodes; use 1 to 127"),
        ("node = 2", "node = 128", "drives.B.node = 128: expected integer, 0 to 127"),
        (
            'protocol = "cia402"',
            'protocol = "ethercat"',
            "drives.protocol = 'ethercat': expected one of 'cia402', 'odrive'",
        ),
        (
            'protocol = "cia402"',
            'protocol = "odrive"',
            "that is 1e+07 turns/s, beyond the limit of an ODrive's feed-forward, 32.767",
        ),
        ('realtime = "prefer"', 'realtime = "yes"', "expected one of 'enforce', 'off', 'prefer'"),
        (
            "gateway_timeout = 0.3",
            "gateway_timeout = 0.1",
            "watchdogs.gateway_timeout = 0.1: expected number, 0.2 to 10",
        ),
        ('name = "demo"', 'name = "fault"', 'robot.name = "fault": recordings of a fault have this name'),
        ("live_mb = 64", "live_mb = 0", "telemetry.live_mb = 0: expected number, 1 to 4096"),
        ("l0 = 0.3", "l0 = nan", "geometry.l0 = nan: it must be a finite number"),
        ("l0 = 0.3", "l0 = -0.3", "geometry.l0 = -0.3: expected number, 0.001 to 100"),
        ("l0 = 0.3", "l0 = '0.3'", "geometry.l0 = '0.3': expected number, 0.001 to 100"),
        ("l0 = 0.3", "", "give either l0 (the symmetric robot) or three [[geometry.leg]] tables"),
        (
            "following_error = 0.004",
            "following_error = true",
            "limits.slider.following_error = True: expected number, 1e-06 to 1",
        ),
        (
            "x = [-0.15, 0.15]",
            "x = [0.1, -0.1]",
            "limits.platform.x = [0.1, -0.1]: the lower limit must be below",
        ),
        ("x = [-0.15, 0.15]", "x = [0.1]", "limits.platform.x = [0.1]: expected array of length 2"),
        ("phi = [-1.2, 0.85]", "phi = [-1.2, 1.0]", "singular angle 1.0472; keep it within [-1.9443, 0.8971]"),
        ("phi = [-1.2, 0.85]", "phi = [-2.1, 0.8]", "singular angle -2.0944; keep it within [-1.9443, 0.8971]"),
        (
            "phi = [-1.2, 0.85]",
            "phi = [1.3, 2.0]",
            "beyond the singular angle 1.0472, where the pose cannot be computed",
        ),
        ("phi = [-1.2, 0.85]", "phi = [-4.5, -3.0]", "beyond the singular angle -2.0944, where"),
        ("phi = [-1.2, 0.85]", "phi = [6.0, 6.2]", "from the sliders; keep it within [-1.9443, 0.8971]"),
        ("jerk = [40.0, 40.0, 300.0]", "jerk = [40.0, 0.0, 300.0]", "jerk[1] = 0.0: expected number, 0.001 to 1e+06"),
    ],
)
def test_wrong_ones_are_refused_in_one_line(right: str, wrong: str, said: str) -> None:
    assert right in TEXT
    with pytest.raises(ConfigError) as refused:
        parse(TEXT.replace(right, wrong, 1))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "right", "wrong", "said"),
    [
        (
            "xxy",
            "edge_point = [0.0, 0.06]",
            "pivot = [0.0, 0.06]",
            "leg A: pivot is allowed only with kind 3-PPR (the cross slide keeps its direction)",
        ),
        ("xxy", "edge_angle = 0.0\n", "\n", "geometry: leg C has no edge_angle, which kind 3-PRP needs"),
        ("uvw-ppr", "pivot = [0.0575, 0.0575]\n", "\n", "geometry: leg B has no pivot, which kind 3-PPR needs"),
    ],
)
def test_legs_with_keys_of_the_other_mechanism_are_refused(name: str, right: str, wrong: str, said: str) -> None:
    text = (SIM.parent / f"{name}.toml").read_text()
    assert right in text
    with pytest.raises(ConfigError, match=re.escape(said)):
        parse(text.replace(right, wrong, 1))


def test_the_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    with pytest.raises(ConfigError, match=r"robot\.toml: No such file"):
        load(path)
    path.write_text("[robot]\nname = 3\n")
    with pytest.raises(ConfigError, match=r"robot\.toml: "):
        load(path)


def test_a_robot_as_built() -> None:
    leg = (
        "[[geometry.leg]]\nanchor = [{x}, {y}]\nrail_angle = {r}\n"
        "home = 0.17\nedge_point = [0.0, 0.0]\nedge_angle = {e}\n"
    )
    legs = "".join(
        leg.format(x=x, y=y, r=r, e=r - 1.05)
        for x, y, r in ((0.0, -0.3, 1.05), (0.26, 0.15, 3.14), (-0.26, 0.15, -1.05))
    )
    text = TEXT.replace("l0 = 0.3", legs, 1).replace("phi = [-1.2, 0.85]", "phi = [-0.5, 0.5]")
    assert parse(text).geometry.leg is not None


HOMING = "[drives.B.homing]\nmethod = {method}\nspeed_switch = 0.02\nspeed_zero = {zero}\nacceleration = 0.5\n"


def test_homing_is_for_drives_that_have_a_table_of_it() -> None:
    assert [drive.homing for drive in parse(TEXT).drives.each] == [None, None, None]
    drives = parse(TEXT.replace("[drives.C]\n", HOMING.format(method=-3, zero=0.005) + "[drives.C]\n")).drives
    assert drives.B.homing is not None
    assert (drives.A.homing, drives.B.homing.method, drives.C.homing) == (None, -3, None)


@pytest.mark.parametrize(
    ("method", "zero", "said"),
    [
        (0, 0.005, "method 0 means no homing"),
        (300, 0.005, "drives.B.homing.method = 300: expected integer, -128 to 127"),
        (19, 0.0, "drives.B.homing.speed_zero = 0.0: expected number, 1e-05 to 100"),
    ],
)
def test_homing_that_is_refused(method: int, zero: float, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(TEXT.replace("[drives.C]\n", HOMING.format(method=method, zero=zero) + "[drives.C]\n"))
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (
            HOMING.format(method=19, zero=0.005),
            "drives.B.homing: homing is CiA 402's, an ODrive must know its position at power-on",
        ),
        ('[drives.B]\neds = "maker.eds"\n', "drives.B.eds = maker.eds: an ODrive has no object dictionary"),
    ],
)
def test_what_odrives_do_not_have_is_refused(table: str, said: str) -> None:
    text = TEXT.replace('protocol = "cia402"', 'protocol = "odrive"').replace(
        "counts_per_metre = 1e7", "counts_per_metre = 25.0"
    )
    text = (
        text.replace("[drives.B]\n", table)
        if "[drives.B]" in table
        else text.replace("[drives.C]\n", table + "[drives.C]\n")
    )
    with pytest.raises(ConfigError, match=re.escape(said)):
        parse(text)


def test_a_table_whose_stand_ins_do_not_go_together_is_told_once() -> None:
    write = 'write = [{object = 0x208E, value = 70000, type = "u64", why = "test"}]'
    with pytest.raises(ConfigError, match=r"drives\.B\.write\[0\]\.type = 'u64': expected one of 'i16', "):
        parse(TEXT.replace("[drives.B]\n", f"[drives.B]\n{write}\n"))


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ("index = 0", 'can.options.index: "simulated" has no options'),
        ('"tty baudrate" = 1', "can.options"),
        ("timing = [1, 2]", "can.options"),
    ],
)
def test_options_of_the_bus_that_are_refused(table: str, said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        parse(f"{TEXT}\n[can.options]\n{table}\n")


@pytest.mark.parametrize(("interface", "allowed"), [("simulated", True), ("unix", True), ("socketcan", False)])
def test_only_a_bus_without_a_wire_is_faster_than_classical_can(interface: str, allowed: bool) -> None:
    text = TEXT.replace("bitrate = 1_000_000", "bitrate = 8_000_000")
    text = text.replace('interface = "simulated"', f'interface = "{interface}"\nchannel = "x"')
    if allowed:
        assert parse(text).can.bitrate == 8_000_000
    else:
        with pytest.raises(ConfigError, match=r"can\.bitrate = 8000000: the maximum of classical CAN is 1000000 bit/s"):
            parse(text)


@pytest.mark.parametrize("name", ["channel", "interface", "bitrate"])
def test_what_stands_in_can_is_no_option(name: str) -> None:
    text = TEXT.replace('interface = "simulated"', 'interface = "gs_usb"')
    with pytest.raises(
        ConfigError, match=rf"can.options.{name}: not allowed here; set interface, channel, bitrates and fd in \[can\]"
    ):
        parse(f'{text}\n[can.options]\n{name} = "x"\n')


def test_options_of_the_bus_keep_their_types() -> None:
    text = TEXT.replace('interface = "simulated"', 'interface = "socketcand"')
    options = parse(f'{text}\n[can.options]\nhost = "a"\nport = 1\ntcp_tune = true\nwait = 0.5\n').can.options
    assert options == {"host": "a", "port": 1, "tcp_tune": True, "wait": 0.5}
    assert [type(value) for value in options.values()] == [str, int, bool, float]


def test_an_eds_lies_beside_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(TEXT.replace("[drives.B]\n", '[drives.B]\neds = "makes/b.eds"\n'))
    drives = load(path).drives
    assert [drive.eds for drive in drives.each] == [None, str(tmp_path / "makes/b.eds"), None]


# ---------------------------------------------------------------------- what loads, runs

NUMBER = re.compile(r"(?<== )-?[0-9][0-9.e+-]*$|(?<=[\[ ])-?[0-9][0-9.e+-]*(?=[,\]])", re.MULTILINE)
ODRIVES = TEXT.replace('protocol = "cia402"', 'protocol = "odrive"').replace(
    "counts_per_metre = 1e7", "counts_per_metre = 25.0"
)
WHOLE = [provenance.toml(parse(text)) for text in (TEXT, ODRIVES)]
"""Every key there is, defaults included, of each protocol."""


@st.composite
def texts(draw: st.DrawFn) -> str:
    """A whole configuration in which some numbers are others: at a bound, beyond any, or a little different."""
    text = draw(st.sampled_from(WHOLE))
    found = list(NUMBER.finditer(text))
    chosen = draw(st.lists(st.sampled_from(found), min_size=1, max_size=4, unique_by=lambda number: number.start()))
    for number in sorted(chosen, key=lambda number: -number.start()):
        old = float(number[0])
        if "." in number[0] or "e" in number[0]:
            scaled = st.floats(-12.0, 12.0).map(lambda power: 10.0**power).map((old or 1.0).__mul__)
            near = st.floats(0.1, 10.0).map(old.__mul__)
            extreme = st.sampled_from([0.0, -old, 5e-324, 1e-310, 1e-6, 1e3, 9e18, 1.7e308])
            new = repr(draw(near | scaled | extreme))
        else:
            new = str(draw(st.integers(0, 5000) | st.sampled_from([-1, int(old) + 1, 2**31, 2**63, 10**30])))
        text = text[: number.start()] + new + text[number.end() :]
    return text


@settings(max_examples=200)
@given(text=texts())
@example(text=WHOLE[0].replace("counts_per_metre = 10000000.0", "counts_per_metre = 100.0"))
@example(text=WHOLE[0].replace("feed_forward_gain = 0.95", "feed_forward_gain = 9e18"))
@example(text=WHOLE[0].replace("offset = 0.0", "offset = 99.0"))
@example(
    text=WHOLE[1].replace("offset = 0.0", "offset = 99.0").replace("following_error = 0.004", "following_error = 1e-5")
)
def test_a_configuration_that_loads_can_be_run(text: str) -> None:
    """No exception ends the loop: not at the start, nor when power comes, nor in motion, nor in a stop."""
    try:
        config = parse(text)
    except ConfigError as error:
        said = str(error)
    else:
        said = run_a_little(config)
    assert "\n" not in said
    assert len(said) <= MAX_MESSAGE_LENGTH


def run_a_little(config: Config) -> str:
    """Power up, begin to move and stop; return why the bus is too slow, or a drive cannot take it, where that is so."""
    try:
        rig = Rig(config)
    except (BusError, DriveError) as error:
        return str(error)
    rig.order("enable")
    rig.until(lambda: rig.mode is not Mode.ENABLING, 5000)
    rig.post("g-1", PoseGoal(x=0.01, y=-0.01, phi=0.05))
    rig.cycles(30)
    rig.order("stop")
    rig.cycles(30)
    rig.order("disable")
    rig.cycles(30)
    rig.bus.shutdown()
    return ""


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        (
            "counts_per_metre = 1e7",
            "counts_per_metre = 100",
            "drives.A.counts_per_metre = 100, offset = 0: a position step of 0.01 m is too coarse for "
            "limits.slider.following_error, 0.004 m; expected counts_per_metre of at least 2500",
        ),
        ("counts_per_metre = 1e7", "counts_per_metre = 1e12", "drives.A.counts_per_metre = 1e+12"),
        (
            "counts_per_metre = 1e7",
            'counts_per_metre = 1e7\nvelocity_unit = "0.001 counts/s"',
            'drives.A.velocity_unit = "0.001 counts/s": limits.slider.velocity = 1 is 1e+10 of it, more than half of',
        ),
        (
            "counts_per_metre = 1e7",
            'counts_per_metre = 1e7\nvelocity_unit = "1e9 counts/s"',
            'drives.A.velocity_unit = "1e9 counts/s": limits.slider.velocity = 1 is 0.01 of it, below',
        ),
        (
            "counts_per_metre = 1e7",
            'counts_per_metre = 1e7\nvelocity_unit = "1e400 counts/s"',
            'drives.A.velocity_unit = "1e400 counts/s" is not a unit of velocities; use a unit such as',
        ),
        (
            "feed_forward_gain = 0.95",
            "feed_forward_gain = 9e18",
            "can.simulated.feed_forward_gain = 9e+18: expected number, 0 to 2",
        ),
        ("rate_hz = 1000", "rate_hz = 2500", ""),
        ("rate_hz = 1000", "rate_hz = 16", "object 60C2h accepts 1 to 255 times a power of ten"),
        (
            "rate_hz = 1000",
            "rate_hz = 1",
            "drives.heartbeat = 0.1: heartbeats are sent with the cycle; expected at least",
        ),
        ("bitrate = 1_000_000", "bitrate = 1", "can.bitrate = 1: expected integer, 10000 to 8000000"),
        ("velocity = 1.0", "velocity = 5e-5", "too coarse for limits.slider.velocity"),
        (
            "sliders = [1e-4, 1e-4, 1e-4]",
            "sliders = [1e-4, 2e-7, 1e-4]",
            "limits.in_position.sliders[1] = 2e-07: narrower than 3 position steps of drive B, 1e-07 m each; "
            "expected at least 3e-07 m",
        ),
        ("sliders = [1e-4, 1e-4, 1e-4]", "sliders = [3.1e-7, 3.1e-7, 3.1e-7]", ""),
        (
            "pose = [1e-4, 1e-4, 1e-3]",
            "pose = [1e-7, 1e-4, 1e-3]",
            "limits.in_position.pose[0] = 1e-07: narrower than 3 position steps of drive",
        ),
        (
            "pose = [1e-4, 1e-4, 1e-3]",
            "pose = [1e-4, 1e-4, 1e-6]",
            "limits.in_position.pose[2] = 1e-06: narrower than 3 position steps of drive",
        ),
        (
            "pose = [1e-4, 1e-4, 1e-3]",
            "pose = [1e-4, 1e-4, 0.0]",
            "limits.in_position.pose[2] = 0.0: expected number, 1e-09 to 1",
        ),
        ("dwell = 0.02", "dwell = 2.0", "limits.in_position.timeout = 2: it must be longer than the dwell, 2 s"),
        ("dwell = 0.02", "dwell = 0.0", "limits.in_position.dwell = 0.0: expected number, 0.001 to 10"),
        ("timeout = 2.0", "timeout = 3600.0", "limits.in_position.timeout = 3600.0: expected number, 0.01 to 60"),
        ('directory = "recordings"', 'directory = "a\\u0000b"', "telemetry.directory"),
    ],
)
def test_numbers_no_machine_could_carry_out_are_refused(right: str, wrong: str, said: str) -> None:
    assert right in TEXT
    text = TEXT.replace(right, wrong, 1)
    if not said:
        assert parse(text)
        return
    with pytest.raises(ConfigError) as refused:
        parse(text)
    assert said in str(refused.value)


def test_without_windows_there_are_some() -> None:
    begin = TEXT.index("[limits.in_position]")
    without = TEXT[:begin] + TEXT[TEXT.index("[motion]", begin) :]
    assert parse(without) == parse(TEXT)


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=4)
    | st.sampled_from(["viewer", "cia402", "u8", 0, 1, 0.5, 3.0, -1, 5000, 2**32, "A", "605A", date(2026, 1, 31)]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("abAB- ", max_size=2), inner, max_size=3),
    max_leaves=6,
)
TYPES = {
    (table.__name__, field.name): field.type
    for table in (Config, Drive, Can, ObjectWrite, SliderLimits, GeometryTable, PlatformLimits, FramesTable, Zenoh)
    for field in fields(table)
}


@settings(max_examples=400)
@given(name=st.sampled_from(sorted(TYPES)), value=VALUES | st.lists(st.floats(-10.0, 10.0), min_size=2, max_size=3))
def test_what_is_explained_is_what_msgspec_refuses(name: tuple[str, str], value: object) -> None:
    """The words come from the types, and msgspec decides by the same types."""
    table = msgspec.defstruct("File", [("key", TYPES[name])])
    try:
        msgspec.convert({"key": value}, table)
    except msgspec.ValidationError:
        refused = True
    else:
        refused = False
    assert bool(wrong_values({"key": value}, table)) == refused


def bounds(kind: object, path: str = "") -> Iterator[tuple[str, Meta | None]]:
    """Every number's place in a configuration, and its bounds."""
    if isinstance(kind, type) and issubclass(kind, Struct):
        for field in fields(kind):
            yield from bounds(field.type, f"{path}.{field.name}".lstrip("."))
    elif get_origin(kind) is Annotated:
        inner, *metas = get_args(kind)
        yield from ((path, metas[0]) for _ in range(inner in (int, float)))
        yield from bounds(inner, path) if get_args(inner) else ()
    elif kind in (int, float):
        yield path, None
    else:
        for inner in get_args(kind):
            yield from bounds(inner, path)


def test_every_number_has_a_floor_and_a_ceiling() -> None:
    found = list(bounds(Config))
    assert len(found) > 60
    for path, meta in found:
        assert meta is not None, path
        assert meta.ge is not None, path
        assert meta.le is not None, path


def test_an_open_door_is_taken_where_it_is_written_out() -> None:
    config = parse(TEXT.replace(LISTEN, 'listen = ["tcp/0.0.0.0:7447"]\ninsecure = true'))
    assert config.zenoh.insecure


@pytest.mark.parametrize("address", ["0.0.0.0", "::", "192.0.2.7"])
def test_metrics_are_open_to_a_network_only_on_purpose(address: str) -> None:
    metrics = f'[telemetry]\nmetrics_port = 9464\nmetrics_address = "{address}"'
    with pytest.raises(ConfigError, match=r"anyone on its network could read the metrics"):
        parse(TEXT.replace("[telemetry]", metrics))
    insecure = TEXT.replace(LISTEN, f"{LISTEN}\ninsecure = true").replace("[telemetry]", metrics)
    assert metrics_url(parse(insecure)).startswith("http://")
    certified = TEXT.replace(LISTEN, 'listen = ["tls/0.0.0.0:7447"]\n[zenoh.tls]').replace("[telemetry]", metrics)
    assert metrics_url(parse(certified)).startswith("https://")


@pytest.mark.parametrize("address", ["localhost", "", "1.2.3", "127.0.0.1:80"])
def test_an_address_of_the_metrics_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match=r"telemetry\.metrics_address"):
        parse(TEXT.replace("[telemetry]", f'[telemetry]\nmetrics_address = "{address}"'))


def test_metrics_of_this_machine_alone_need_no_certificate() -> None:
    for address in ("127.0.0.1", "::1"):
        given = parse(TEXT.replace("[telemetry]", f'[telemetry]\nmetrics_port = 9464\nmetrics_address = "{address}"'))
        assert metrics_url(given).startswith("http://")
    assert metrics_url(parse(TEXT)) == ""


def test_certificates_are_looked_for_beside_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(TEXT.replace(LISTEN, f'{TLS}\n[zenoh.users]\nann = "operator"'))
    zenoh = load(tmp_path / "robot.toml").zenoh
    assert zenoh.tls is not None
    assert zenoh.tls.directory == str(tmp_path / "keys")
    assert zenoh.users == {"ann": "operator"}


@given(
    low=st.floats(-3.0, 3.0),
    high=st.floats(-3.0, 3.0),
    margin=st.floats(0.001, 0.4),
    reach=st.floats(0.01, 0.15),
    edges=st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
def test_what_is_said_of_a_singular_angle_is_accepted(
    low: float, high: float, margin: float, reach: float, edges: tuple[float, float, float]
) -> None:
    """Of robots as built too, whose singular angles move with the centre: it is the least over all corners."""
    symmetric = geometry(load(SIM).geometry)
    a, b, c = (
        LegTable(leg.anchor, leg.rail_angle, leg.home, leg.edge_point, leg.edge_angle + by)
        for leg, by in zip(symmetric.legs, edges, strict=True)
    )
    config = load(SIM)
    platform = msgspec.structs.replace(config.limits.platform, x=(-reach, reach), y=(-reach, reach), phi=(low, high))
    limits = msgspec.structs.replace(config.limits, platform=platform, singularity_margin=margin)
    table = msgspec.structs.replace(config.geometry, l0=None, leg=(a, b, c))
    config = msgspec.structs.replace(config, limits=limits, geometry=table, poses={})
    try:
        check(config)
    except ConfigError as error:
        said = str(error)
    else:
        return
    found = re.search(r"singular angle .*; keep it within \[(.*), (.*)\]", said)
    assume(found is not None)
    assert found is not None
    phi = float(found[1]), float(found[2])
    assume(phi[0] < phi[1])
    platform = msgspec.structs.replace(platform, phi=phi)
    limits = msgspec.structs.replace(limits, platform=platform)
    try:
        check(msgspec.structs.replace(config, limits=limits))
    except ConfigError as error:
        said = str(error)
    else:
        said = ""
    assert "singular angle" not in said


@pytest.mark.parametrize("name", ["sim.toml", "uvw.toml", "uvw-ppr.toml", "xxy.toml"])
@example(low=2.6, span=1.4, margin=0.1)
@given(low=st.floats(-6.2, 6.2), span=st.floats(0.01, 4.0), margin=st.floats(0.01, 0.4))
def test_the_pose_is_computed_right_from_the_sliders_wherever_a_platform_may_turn(
    name: str, low: float, span: float, margin: float
) -> None:
    config = load(SIM.with_name(name))
    phi = low, min(low + span, 6.28)
    platform = msgspec.structs.replace(config.limits.platform, phi=phi)
    limits = msgspec.structs.replace(config.limits, platform=platform, singularity_margin=margin)
    try:
        check(msgspec.structs.replace(config, limits=limits, poses={}))
    except ConfigError as error:
        if "singular angle" in str(error):
            return
    robot = geometry(config.geometry)
    poses = np.zeros((20, 3))
    poses[:, 2] = np.linspace(*phi, len(poses))
    assert forward(robot, inverse(robot, poses).position) == pytest.approx(poses, abs=1e-7)


ROTATIONS = st.tuples(*[st.floats(-0.9, 0.9)] * 3)


@example(edges=(-0.012, 0.831, -0.014), rails=(0.011, -0.032, 0.016), reach=0.01, phi=0.0873)
@given(
    edges=ROTATIONS,
    rails=st.tuples(*[st.floats(-0.06, 0.06)] * 3),
    reach=st.floats(0.005, 0.04),
    phi=st.floats(0.01, 0.3),
)
def test_no_permitted_pose_is_on_the_other_side_of_a_singular_pose(
    edges: Triple, rails: Triple, reach: float, phi: float
) -> None:
    config = load(SIM.with_name("uvw.toml"))
    legs = tuple(
        LegTable(leg.anchor, leg.rail_angle + rail, leg.home, leg.edge_point, leg.edge_angle + edge)
        for leg, rail, edge in zip(geometry(config.geometry).legs, rails, edges, strict=True)
    )
    ends = (-reach, reach)
    platform = msgspec.structs.replace(config.limits.platform, x=ends, y=ends, phi=(-phi, phi))
    limits = msgspec.structs.replace(config.limits, platform=platform, singularity_margin=0.05)
    table = msgspec.structs.replace(config.geometry, leg=legs)
    config = msgspec.structs.replace(config, geometry=table, limits=limits)
    try:
        robot = geometry(config.geometry)
    except ConfigError:
        reject()
    try:
        check(config)
        said = ""
    except ConfigError as error:
        said = str(error)
    samples = [np.linspace(*ends, 5), np.linspace(*ends, 5), np.linspace(-phi, phi, 9)]
    poses = np.stack(np.meshgrid(*samples), axis=-1).reshape(-1, 3)
    try:
        regular = bool((distance_to_singularity(robot, poses) > 0.0).all())
    except KinematicsError:
        regular = False
    assert regular or "singular" in said
    if "a singular pose" in said:
        assert not regular


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "sim.toml",
            "position = [-0.17,",
            "position = [0.3,",
            "slider . is outside limits.slider.position .* by 0.3 m",
        ),
        ("sim.toml", "passive = [-0.17,", "passive = [0.3,", "cross slide . is outside limits.slider.passive"),
        ("sim.toml", "x = [-0.15, 0.15]", "x = [2.0, 2.9]", "2, y = 0, phi = 0, slider . is outside"),
        (
            "uvw.toml",
            "edge_point = [-0.0575, 0.0575]",
            "edge_point = [0.0575, 0.0575]",
            r"cross slide W is outside limits.slider.passive = \[-0.018, 0.018\] by 0.097 m; correct \[geometry\]",
        ),
    ],
)
def test_limits_without_any_pose_are_refused(name: str, old: str, new: str, message: str) -> None:
    text = SIM.with_name(name).read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(ConfigError, match=f"^limits: no pose is within all of them; at x = .*{message}"):
        parse(text.replace(old, new))


SHARES = st.tuples(st.floats(-1.0, 1.0), st.floats(0.01, 2.0))
"""Middle and width of a range, in multiples of the configured width."""


@pytest.mark.parametrize("name", ["sim.toml", "uvw.toml", "uvw-ppr.toml", "xxy.toml"])
@example(position=(0.1, 0.3), passive=(-0.08, 0.3), x=(0.0, 1.0), y=(0.0, 1.0), phi=(0.0, 1.0))
@given(position=SHARES, passive=SHARES, x=SHARES, y=SHARES, phi=SHARES)
def test_limits_are_refused_exactly_if_no_pose_is_within_them(
    name: str,
    position: tuple[float, float],
    passive: tuple[float, float],
    x: tuple[float, float],
    y: tuple[float, float],
    phi: tuple[float, float],
) -> None:
    config = load(SIM.with_name(name))
    slider, platform = config.limits.slider, config.limits.platform

    def limited(extra: float) -> Config:
        """Return the configuration with travels of the joints that are longer by a share `extra` at each end."""

        def moved(ends: tuple[float, float], share: tuple[float, float], more: float) -> tuple[float, float]:
            low, high = ends
            middle, half = (low + high) / 2.0 + share[0] * (high - low), (share[1] / 2.0 + more) * (high - low)
            return middle - half, middle + half

        sliders = msgspec.structs.replace(
            slider,
            position=tuple(moved(ends, position, extra) for ends in slider.positions),
            passive=moved(slider.passive, passive, extra),
        )
        window = msgspec.structs.replace(
            platform,
            x=moved(platform.x, x, 0.0),
            y=moved(platform.y, y, 0.0),
            phi=moved(platform.phi, (phi[0] / 3.0, phi[1] / 2.0), 0.0),
        )
        limits = msgspec.structs.replace(config.limits, slider=sliders, platform=window)
        return msgspec.structs.replace(config, limits=limits, poses={})

    tried = limited(0.0)
    said = ""
    try:
        check(tried)
    except ConfigError as error:
        said = str(error)
    assume("phi" not in said or "no pose" in said)

    def anything(config: Config) -> bool:
        robot, limits = geometry(config.geometry), config.limits
        return any(len(permitted_slice(robot, limits, turn)) for turn in np.linspace(*limits.platform.phi, 257))

    if "no pose" in said:
        assert not anything(tried)
    else:
        assert anything(limited(0.02))


def test_the_tolerance_of_poses_is_that_of_plans() -> None:
    assert impossible.ROUNDING == paths.ROUNDING


PLAYS = st.just((0.0, 0.0, 0.0)) | st.tuples(*[st.floats(0.0, 5e-5)] * 3)
BEYOND = st.sampled_from((0.0, 0.5e-9, -0.5e-9)) | st.floats(2e-9, 3e-5) | st.floats(-3e-5, -2e-9)


@pytest.mark.parametrize("name", ["sim.toml", "uvw.toml", "uvw-ppr.toml", "xxy.toml"])
@example(axis=0, end=1, beyond=0.0, phi=0.0, backlash=(0.0, 0.0, 0.0))
@example(axis=0, end=0, beyond=0.0, phi=0.0, backlash=(0.0, 0.0, 0.0))
@example(axis=1, end=1, beyond=-5e-6, phi=0.0, backlash=(2e-5, 0.0, 0.0))
@given(
    axis=st.integers(0, 2),
    end=st.integers(0, 1),
    beyond=BEYOND,
    phi=st.just(0.0) | st.floats(-0.05, 0.05),
    backlash=PLAYS,
)
def test_named_poses_are_accepted_where_plans_may_end(
    name: str, axis: int, end: int, beyond: float, phi: float, backlash: Triple
) -> None:
    """Slider `axis` is at an end of its travel, plus `beyond` [m], and another slider is at zero."""
    config = load(SIM.with_name(name))
    robot, limits = geometry(config.geometry), config.limits
    sliders = inverse(robot, (0.0, 0.0, phi)).position
    sliders[axis] = limits.slider.positions[axis][end] + beyond
    try:
        pose = forward(robot, sliders)
        motion = inverse(robot, pose)
    except KinematicsError:
        reject()
    bounds = Bounds(planned_limits(limits, backlash), config.period)
    rows = [motion.position, np.zeros(3), np.zeros(3), motion.passive_position]
    of_joints = bounds.setpoint_violation(rows)
    correction = msgspec.structs.replace(config.correction, backlash=backlash)
    named = msgspec.structs.replace(config, correction=correction, poses={"load": tuple(pose.tolist())})
    try:
        check(named)
        refused = False
    except ConfigError as error:
        refused = "poses.load" in str(error)
    assert refused is (bounds.pose_violation(pose) is not None or of_joints is not None)
    if not any(backlash) and distance_to_singularity(robot, pose) > limits.singularity_margin:
        assert bool(violations(robot, limits, pose)) is (of_joints is not None)


def test_backlash_leaves_travel_and_a_pose_in_its_reserve_is_refused_with_the_reason() -> None:
    text = SIM.with_name("uvw-ppr.toml").read_text(encoding="utf-8")
    narrow = text.replace("position = [-0.01, 0.01]", "position = [-0.0004, 0.0004]")
    assert parse(f"{narrow}\n[correction]\nbacklash = [7e-4, 0.0, 0.0]\n")
    with pytest.raises(ConfigError, match=r"correction.backlash = \[0.001, 0.0, 0.0\]: 0.001 m leaves no travel"):
        parse(f"{narrow}\n[correction]\nbacklash = [1e-3, 0.0, 0.0]\n")
    play = f"{text}\n[correction]\nbacklash = [2e-5, 0.0, 0.0]\n[poses]\n"
    assert parse(f"{play}load = [0.00999, 0.0, 0.0]\n")
    with pytest.raises(ConfigError, match=r"slider U would be 0.009995, closer than 1e-05 m .*half of the widest"):
        parse(f"{play}load = [0.009995, 0.0, 0.0]\n")


def test_a_recording_of_an_earlier_version_is_read_although_its_configuration_would_be_refused_now() -> None:
    text = f"{TEXT}\n[poses]\nfar = [9.0, 0.0, 0.0]\n"
    with pytest.raises(ConfigError, match=r"poses\.far"):
        parse(text)
    recorded = provenance.configuration({provenance.CONFIGURATION: text})
    assert recorded is not None
    assert recorded.poses["far"] == (9.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('directory = "recordings"', 'directory = "~/x"'),
        (LISTEN, f'{TLS}\ndirectory = "~/x"'),
        ("[telemetry]", '[correction]\nmap = "~/x"\n[telemetry]'),
        ("[drives.A]", '[drives.A]\neds = "~/x"'),
        ("[drives.A]", '[drives.A]\nendpoints = "~/x"'),
    ],
)
def test_a_path_may_begin_with_the_home_folder(
    before: str, after: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the service would make a folder whose name is ~."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert before in TEXT
    (tmp_path / "robot.toml").write_text(TEXT.replace(before, after, 1))
    found = str(everything(tmp_path / "robot.toml"))
    assert f"{tmp_path}/home/x" in found
    assert f"{tmp_path}/~" not in found
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    with pytest.raises(ConfigError, match="~/x: the home folder is unknown: set HOME, or write the path without ~"):
        load(tmp_path / "robot.toml")


@pytest.mark.parametrize("key", ["telemetry.directory", "correction.map", "drives.B.eds", "zenoh.tls.directory"])
def test_a_home_folder_that_is_unknown_hides_no_other_mistake(key: str, tmp_path: Path) -> None:
    table, name = key.rsplit(".", 1)
    path = f'{name} = "~nobody_here/x"'
    text = TEXT.replace("rate_hz = 1000", "rate_hz = 7")
    if f"[{table}]" in text:
        text = text.replace('directory = "recordings"', "") if table == "telemetry" else text
        text = text.replace(f"[{table}]", f"[{table}]\n{path}", 1)
    else:
        text += f"\n[{table}]\n{path}\n"
    (tmp_path / "robot.toml").write_text(text)
    found = {each.key: each.text for each in everything(tmp_path / "robot.toml").mistakes}
    assert {key, "loop.rate_hz"} <= set(found)
    assert found[key].startswith(f"{key}: ~nobody_here/x: the home folder is unknown")
    with pytest.raises(ConfigError, match=re.escape(f"{key}: ~nobody_here/x")):
        load(tmp_path / "robot.toml")


_ODD_NUMBERS = st.sampled_from(
    (
        f"1{'0' * 400}",
        f"-1{'0' * 400}",
        f"0x{'f' * 5000}",
        "9" * 5000,
        str(2**63),
        "1e400",
        "nan",
        "07:32:00",
        "[]",
        "{}",
        '"map.toml"',
        "true",
    )
)
_ODD_KEYS = st.sampled_from(('"a\\nb"', '"\\u001b[31mred"', '"\\u202e"', '""', f'"{"x" * 10_000}"'))
_DEPTHS = st.sampled_from((100, 300, 450, 600, 900, 2000))
_KEYS_OF_SIM = sorted({(key, part) for key, _, part in (line.partition(" = ") for line in TEXT.splitlines()) if part})


@st.composite
def odd_files(draw: st.DrawFn) -> str:
    """Draw a file that is TOML, or nearly, but that nobody would write on purpose."""
    key, part = draw(st.sampled_from(_KEYS_OF_SIM))
    value = draw(_ODD_NUMBERS)
    kind = draw(st.integers(0, 5))
    depth = draw(_DEPTHS)
    if kind == 0:
        return TEXT.replace(f"{key} = {part}", f"{key} = {value}", 1)
    if kind == 1:
        return TEXT.replace(f"{key} = {part}", f"{key} = [{value}, {value}]", 1)
    if kind == 2:
        return TEXT + draw(
            st.sampled_from((f"\n[{'.'.join('a' * depth)}]\n", f"\n[can.options]\n{'.'.join('a' * depth)} = 1\n"))
        )
    if kind == 3:
        return TEXT.replace(f"{key} = {part}", f"{key} = {'[' * depth}{']' * depth}", 1)
    if kind == 4:
        table = draw(st.sampled_from(("", "[can.options]", "[poses]", "[zenoh.users]", "[frames.work]")))
        return f"{TEXT}\n{table}\n{draw(_ODD_KEYS)} = {value}\n" if table else f"{draw(_ODD_KEYS)} = {value}\n{TEXT}"
    name, example = draw(st.sampled_from(_SECTIONS))
    return f"{TEXT}\n[{name}]\n{example} = {value}\n"


_SECTIONS = (
    ("correction", "as_built"),
    ("correction.as_built", "made"),
    ("correction.as_built", "nodes"),
    ("correction", "map"),
    ("drives.A.homing", "method"),
    ("outputs.valve", "bit"),
    ("frames.tools", "pin"),
    ("can.options", "x"),
    ("poses", "pick"),
)


@settings(max_examples=300)
@example(f'{TEXT}\n[correction]\nas_built = "map.toml"\n')
@example(f"{TEXT}\n[{'.'.join('a' * 600)}]\n")
@example(TEXT.replace("x = [-0.15, 0.15]", f"x = [-0.15, 1{'0' * 400}]"))
@example(TEXT.replace("rate_hz = 1000", f"rate_hz = 0x{'f' * 5000}"))
@example(f'{TEXT}\n"a\\nb" = 1\n')
@given(odd_files())
def test_odd_files_are_refused_in_one_line_or_accepted(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.toml"
        path.write_text(text)
        refused = ""
        try:
            load(path)
        except ConfigError as error:
            refused = str(error)
        try:
            said = [each.text for each in everything(path).mistakes]
        except ConfigError as error:
            said = [str(error)]
    assert bool(refused) == bool(said)
    assert all(printable(words) == words for words in (refused, *said))


def test_a_bound_that_is_stated_is_accepted() -> None:
    """2 pi, rounded to six digits, is above 2 pi."""
    with pytest.raises(ConfigError, match="expected number") as refused:
        parse(SIM.with_name("uvw.toml").read_text().replace("rail_angle = 0.0", "rail_angle = 6.3", 1))
    bounds = re.search(r"expected number, (\S+) to ([^\s;]+)", str(refused.value))
    assert bounds is not None
    for bound in bounds.groups():
        parse_values(SIM.with_name("uvw.toml").read_text().replace("rail_angle = 0.0", f"rail_angle = {bound}", 1))


@pytest.mark.parametrize(
    ("name", "hint"), [("socketcna", 'did you mean "socketcan"? Use one of '), ("ethernet", "unknown; use one of ")]
)
def test_an_interface_that_does_not_exist_is_refused_with_those_that_do(name: str, hint: str) -> None:
    text = TEXT.replace('interface = "simulated"', f'interface = "{name}"')
    with pytest.raises(ConfigError, match=re.escape(f'can.interface "{name}" is unknown')) as refused:
        parse(text)
    assert hint in str(refused.value)


def test_a_map_that_is_written_at_the_wrong_key_is_one_mistake(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(f'{TEXT}\n[correction]\nas_built = "map.toml"\n')
    found = everything(tmp_path / "robot.toml").mistakes
    assert [each.text for each in found] == ["correction.as_built = 'map.toml': expected table"]
