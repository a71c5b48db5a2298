"""Limits in millimetres or degrees are refused, or warned of, with what was meant."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from trirail.config import SIM, everything, load
from trirail.diagnosis.configured import diagnose
from trirail.errors import ConfigError

NAMES = "sim", "uvw", "xxy", "uvw-ppr", "socketcan"
MM, DEGREE = 1e-3, math.pi / 180.0


def changed(folder: Path, name: str, key: str, text: str) -> Path:
    """A shipped file with another value of a key, at its first place."""
    lines = SIM.with_name(f"{name}.toml").read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if line.startswith(f"{key} = "))
    lines[at] = f"{key} = {text}"
    path = folder / "own.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("key", "of"), [("x", "platform"), ("y", "platform"), ("position", "slider"), ("passive", "slider")]
)
def test_ranges_in_millimetres_are_refused_with_metres(tmp_path: Path, name: str, key: str, of: str) -> None:
    given = getattr(getattr(load(SIM.with_name(f"{name}.toml")).limits, of), key)
    low, high = (value / MM for value in given)
    path = changed(tmp_path, name, key, f"[{low}, {high}]")
    with pytest.raises(ConfigError, match=rf"limits\.{of}\.{key}.* did you mean ") as refused:
        load(path)
    assert f"{given[0]:g}" in str(refused.value)


@pytest.mark.parametrize("ends", [(-40.0, 40.0), (-40.0, 0.5), (-5.0, 40.0)])
@pytest.mark.parametrize("name", NAMES)
def test_angles_in_degrees_are_refused_with_radians(tmp_path: Path, name: str, ends: tuple[float, float]) -> None:
    found = everything(changed(tmp_path, name, "phi", str(list(ends))))
    wrong = [end for end in ends if abs(end) > math.tau]
    said = [mistake.text for mistake in found.mistakes if mistake.key.startswith("limits.platform.phi")]
    assert f"did you mean {wrong[0] * DEGREE:.4g}? Angles are in radians" in said[0]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("axis", range(3))
def test_rates_in_millimetres_or_degrees_are_warned_of_with_si_units(tmp_path: Path, name: str, axis: int) -> None:
    rates = list(load(SIM.with_name(f"{name}.toml")).limits.platform.velocity)
    si = rates[axis]
    rates[axis] = round(si / (DEGREE if axis == 2 else MM), 2)
    found = everything(changed(tmp_path, name, "velocity", str(rates)))
    if found.mistakes:  # beyond what any robot does
        assert found.mistakes[0].key == f"limits.platform.velocity[{axis}]"
        return
    warned = {check.key: check for check in diagnose(found.config) if check.verdict == "warning"}
    unit = "rad/s" if axis == 2 else "m/s"
    assert warned[f"limits.platform.velocity[{axis}]"].remedy == f"did you mean {si:.3g} {unit}?"


def test_a_stage_does_not_turn_at_8_6_rad_a_second(tmp_path: Path) -> None:
    found = everything(changed(tmp_path, "uvw", "velocity", "[0.02, 0.02, 8.6]"))
    assert found.mistakes == []
    assert "limits.platform.velocity[2]" in {check.key for check in diagnose(found.config)}


@pytest.mark.parametrize("directory", ["recordings", "deep/er", "/var/tmp/elsewhere"])
def test_recordings_lie_relative_to_the_file_but_for_shipped_ones(tmp_path: Path, directory: str) -> None:
    path = changed(tmp_path, "sim", "directory", f'"{directory}"')
    assert load(path).telemetry.directory == str(tmp_path / directory)
    assert load(SIM).telemetry.directory == "recordings"
