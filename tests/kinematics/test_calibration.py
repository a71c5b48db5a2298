"""Calibration: what is recovered, how well and how surely, what stays open and is named, and every error."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import calibrate
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from trirail import config
from trirail.kinematics import calibration
from trirail.kinematics.calibration import CalibrationError, Open, corrected, identify, pose_derivatives
from trirail.kinematics.geometry import LEGS, Geometry, Leg
from trirail.kinematics.robot import forward, inverse

Array = NDArray[np.float64]

START = Geometry.symmetric(0.3)
SPAN = (0.1, 0.1, 0.6)
NOISE = np.array([20e-6, 20e-6, 1e-4])
DOUBT = np.array(Leg.DOUBT)
ANCHOR, RAIL_ANGLE, HOME, EDGE_POINT, EDGE_ANGLE = Leg.PARAMETERS
SIM = config.SIM.read_text(encoding="utf-8")


def as_built(random: np.random.Generator) -> Geometry:
    """Return a robot off by millimetres and tenths of a degree, in all seven numbers of each leg."""
    legs = []
    for leg in START.legs:
        length, angle = 2e-3 * random.standard_normal(5), math.radians(0.2) * random.standard_normal(2)
        legs.append(
            Leg(
                anchor=(leg.anchor[0] + length[0], leg.anchor[1] + length[1]),
                rail_angle=leg.rail_angle + angle[0],
                home=leg.home + length[2],
                edge_point=(leg.edge_point[0] + length[3], leg.edge_point[1] + length[4]),
                edge_angle=leg.edge_angle + angle[1],
            )
        )
    return Geometry(legs=(legs[0], legs[1], legs[2]))


def poses(random: np.random.Generator, n: int, span: tuple[float, float, float] = SPAN) -> Array:
    return random.uniform(-1.0, 1.0, (n, 3)) * span


def noisy(random: np.random.Generator, exact: Array) -> Array:
    return exact + NOISE * random.standard_normal(exact.shape)


def told(geometry: Geometry) -> Array:
    """Return what poses can tell of each leg, (3, 6): pin at slider zero, both directions, where the edge is."""
    return np.array(
        [
            [
                leg.anchor[0] + leg.home * math.cos(leg.rail_angle),
                leg.anchor[1] + leg.home * math.sin(leg.rail_angle),
                leg.rail_angle,
                leg.edge_angle,
                leg.edge_point[0] * math.sin(leg.edge_angle) - leg.edge_point[1] * math.cos(leg.edge_angle),
            ]
            for leg in geometry.legs
        ]
    )


# ---- what is recovered


@pytest.mark.generated(*range(5))
def test_exact_data_gives_the_exact_robot(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot, seen = as_built(random), poses(random, 60)
    found = identify(START, seen, inverse(robot, seen).position)
    assert_allclose(told(found.geometry), told(robot), rtol=0.0, atol=1e-9)
    assert np.max(np.abs(found.residuals)) < 1e-12
    assert found.open == ()


@pytest.mark.generated(*range(5))
def test_noisy_data_gives_poses_better_than_it_has(seed: int) -> None:
    random = np.random.default_rng(seed)
    robot, seen, unseen = as_built(random), poses(random, 60), poses(random, 200)
    found = identify(START, noisy(random, seen), inverse(robot, seen).position)
    error = (forward(found.geometry, inverse(robot, unseen).position, near=unseen) - unseen) / NOISE
    before = (forward(START, inverse(robot, unseen).position, near=unseen) - unseen) / NOISE
    assert np.max(np.sqrt(np.mean(error**2, axis=0))) < 1.0
    assert np.quantile(np.abs(error), 0.99) < 2.0  # alone near the singularity of J2 are some less certain
    assert np.median(np.abs(before)) > 20.0
    assert 0.8 < found.misfit < 1.2


@pytest.mark.long
def test_standard_errors_are_those_of_many_trials() -> None:
    random = np.random.default_rng(1)
    true = DOUBT * 0.2 * random.standard_normal((3, 5))
    seen = poses(random, 30)
    sliders = inverse(corrected(START, true), seen).position
    trials = [identify(START, noisy(random, seen), sliders) for _ in range(100)]
    score = np.array([(found.corrections - true) / found.standard_errors for found in trials])
    assert_allclose(np.mean(score, axis=0), 0.0, atol=0.5)
    assert_allclose(np.std(score, axis=0), 1.0, atol=0.35)
    assert np.mean([found.misfit**2 for found in trials]) == pytest.approx(1.0, abs=0.1)


def test_standard_errors_are_those_of_many_trials_also_if_the_stated_noise_is_too_low() -> None:
    random = np.random.default_rng(1)
    true = DOUBT * 0.2 * random.standard_normal((3, 5))
    seen = poses(random, 30)
    sliders = inverse(corrected(START, true), seen).position
    trials = [identify(START, seen + 2.5 * (noisy(random, seen) - seen), sliders) for _ in range(60)]
    errors = np.array([found.corrections - true for found in trials])
    said = np.array([found.standard_errors for found in trials])
    assert np.mean((errors / said) ** 2) == pytest.approx(1.0, abs=0.2)
    assert calibrate.describe(trials[0], range(30)).count(f"{trials[0].misfit:.2f} times the stated noise") == 2


def test_standard_errors_contain_the_share_of_combinations_that_stay_open() -> None:
    """Six poses on a line, accurately measured: four combinations of each leg stay open, with a little of others."""
    random = np.random.default_rng(1)
    noise, scores = np.array([1e-6, 1e-6, 5e-6]), []
    for _ in range(60):
        true = DOUBT * 0.2 * random.standard_normal((3, 5))
        seen = poses(random, 6, (0.035, 0.0, 0.0)) + random.uniform(-1.0, 1.0, 3) * [0.04, 0.04, 0.2]
        sliders = inverse(corrected(START, true), seen).position
        seen_noisily = seen + noise * random.standard_normal(seen.shape)
        found = identify(START, seen_noisily, sliders, position_noise=1e-6, angle_noise=5e-6)
        scores.append((found.corrections - true) / found.standard_errors)
    assert np.any(np.isinf(found.standard_errors))
    assert np.abs(scores).max() < 5.0


def test_stated_noise_weighs_and_scales() -> None:
    random = np.random.default_rng(2)
    robot, seen = as_built(random), poses(random, 60)
    seen_noisily, sliders = noisy(random, seen), inverse(robot, seen).position
    once = identify(START, seen_noisily, sliders)
    double = identify(START, seen_noisily, sliders, position_noise=40e-6, angle_noise=2e-4)
    assert_allclose(double.standard_errors, 2.0 * once.standard_errors / max(1.0, once.misfit), rtol=1e-4)
    assert double.misfit == pytest.approx(once.misfit / 2.0)
    by_position = identify(START, seen_noisily, sliders, angle_noise=1.0)
    assert np.std(by_position.residuals[:, 0]) < np.std(once.residuals[:, 0])
    assert np.std(by_position.residuals[:, 2]) > np.std(once.residuals[:, 2])


def test_a_measured_angle_may_be_whole_turns_off() -> None:
    random = np.random.default_rng(3)
    robot, seen = as_built(random), poses(random, 20)
    sliders = inverse(robot, seen).position
    turned = seen + np.outer(random.integers(-2, 3, 20), [0.0, 0.0, 2.0 * math.pi])
    found, same = identify(START, turned, sliders), identify(START, seen, sliders)
    assert_allclose(found.corrections, same.corrections, atol=1e-12)


def test_derivatives_against_differences() -> None:
    random = np.random.default_rng(4)
    at = 0.3 * DOUBT * random.standard_normal((3, 5))
    geometry, seen, h = corrected(START, at), poses(random, 10), 1e-6
    sliders = inverse(geometry, seen).position
    derivatives = pose_derivatives(geometry, START, seen)
    for leg in range(3):
        for parameter in range(5):
            step = np.zeros((3, 5))
            step[leg, parameter] = h
            after, before = (forward(corrected(START, at + s * step), sliders, near=seen) for s in (1.0, -1.0))
            assert_allclose(derivatives[:, :, leg, parameter], (after - before) / (2.0 * h), rtol=1e-6, atol=1e-7)


# ---- what cannot be told


def test_what_no_pose_tells_stays_as_it_was() -> None:
    """The anchor along the rail with home, and the edge point along the edge: in a start that differs in them."""
    random = np.random.default_rng(5)
    robot, seen = as_built(random), poses(random, 40)
    sliders = inverse(robot, seen).position
    legs = [
        Leg(
            anchor=(leg.anchor[0] + s * math.cos(leg.rail_angle), leg.anchor[1] + s * math.sin(leg.rail_angle)),
            rail_angle=leg.rail_angle,
            home=leg.home - s,
            edge_point=(
                leg.edge_point[0] + e * math.cos(leg.edge_angle),
                leg.edge_point[1] + e * math.sin(leg.edge_angle),
            ),
            edge_angle=leg.edge_angle,
        )
        for leg, (s, e) in zip(START.legs, random.uniform(-0.03, 0.03, (3, 2)), strict=True)
    ]
    moved = Geometry(legs=(legs[0], legs[1], legs[2]))
    assert_allclose(inverse(moved, seen).position, inverse(START, seen).position, atol=1e-15)
    for start in (START, moved):
        found = identify(start, seen, sliders).geometry
        assert_allclose(told(found), told(robot), rtol=0.0, atol=1e-9)
        for before, after in zip(start.legs, found.legs, strict=True):
            rail, edge = np.subtract(after.anchor, before.anchor), np.subtract(after.edge_point, before.edge_point)
            assert rail @ [math.cos(before.rail_angle), math.sin(before.rail_angle)] == pytest.approx(0.0, abs=1e-15)
            assert edge @ [math.cos(before.edge_angle), math.sin(before.edge_angle)] == pytest.approx(0.0, abs=1e-15)


def test_poses_at_one_angle_leave_two_combinations_of_each_leg_open() -> None:
    """n turns with phi alone: at one phi, anchor, home and edge point add up to one distance."""
    random = np.random.default_rng(6)
    robot, seen, unseen = as_built(random), poses(random, 60, (0.1, 0.1, 0.0)), poses(random, 50, (0.1, 0.1, 0.0))
    found = identify(START, noisy(random, seen), inverse(robot, seen).position)
    assert found.open == tuple((leg, (ANCHOR, HOME, EDGE_POINT), 2) for leg in LEGS)
    assert np.all(np.isinf(found.standard_errors) == [True, False, True, True, False])
    error = (forward(found.geometry, inverse(robot, unseen).position, near=unseen) - unseen) / NOISE
    assert np.max(np.abs(error)) < 2.0  # it serves where it was measured


@pytest.mark.parametrize(
    ("span", "combinations"), [((0.0, 0.0, 0.0), 4), ((0.1, 0.0, 0.0), 3), ((0.1, 0.1, 0.03), 1), (SPAN, 0)]
)
def test_more_variety_leaves_less_open(span: tuple[float, float, float], combinations: int) -> None:
    random = np.random.default_rng(7)
    robot, seen = as_built(random), poses(random, 60, span)
    found = identify(START, noisy(random, seen), inverse(robot, seen).position)
    assert [one.combinations for one in found.open] == [combinations] * (3 if combinations else 0)
    assert 0.8 < found.misfit < 1.2


def test_what_is_open_stays_near_the_start() -> None:
    random = np.random.default_rng(8)
    seen = poses(random, 60, (0.1, 0.1, 0.0))
    found = identify(START, noisy(random, seen), inverse(START, seen).position)
    assert np.max(np.abs(found.corrections) / DOUBT) < 0.05


# ---- data that cannot be used


def test_poses_must_be_enough() -> None:
    random = np.random.default_rng(9)
    seen = poses(random, 6)
    assert identify(START, seen, inverse(START, seen).position).misfit < 1e-6
    with pytest.raises(CalibrationError, match="5 poses are too few: at least 6 are required"):
        identify(START, seen[:5], inverse(START, seen[:5]).position)


@pytest.mark.parametrize("noise", [0.0, -1e-6, math.nan, math.inf])
def test_noise_must_be_positive(noise: float) -> None:
    seen = np.zeros((6, 3))
    with pytest.raises(CalibrationError, match=r"the position noise is .*: it must be finite and positive"):
        identify(START, seen, seen, position_noise=noise)
    with pytest.raises(CalibrationError, match=r"the angle noise is .*: it must be finite and positive"):
        identify(START, seen, seen, angle_noise=noise)


def test_noise_can_drown_everything() -> None:
    seen = poses(np.random.default_rng(18), 6)
    with pytest.raises(CalibrationError, match="the stated noise is too large: the poses determine nothing"):
        identify(START, seen, inverse(START, seen).position, position_noise=10.0, angle_noise=10.0)


def test_a_wrong_row_is_found() -> None:
    random = np.random.default_rng(10)
    robot, seen = as_built(random), poses(random, 60)
    measured = noisy(random, seen)
    measured[17, 1] += 2e-3
    with pytest.raises(
        CalibrationError, match=r"no geometry fits: the residuals are .* at this pose, the worst"
    ) as refused:
        identify(START, measured, inverse(robot, seen).position)
    assert refused.value.row == 17


def test_exchanged_sliders_do_not_fit() -> None:
    random = np.random.default_rng(11)
    seen = poses(random, 60, (0.02, 0.02, 0.1))
    with pytest.raises(CalibrationError, match="no geometry fits"):
        identify(START, seen, inverse(START, seen).position[:, [1, 0, 2]])


def test_a_pose_out_of_reach_is_found() -> None:
    random = np.random.default_rng(12)
    seen = poses(random, 20)
    sliders = inverse(START, seen).position
    sliders[4] += 1.0
    with pytest.raises(CalibrationError, match="out of reach of the starting geometry") as refused:
        identify(START, seen, sliders)
    assert refused.value.row == 4


def test_no_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(13)
    seen = poses(random, 20)
    monkeypatch.setattr(calibration, "MAX_EVALUATIONS", 1)
    robot = corrected(START, np.full((3, 5), 1e-5))
    with pytest.raises(CalibrationError, match="no convergence after 1 steps"):
        identify(START, seen, inverse(robot, seen).position)


# ---- the tool


def table(path: Path, seen: Array, sliders: Array, columns: str = "x,y,phi,A,B,C") -> Path:
    rows = [",".join(map(repr, row)) for row in np.hstack([seen, sliders]).tolist()]
    path.write_text("\n".join([columns, *rows]) + "\n", encoding="utf-8")
    return path


def configured(section: str) -> Geometry:
    """Return the geometry of a configuration that has this section, as the service reads it."""
    text, count = re.subn(r"\[geometry\]\nl0 = .*\n", section, SIM)
    assert count == 1
    return config.geometry(config.parse(text.replace("phi = [-1.2, 0.85]", "phi = [-1.2, 0.6]")).geometry)


@pytest.fixture
def measured(tmp_path: Path) -> Path:
    random = np.random.default_rng(14)
    seen = poses(random, 60)
    return table(tmp_path / "poses.csv", noisy(random, seen), inverse(as_built(random), seen).position)


def test_the_section_is_what_the_service_reads() -> None:
    robot = as_built(np.random.default_rng(15))
    assert configured(calibrate.section(robot)) == robot


def test_from_file_to_section(measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen, sliders, lines = calibrate.read(measured)
    assert lines == list(range(2, 62))
    expected = identify(START, seen, sliders)

    assert calibrate.main([str(measured)]) == 0
    said = capsys.readouterr()
    assert configured(said.out) == expected.geometry
    for words in ("60 poses", "phi [mrad]", "C edge_angle [mrad]", "No pose tells", "singular at phi"):
        assert words in said.err
    assert "cannot separate" not in said.err

    output = tmp_path / "geometry.toml"
    assert calibrate.main([str(measured), "--output", str(output)]) == 0
    assert capsys.readouterr().out == ""
    assert output.read_text(encoding="utf-8") == said.out


def test_an_identified_geometry_can_be_the_next_start(
    measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrate.main([str(measured)]) == 0
    first = capsys.readouterr().out
    text = re.sub(r"\[geometry\]\nl0 = .*\n", first, SIM).replace("phi = [-1.2, 0.85]", "phi = [-1.2, 0.6]")
    again = tmp_path / "robot.toml"
    again.write_text(text, encoding="utf-8")
    assert calibrate.main([str(measured), "--config", str(again)]) == 0
    assert_allclose(told(configured(capsys.readouterr().out)), told(configured(first)), rtol=0.0, atol=1e-9)


def test_degrees_and_any_order_of_columns(tmp_path: Path) -> None:
    seen = poses(np.random.default_rng(16), 4)
    sliders = inverse(START, seen).position
    turned = seen * [1.0, 1.0, 180.0 / math.pi]
    file = table(tmp_path / "poses.csv", turned[:, ::-1], sliders, "phi, y, x, A, B, C")
    read_poses, read_sliders, _ = calibrate.read(file, degrees=True)
    assert_allclose(read_poses, seen, rtol=1e-15)
    assert_allclose(read_sliders, sliders, rtol=0.0)


@given(st.lists(st.integers(-9999, 9999), min_size=6, max_size=6), st.booleans())
def test_a_field_of_the_table_may_have_a_unit(
    tmp_path_factory: pytest.TempPathFactory, values: list[int], deg: bool
) -> None:
    length, angle = 1e-6, math.pi / 648_000.0
    file = tmp_path_factory.mktemp("units") / "poses.csv"
    units = ["um", " µm", "arcsec", "um", "μm", "um"]
    fields = [f"{value}{unit}" for value, unit in zip(values, units, strict=True)]
    file.write_text(f"{HEADER}{','.join(fields)}\n", encoding="utf-8")
    pose, sliders, _ = calibrate.read(file, degrees=deg)
    expected = np.multiply(values, [length, length, angle, length, length, length])
    assert_allclose(np.concatenate([pose[0], sliders[0]]), expected, rtol=1e-15)


def test_what_is_open_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(17)
    seen = poses(random, 30, (0.1, 0.1, 0.0))
    file = table(tmp_path / "poses.csv", noisy(random, seen), inverse(START, seen).position)
    assert calibrate.main([str(file)]) == 0
    said = capsys.readouterr().err
    names = "anchor across the rail, home, edge_point across the edge"
    for leg in LEGS:
        assert f"{leg}: these poses cannot separate {names}: 2 combinations of them stay" in said
    assert re.search(r"A home \[mm\] .* open\n", said)
    assert "in phi above all" in said


def test_a_leg_has_its_label_everywhere_and_one_parameter_is_no_combination() -> None:
    random = np.random.default_rng(17)
    start, seen = dataclasses.replace(START, labels=("U", "V", "W")), poses(random, 30)
    found = identify(start, seen, inverse(START, seen).position)
    open_parameters = (Open("A", (HOME,), 1), Open("C", (HOME, EDGE_POINT), 1))
    said = calibrate.describe(found._replace(open=open_parameters), range(30))
    assert f"\nU: these poses do not determine {HOME}: it stays as in the starting geometry." in said
    assert f"\nW: these poses cannot separate {HOME}, {EDGE_POINT}: one combination of them stays" in said
    assert "Leg" not in said


HEADER = "x,y,phi,A,B,C\n"
ROW = "0.01,0.02,0.1,0.03,0.01,0.02\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "line 1: the columns are ; expected x, y, phi, A, B, C"),
        (ROW, "line 1: the columns are 0.01, 0.02, 0.1, 0.03, 0.01, 0.02; expected x, y, phi, A, B, C"),
        ("x,y,phi,A,B\n", "line 1: the columns are x, y, phi, A, B; expected x, y, phi, A, B, C"),
        ("x,y,phi,A,B,C,D\n", "line 1: the columns are x, y, phi, A, B, C, D; expected x, y, phi, A, B, C"),
        ("x,y,phi,A,B,B\n", "line 1: the columns are x, y, phi, A, B, B; expected x, y, phi, A, B, C"),
        (HEADER + ROW + "\n0,0,nan,0,0,0\n", "line 4: phi: 'nan' is not an angle"),
        (HEADER + ROW + "0,0,0,0,-inf,0\n", "line 3: B: '-inf' is not a length"),
        (HEADER + "0,0,zero,0,0,0\n", "line 2: phi: 'zero' is not an angle"),
        (HEADER + "0,0,0,0,0\n", "line 2: 5 fields; expected 6"),
        (HEADER + "0,0,0,0,0,0,0\n", "line 2: 7 fields; expected 6"),
    ],
)
def test_a_wrong_file_is_refused_by_line(
    content: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "poses.csv"
    file.write_text(content, encoding="utf-8")
    assert calibrate.main([str(file)]) == 1
    out, told = capsys.readouterr()
    assert out == ""
    assert told.startswith(f"calibrate: {file}: {said}")


def test_other_errors_are_one_line(measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def complaint(*arguments: str) -> str:
        assert calibrate.main(list(arguments)) == 1
        said = capsys.readouterr().err.splitlines()
        assert said[-1].startswith("calibrate: ")
        return said[-1]

    assert complaint(str(tmp_path / "none.csv")).endswith("none.csv: No such file or directory")
    assert "none.toml" in complaint(str(measured), "--config", str(tmp_path / "none.toml"))
    assert "the angle noise is 0.0" in complaint(str(measured), "--angle-noise", "0")
    assert "no geometry fits" in complaint(str(measured), "--position-noise", "1e-6", "--angle-noise", "1e-6")
    assert re.search(r": line \d+: ", complaint(str(measured), "--deg"))
    assert "cannot write" in complaint(str(measured), "--output", str(tmp_path / "none" / "geometry.toml"))
    robot = tmp_path / "robot.toml"
    robot.write_text(SIM, encoding="utf-8")
    assert "robot.toml already exists: choose another file" in complaint(str(measured), "--output", str(robot))
    assert robot.read_text(encoding="utf-8") == SIM
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00x")
    assert "not text in UTF-8" in complaint(str(binary))
    with pytest.raises(SystemExit, match="2"):
        calibrate.main([])
