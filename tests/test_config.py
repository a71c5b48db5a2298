"""Configuration files: what is right is taken, what is wrong is refused with key, value and remedy."""

from __future__ import annotations

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
