"""`trirail config`, called as from a terminal."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from commissioning.test_config_edit import disk_room
from trirail.cli.app import app
from trirail.config import SIM, load, parse
from trirail.errors import ConfigError
from trirail.kinematics.geometry import Geometry

SHIPPED = sorted(SIM.parent.rglob("*.toml"))


def as_built() -> str:
    """Return the symmetric robot's legs as [[geometry.leg]] tables."""
    legs = (asdict(leg) for leg in Geometry.symmetric(0.3).legs)
    return "".join(
        "\n[[geometry.leg]]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in leg.items()) for leg in legs
    )


def call(line: str) -> object:
    return app(line, exit_on_error=False, print_error=False, result_action="return_value")


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Any:
    def run(line: str) -> Any:
        assert call(f"{line} --json") == 0
        return json.loads(capsys.readouterr().out)

    return run


@pytest.fixture
def changed(tmp_path: Path) -> Path:
    """A robot as built, with homing, that is otherwise the simulated one."""
    text = SIM.read_text(encoding="utf-8")
    text = text.replace("l0 = 0.3", "").replace('name = "demo"', 'name = "mine"')
    text = text.replace("[drives.B]", '[drives.A.homing]\nmethod = 19\nspeed_switch = 0.02\nspeed_zero = 0.005\n'
                        'acceleration = 0.5\n\n[drives.B]\neds = "ours \\\\ \\"µ\\".eds"')  # fmt: skip
    path = tmp_path / "mine.toml"
    path.write_text(text + as_built(), encoding="utf-8")
    return path


def test_what_is_shipped_is_listed_with_a_line_each(capsys: pytest.CaptureFixture[str], answer: Any) -> None:
    files = answer("config")["files"]
    assert {str(path.relative_to(SIM.parent)) for path in SHIPPED} | {
        "trirail.service",
        "trirail-can@.service",
        "trirail-user.conf",
        "trirail.nft",
        "prometheus.yml",
        "grafana.json",
    } == set(files)
    assert "drives/elmo_gold.toml" in files
    assert all(len(purpose) > 20 for purpose in files.values())
    assert call("config") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == list(files)


def test_each_can_be_copied_to_a_file_or_into_a_folder_but_never_over_one(tmp_path: Path, answer: Any) -> None:
    for name in answer("config")["files"]:
        answer(f"config copy {name} {tmp_path}")
        assert (tmp_path / Path(name).name).read_bytes() == (SIM.parent / name).read_bytes()
    assert answer(f"config copy sim {tmp_path / 'mine.toml'}")["file"] == str(tmp_path / "mine.toml")
    (tmp_path / "mine.toml").write_text("precious")
    with pytest.raises(ConfigError, match=r"mine\.toml already exists: choose another file"):
        call(f"config copy sim {tmp_path / 'mine.toml'}")
    assert (tmp_path / "mine.toml").read_text() == "precious"


@pytest.mark.parametrize("room", [0, 1000])
def test_a_full_disk_leaves_no_part_of_a_copy(room: int, tmp_path: Path) -> None:
    with disk_room(room), pytest.raises(ConfigError, match=r"sim\.toml: File too large"):
        call(f"config copy sim {tmp_path}")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_copied_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no configuration 'robot' is shipped: use one of .*sim\.toml, "):
        call(f"config copy robot {tmp_path}")
    with pytest.raises(ConfigError, match="No such file or directory"):
        call(f"config copy sim {tmp_path}/nowhere/my.toml")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_what_is_shown_is_the_same_configuration_again(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(f"config show {path}") == 0
    assert parse(capsys.readouterr().out) == load(path)


def test_legs_homing_and_odd_names_are_shown_too(changed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(f"config show '{changed}'") == 0
    shown = capsys.readouterr().out
    assert parse(shown) == load(changed)
    assert "# no l0; sim.toml: 0.3" in shown


def test_differences_from_the_shipped_simulated_robot_stand_beside_the_keys(
    changed: Path, capsys: pytest.CaptureFixture[str], answer: Any
) -> None:
    call("config show")
    assert "sim.toml" not in capsys.readouterr().out
    assert answer("config show")["differences"] == {}

    call(f"config show '{changed}'")
    lines = capsys.readouterr().out.splitlines()
    assert 'name = "mine"  # sim.toml: "demo"' in lines
    assert "rate_hz = 1000" in lines
    different = answer(f"config show '{changed}'")["differences"]
    assert different["robot.name"] == {"value": "mine", "sim.toml": "demo"}
    assert different["drives.A.homing.method"] == {"value": 19, "sim.toml": None}
    assert different["geometry.l0"] == {"value": None, "sim.toml": 0.3}
    assert set(different) >= {"drives.B.eds", "geometry.leg"}
    assert not any(key.startswith(("loop", "limits", "drives.C")) for key in different)
