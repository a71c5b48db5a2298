"""Configuration files: what is right is taken, what is wrong is refused with key, value and remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from service.config import SIM, load, parse
from service.errors import ConfigError

TEXT = SIM.read_text()
CONFIGS = sorted(SIM.parent.glob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_configurations_load(path: Path) -> None:
    assert load(path).robot.name


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("rate_hz = 1000", "rate_hz = 'fast'", "loop.rate_hz = 'fast': expected int, got str"),
        ("rate_hz = 1000", "rate_hx = 1000", "loop.rate_hx: unknown key; did you mean rate_hz?"),
        ("rate_hz = 1000", "rate_hz = 5000", "loop.rate_hz = 5000: expected int <= 4000"),
        (
            "rate_hz = 1000",
            "rate_hz = 999",
            "loop.rate_hz = 999: a cycle must be a whole number of microseconds",
        ),
        ("rate_hz = 1000", "", "loop.rate_hz: missing key"),
        ("[watchdogs]", "[watchdog]", "watchdog: unknown section; did you mean watchdogs?"),
        ("[zenoh]", "[drives.zenoh]", "drives.zenoh: unknown key; allowed are protocol"),
        ("[loop]", "[loop", "not TOML"),
        ("node = 3", "nod = 3", "drives.C.nod: unknown key; did you mean node?"),
        ("node = 2", "node = 1", "the node ids of master_node, A, B and C must differ, but are 126, 1, 1, 3"),
        ("node = 2", "node = 128", "drives.B.node = 128: expected int <= 127"),
        (
            'protocol = "cia402"',
            'protocol = "ethercat"',
            "drives.protocol = 'ethercat': allowed are 'cia402', 'odrive'",
        ),
        (
            'protocol = "cia402"',
            'protocol = "odrive"',
            "with drives.A.counts_per_metre = 1e+07 that is 1e+07 turns/s, and an ODrive's feed-forward ends at 32.767",
        ),
        ('realtime = "prefer"', 'realtime = "yes"', "allowed are 'off', 'prefer', 'enforce'"),
        ("gateway_timeout = 0.3", "gateway_timeout = 0.1", "watchdogs.gateway_timeout = 0.1: expected float >= 0.2"),
        ("live_mb = 64", "live_mb = 0", "telemetry.live_mb = 0: expected float >= 1.0"),
        ("l0 = 0.3", "l0 = nan", "geometry.l0 = nan: it must be a finite number"),
        ("l0 = 0.3", "l0 = -0.3", "geometry.l0 = -0.3: expected float > 0.0"),
        ("l0 = 0.3", "", "give either l0 (the symmetric robot) or three [[geometry.leg]] tables"),
        (
            "following_error = 0.004",
            "following_error = true",
            "limits.slider.following_error = True: expected float",
        ),
        (
            "x = [-0.15, 0.15]",
            "x = [0.1, -0.1]",
            "limits.platform.x = [0.1, -0.1]: the lower limit must be below",
        ),
        ("x = [-0.15, 0.15]", "x = [0.1]", "limits.platform.x = [0.1]: expected array of length 2"),
        ("phi = [-1.2, 0.85]", "phi = [-1.2, 1.0]", "singular angle 1.0472: keep below 0.8972"),
        ("phi = [-1.2, 0.85]", "phi = [-2.1, 0.8]", "singular angle -2.0944: keep above -1.9444"),
        ("jerk = [40.0, 40.0, 240.0]", "jerk = [40.0, 0.0, 240.0]", "jerk[1] = 0.0: expected float > 0.0"),
    ],
)
def test_wrong_ones_are_refused_in_one_line(right: str, wrong: str, said: str) -> None:
    assert right in TEXT
    with pytest.raises(ConfigError) as refused:
        parse(TEXT.replace(right, wrong, 1))
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


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
        (0, 0.005, "drives.B.homing = {'method': 0"),
        (300, 0.005, "drives.B.homing.method = 300: expected int <= 127"),
        (19, 0.0, "drives.B.homing.speed_zero = 0.0: expected float > 0.0"),
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


def test_an_eds_lies_beside_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(TEXT.replace("[drives.B]\n", '[drives.B]\neds = "makes/b.eds"\n'))
    drives = load(path).drives
    assert [drive.eds for drive in drives.each] == [None, str(tmp_path / "makes/b.eds"), None]
