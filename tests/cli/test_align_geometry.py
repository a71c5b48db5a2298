"""`trirail align geometry` with a service, on a stage that is built otherwise: what it writes, and what it does not."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import re
import signal
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import calibrate
import msgspec
import numpy as np
import patient
import pytest
import tomlkit
import warm
from alignment.cameras import FIELD as FIELD_PX
from alignment.cameras import BuiltStage, wide_camera
from hypothesis import example, given, reject, settings
from hypothesis import strategies as st
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.geometry_calibration import GeometryCalibration, GeometryTask, calibrate_geometry
from trirail.alignment.images import CameraView, project_points
from trirail.cli import align_geometry
from trirail.client import calibration_file, own_service
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.client.stage_as_built import built_otherwise
from trirail.commissioning import config_edit
from trirail.config import SIM, GeometryTable, as_built, geometry, load, parse, parse_values, room
from trirail.errors import ConfigError, KinematicsError
from trirail.kinematics.calibration import corrected
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import LEGS
from trirail.kinematics.robot import forward, inverse
from trirail.processes.publications import info
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.state import State
from trirail_drivers.driver import scaling
from trirail_drivers.interface import Triple

MARKS = """
import json, sys
import numpy as np
from pathlib import Path
from trirail import Robot
from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.images import CameraView, project_points
from trirail.client.stage_as_built import built_otherwise
from trirail.config import SIM, geometry, load
from trirail.kinematics.robot import forward
robot = geometry(load(SIM.with_name("uvw.toml")).geometry)
built = built_otherwise(robot, np.random.default_rng(1), 4e-4, 1e-3)
scales = 1.0 + np.array([1e-4, -2e-4, 1e-4])
middle = (4672.0, 3500.0)
rng = np.random.default_rng(2)
views = {
    "left": CameraView((-0.06, 0.0), middle, ((0.0, 2.6e5), (2.6e5, 0.0)), "radial", (2e-10, 0.0), middle),
    "right": CameraView((0.06, 0.0), middle, ((0.0, -2.6e5), (2.6e5, 0.0)), "radial", (-1e-10, 0.0), middle),
}
with Robot("uvw", sys.argv[1]) as robot:
    for _ in sys.stdin:
        pose, seen = forward(built, scales * robot.state().sliders.position), {}
        for name, x in (("left", -0.06), ("right", 0.06)):
            at = project_points(views[name], to_base_frame((x, 0.0), pose)[None])[0]
            seen[name] = (at + 0.05 * rng.standard_normal(2)).tolist()
        print(json.dumps(seen), flush=True)
"""
FIELD = ("--field", "9344", "7000")


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """Return the configuration and the locator of a service of a stage."""
    folder = tmp_path_factory.mktemp("stage")
    locator = f"unixsock-stream/{folder}/zenoh"
    config = patient.write(folder, "uvw.toml", locator)
    with own_service.service(config, folder / "session.rrd"), Robot("uvw", locator) as robot:
        robot.enable()
        yield config, locator


def options(stage: tuple[Path, str], tmp_path: Path) -> tuple[object, ...]:
    config, locator = stage
    script = tmp_path / "marks.py"
    script.write_text(MARKS, encoding="utf-8")
    marks = ("--program", f"{sys.executable} {script} {locator}", "--connect", locator, "--robot", "uvw")
    return config, *FIELD, "--poses", "14", "--calibration", tmp_path / "camera.json", *marks


@pytest.mark.slow
def test_a_stage_finds_its_geometry_and_writes_a_configuration_when_it_is_told_to(
    stage: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, _ = stage
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    before = config.read_text(encoding="utf-8")
    given, out, camera = options(stage, tmp_path), tmp_path / "new.toml", tmp_path / "camera.json"
    asked = warm.trirail("align", "geometry", *given, "--out", out)  # its input ends at once: nobody says yes
    assert asked.returncode == 0, asked.stderr
    assert "look 14 of 14" in asked.stdout
    assert "nothing is written" in asked.stdout
    assert not out.exists()
    assert not camera.exists()
    camera.write_text(taught := '{"calibration": "taught"}', encoding="utf-8")
    done = warm.trirail("align", "geometry", *given, "--out", out, "--yes", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert config.read_text(encoding="utf-8") == before
    assert found["residual"]["after"] < 0.5
    scale = found["parameters"]["B encoder scale"]
    assert scale < -1e-5  # the real one is -2e-4; few looks do not separate it from the rest of its leg
    assert all(found["deviations"][name] is None for name in found["undetermined"])
    written, service = load(out), load(config)
    assert written.drives.B.counts_per_metre == pytest.approx(service.drives.B.counts_per_metre / (1.0 + scale))
    assert written.limits == service.limits
    kept = calibration_file.read(camera)
    assert kept.geometry == as_built.geometry_of(geometry(written.geometry))
    assert not kept.is_of_geometry(as_built.geometry_of(geometry(service.geometry)))
    assert camera.with_name("camera.json.old").read_text(encoding="utf-8") == taught
    # The service still has the old geometry: that is said, and the calibration does not count as confirmed.
    checked = warm.trirail("align", "check", camera, *given[8:])
    assert "another geometry" in checked.stderr


@pytest.mark.slow
def test_a_measurement_is_kept_if_the_look_after_it_fails(stage: tuple[Path, str], tmp_path: Path) -> None:
    given, out, camera = options(stage, tmp_path), tmp_path / "new.toml", tmp_path / "camera.json"
    ends = MARKS.replace("    for _ in", "    for number, _ in").replace("sys.stdin:", "enumerate(sys.stdin):")
    ends = ends.replace("        pose, seen", "        if number == 14 * 4: sys.exit(7)\n        pose, seen")
    (tmp_path / "marks.py").write_text(ends, encoding="utf-8")
    done = warm.trirail("align", "geometry", *given, "--out", out, "--yes", "--json", "--looks", "4")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["written"]["config"] == str(out)
    assert "the targets are the computed positions of the marks" in found["errors"][0]
    assert load(out)
    targets = calibration_file.read(camera).targets
    assert targets["left"] == pytest.approx((4672.0, 3500.0), abs=2000.0)


@pytest.mark.slow
def test_pictures_that_are_one_late_end_with_an_error_and_change_no_file(
    stage: tuple[Path, str], tmp_path: Path
) -> None:
    given, out, camera = options(stage, tmp_path), tmp_path / "new.toml", tmp_path / "camera.json"
    script = tmp_path / "marks.py"
    late = MARKS.replace("    for _ in", "    last = None\n    for _ in")
    late = late.replace("print(json.dumps(seen)", "last, seen = seen, last or seen\n        print(json.dumps(seen)")
    script.write_text(late, encoding="utf-8")
    more = ["24" if each == "14" else each for each in given]
    done = warm.trirail("align", "geometry", *more, "--out", out, "--yes")
    assert done.returncode == 1
    assert re.search("the marks do not follow the (stage|moves)[:;] the residual is", " ".join(done.stderr.split()))
    assert not out.exists()
    assert not camera.exists()


@pytest.mark.slow
def test_a_stage_that_is_as_configured_keeps_its_configuration(stage: tuple[Path, str], tmp_path: Path) -> None:
    given, out, camera = options(stage, tmp_path), tmp_path / "new.toml", tmp_path / "camera.json"
    exact = MARKS.replace("np.random.default_rng(1), 4e-4, 1e-3", "np.random.default_rng(1), 0.0, 0.0")
    exact = exact.replace("1.0 + np.array([1e-4, -2e-4, 1e-4])", "np.ones(3)")
    (tmp_path / "marks.py").write_text(exact, encoding="utf-8")
    done = warm.trirail("align", "geometry", *given, "--out", out, "--yes")
    assert done.returncode == 0, done.stderr
    assert "The configured geometry is as good as can be measured" in " ".join(done.stdout.split())
    assert not out.exists()
    configured = geometry(load(stage[0]).geometry)
    assert json.loads(camera.read_text())["geometry"] == as_built.geometry_of(configured)


@pytest.mark.slow
def test_what_is_not_the_configuration_of_the_service_is_refused_before_a_move(
    stage: tuple[Path, str], tmp_path: Path
) -> None:
    config, *rest = options(stage, tmp_path)
    other = tmp_path / "other.toml"
    text = Path(str(config)).read_text(encoding="utf-8").replace("[0.0425, -0.0575]", "[0.0426, -0.0575]")
    other.write_text(text, encoding="utf-8")
    done = warm.trirail("align", "geometry", other, *rest)
    assert done.returncode == 1
    assert "differs from that of the running service" in " ".join(done.stderr.split())


@pytest.mark.slow
def test_ctrl_c_stops_the_stage_and_writes_nothing(stage: tuple[Path, str], tmp_path: Path) -> None:
    out = tmp_path / "new.toml"
    given = [str(each) for each in options(stage, tmp_path)]
    with (tmp_path / "said").open("wb") as said:
        slowly = ("--out", str(out), "--yes", "--speed", "0.05")
        started = warm.start("align", "geometry", *given, *slowly, output=said)
    with Robot("uvw", stage[1]) as robot:
        for state in robot.states():
            if state.mode == "moving":
                break
        started.send_signal(signal.SIGINT)
        assert started.wait(30.0) != 0
        assert robot.state().mode == "holding"
    assert not out.exists()


@pytest.mark.slow
def test_python_programs_find_the_geometry_too_with_and_without_an_event_loop(stage: tuple[Path, str]) -> None:
    view = CameraView((-0.06, 0.0), (4672.0, 3500.0), ((0.0, 2.6e5), (2.6e5, 0.0)))
    scales = 1.0 + np.array([1e-4, -2e-4, 1e-4])
    model = geometry(load(stage[0]).geometry)

    def seen(state: State) -> dict[str, tuple[float, float]]:
        pose = forward(model, scales * state.sliders.position)
        at = {name: to_base_frame((-0.06, y), pose.tolist()) for name, y in (("a", -1e-3), ("b", 1e-3))}
        pixels = {name: project_points(view, place[None])[0].tolist() for name, place in at.items()}
        return {name: (u, v) for name, (u, v) in pixels.items()}

    def check(found: GeometryCalibration) -> None:
        assert found.residual.after < 0.02
        assert set(found.deviations) == set(found.parameters)
        assert set(found.undetermined) < set(found.parameters)

    views = {"a": "camera", "b": "camera"}
    with Robot("uvw", stage[1]) as robot:
        check(robot.calibrate_geometry(lambda: seen(robot.state()), (9344, 7000), views=views, poses=16, looks=1))

    async def work() -> None:
        async with AsyncRobot("uvw", stage[1]) as robot:

            async def look() -> dict[str, tuple[float, float]]:
                return seen(await robot.state())

            check(await robot.calibrate_geometry(look, (9344, 7000), views=views, poses=16, looks=1))

    asyncio.run(work())


@pytest.mark.parametrize("name", ["uvw.toml", "uvw-ppr.toml", "xxy.toml", "sim.toml"])
def test_only_the_geometry_and_the_scales_change_in_the_file(name: str) -> None:
    text = SIM.with_name(name).read_text(encoding="utf-8")
    built = built_otherwise(geometry(parse(text).geometry), np.random.default_rng(3), 50e-6, 1e-4)
    written = parse(config_edit.edit_geometry(text, built, (1e-4, 0.0, -1e-4), None))
    assert as_built.geometry_of(geometry(written.geometry)) == as_built.geometry_of(built)
    assert written.drives.A.counts_per_metre == pytest.approx(parse(text).drives.A.counts_per_metre / 1.0001)
    assert written.drives.B == parse(text).drives.B
    assert written.limits == parse(text).limits
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert all(line in config_edit.edit_geometry(text, built, (0.0, 0.0, 0.0), None) for line in comments)


TURNS = st.sampled_from((0.0, 0.5, 1.0, 1.5, 2.0, -1.0, -1.5, -2.0)).flatmap(
    lambda turn: st.floats(-2.0, 2.0) | st.just(turn)
)
CHANGES = st.tuples(*[st.floats(-1e-3, 1e-3)] * 15)


@pytest.mark.parametrize("name", ["uvw", "uvw-ppr"])
@given(half_turns=st.tuples(*[TURNS] * 3), changes=CHANGES)
@example(half_turns=(0.0, 0.0, 1.5), changes=(*[0.0] * 14, 1e-4))  # the cross slide of C is at 360° by default
@example(half_turns=(2.0, -2.0, 1.9), changes=(1e-4, 0.0, 0.0, 0.0, 1e-4, -1e-4, 0.0, 0.0, 0.0, -1e-4, *[1e-4] * 5))
@settings(max_examples=40)
def test_a_geometry_with_rails_in_any_direction_is_written_and_sent(
    name: str, half_turns: Triple, changes: tuple[float, ...]
) -> None:
    text = SIM.with_name(f"{name}.toml").read_text(encoding="utf-8")
    values, tables = parse(text), tomlkit.parse(text)
    for leg, half_turn in zip(tables["geometry"]["leg"], half_turns, strict=True):
        leg["rail_angle"] = half_turn * math.pi
        if "edge_angle" in leg:
            leg["edge_angle"] = math.remainder(half_turn * math.pi + 0.5 * math.pi, math.tau)
    text = tomlkit.dumps(tables)
    try:
        start = geometry(parse_values(text).geometry)
        built = corrected(start, np.reshape(changes, (3, 5)))
    except (ConfigError, KinematicsError):
        reject()  # it is singular
    sent = DrawnRobot.from_info(info(msgspec.structs.replace(values, geometry=parse_values(text).geometry)))
    assert as_built.geometry_of(sent.geometry) == as_built.geometry_of(start)
    written = geometry(parse_values(config_edit.edit_geometry(text, built, (0.0, 0.0, 0.0), None)).geometry)
    assert as_built.geometry_of(written) == as_built.geometry_of(built)
    section = geometry(msgspec.convert(tomllib.loads(calibrate.section(built))["geometry"], GeometryTable))
    assert section == built
    for leg, first, row in zip(built.each, start.each, np.reshape(changes, (3, 5)).tolist(), strict=True):
        pose = np.array([1e-3]), np.array([-2e-3]), np.array([0.01])
        assert np.array(leg.travels(*pose)) == pytest.approx(np.array(first.corrected(row).travels(*pose)), abs=1e-9)


OFFSETS = st.one_of(st.just(0.0), st.floats(-0.5, 0.5), st.floats(-90.0, 90.0))


@pytest.mark.parametrize("name", ["uvw.toml", "uvw-ppr.toml", "xxy.toml", "sim.toml"])
@given(
    offsets=st.tuples(*[OFFSETS] * 3),
    directions=st.tuples(*[st.sampled_from((1, -1))] * 3),
    scales=st.tuples(*[st.one_of(st.just(0.0), st.floats(-0.01, 0.01))] * 3),
    seed=st.integers(0, 100),
)
@example(offsets=(0.05, -0.02, 0.0), directions=(1, -1, 1), scales=(1e-4, -2e-4, 1e-4), seed=1)
@settings(max_examples=10)
def test_a_drive_reads_the_fitted_positions_with_the_file_that_is_written(
    name: str, offsets: Triple, directions: Triple, scales: Triple, seed: int
) -> None:
    rng, text = np.random.default_rng(seed), SIM.with_name(name).read_text(encoding="utf-8")
    changes: dict[str, int | float] = {}
    for axis, offset, direction in zip(LEGS, offsets, directions, strict=True):
        changes |= {f"drives.{axis}.direction": direction} | ({f"drives.{axis}.offset": offset} if offset else {})
    old = parse(text := config_edit.edit_text(text, changes))
    built = built_otherwise(geometry(old.geometry), rng, 1e-6, 1e-6)  # larger errors can move a singular angle
    new = parse(config_edit.edit_geometry(text, built, scales, None))
    platform = old.limits.platform  # within its limits, the robot is far from singular, so that errors stay small
    poses = np.stack([rng.uniform(*limits, 9) for limits in (platform.x, platform.y, platform.phi)], axis=1)
    positions = inverse(geometry(old.geometry), poses).position.T
    readings, fitted = np.empty((2, 3, 9))
    for i, (axis, before, after) in enumerate(zip(LEGS, old.drives.each, new.drives.each, strict=True)):
        counts = [scaling.scale_of(axis, before).counts(position) for position in positions[i].tolist()]
        readings[i] = [scaling.scale_of(axis, after).metres(each) for each in counts]
        fitted[i] = [(1.0 + scales[i]) * scaling.scale_of(axis, before).metres(each) for each in counts]
        assert after.direction == before.direction
        assert (after.offset == 0.0) is (before.offset == 0.0)
    assert readings == pytest.approx(fitted, abs=1e-9, rel=0.0)
    # The file has the coordinates and angles of the legs to a nanometre and a nanoradian.
    poses = forward(geometry(new.geometry), readings.T)
    assert poses == pytest.approx(forward(built, fitted.T), abs=1e-7, rel=0.0)


def test_a_map_of_the_old_geometry_is_left_out_and_another_may_take_its_place() -> None:
    plain = SIM.read_text(encoding="utf-8")
    text = plain + '\n[correction]\nmap = "old.toml"\nbacklash = [1e-6, 0.0, 0.0]\n'
    robot = geometry(parse(plain).geometry)
    without = tomllib.loads(config_edit.edit_geometry(text, robot, (0.0, 0.0, 0.0), None))
    assert without["correction"] == {"backlash": [1e-6, 0.0, 0.0]}
    other = tomllib.loads(config_edit.edit_geometry(text, robot, (0.0, 0.0, 0.0), "new.toml"))
    assert other["correction"]["map"] == "new.toml"
    assert len(other["geometry"]["leg"]) == len(LEGS)


def test_an_impossible_geometry_is_not_written() -> None:
    text = SIM.with_name("uvw.toml").read_text(encoding="utf-8")
    with pytest.raises(ConfigError):
        config_edit.edit_geometry(text, geometry(parse(text).geometry), (1e12, 0.0, 0.0), None)


def test_a_map_that_helps_is_written_beside_the_configuration_that_names_it(tmp_path: Path) -> None:
    config, out = tmp_path / "uvw.toml", tmp_path / "new.toml"
    config.write_text(SIM.with_name("uvw.toml").read_text(encoding="utf-8"), encoding="utf-8")
    settings, rng = load(config), np.random.default_rng(8)
    robot = geometry(settings.geometry)
    nodes = rng.uniform(-1.0, 1.0, (5, 5, 5, 3)) * (1e-5, 1e-5, 0.0)
    bent = dataclasses.replace(robot, correction=Correction((-0.012, -0.012, -0.1), (0.012, 0.012, 0.1), nodes))
    part = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}
    views = {name: wide_camera(rng, at) for name, at in part.items()}
    stage = BuiltStage(robot, bent, (0.0, 0.0, 0.0), views, part, rng, 0.05)
    found = stage.drive(calibrate_geometry(GeometryTask(robot, room(settings.limits), FIELD_PX, poses=60, looks=1)))
    usable = align_geometry._usable_map(found, settings, quiet=True)
    assert usable is not None
    written, _ = align_geometry._write(found, config, settings, out, tmp_path / "camera.json", stage.look(), usable)
    assert written.map == tmp_path / "new-map.toml"
    read = load(out).correction.as_built  # allowed with the new geometry and the limits
    assert read is not None
    assert as_built.format_map(read) == as_built.format_map(usable)
    out.rename(config)  # the map stays, under the name by which the configuration finds it
    again, _ = align_geometry._write(found, config, settings, out, tmp_path / "camera.json", stage.look(), usable)
    assert again.map == tmp_path / "new-map-2.toml"
    assert load(out).correction.map == str(again.map)
    without, _ = align_geometry._write(
        found, config, settings, tmp_path / "plain.toml", tmp_path / "camera.json", stage.look(), None
    )
    assert (without.map, load(tmp_path / "plain.toml").correction.as_built) == (None, None)
    assert without.old_cameras == tmp_path / "camera.json.old"


# The measured geometry differs by more than 1 µm, so at least one of these poses needs a slider beyond its travel.
AT_LIMITS = """
[poses]
left = [-0.009999, 0.0, 0.0]
right = [0.009999, 0.0, 0.0]
"""


def test_a_measurement_is_kept_when_a_named_pose_is_beyond_a_limit_with_it(tmp_path: Path) -> None:
    config, out, camera = tmp_path / "uvw.toml", tmp_path / "new.toml", tmp_path / "camera.json"
    config.write_text(SIM.with_name("uvw.toml").read_text(encoding="utf-8") + AT_LIMITS, encoding="utf-8")
    settings, rng = load(config), np.random.default_rng(8)
    robot = geometry(settings.geometry)
    part = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}
    views = {name: wide_camera(rng, at) for name, at in part.items()}
    stage = BuiltStage(robot, built_otherwise(robot, rng, 2e-4, 4e-4), (0.0, 0.0, 0.0), views, part, rng, 0.05)
    found = stage.drive(calibrate_geometry(GeometryTask(robot, room(settings.limits), FIELD_PX, poses=20, looks=1)))
    written, failures = align_geometry._write(found, config, settings, out, camera, stage.look(), None)
    assert written == (out, camera, None, None)
    (failure,) = failures
    with pytest.raises(ConfigError, match=r"poses\.(left|right) = ") as refused:  # the service says the same
        load(out)
    assert str(refused.value) in str(failure)
    text = out.read_text(encoding="utf-8")
    assert str(refused.value).removeprefix(f"{out}: ") in text.splitlines()[1]
    for name in ("left", "right"):  # the person corrects the poses, and the file is valid
        text = text.replace(f"{name} = [", f"{name} = [0.5e-3, 0.0, 0.0] # [")
    assert as_built.geometry_of(geometry(parse(text).geometry)) == as_built.geometry_of(found.geometry)
    assert calibration_file.read(camera).geometry == as_built.geometry_of(found.geometry)


def test_the_cameras_are_kept_when_the_configuration_cannot_be_written(tmp_path: Path) -> None:
    config, camera = tmp_path / "uvw.toml", tmp_path / "camera.json"
    config.write_text(SIM.with_name("uvw.toml").read_text(encoding="utf-8"), encoding="utf-8")
    settings, rng = load(config), np.random.default_rng(8)
    robot = geometry(settings.geometry)
    views = {"left": wide_camera(rng, (-0.06, 0.0)), "right": wide_camera(rng, (0.06, 0.0))}
    part = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}
    stage = BuiltStage(robot, robot, (0.0, 0.0, 0.0), views, part, rng, 0.05)
    found = stage.drive(calibrate_geometry(GeometryTask(robot, room(settings.limits), FIELD_PX, poses=20, looks=1)))
    found = found._replace(change=1.0)  # significant
    written, failures = align_geometry._write(found, config, settings, config, camera, stage.look(), None)
    assert (written.config, written.cameras, camera.exists()) == (None, camera, True)
    assert "already exists" in str(failures[0])
    written, failures = align_geometry._write(found, config, settings, None, tmp_path, stage.look(), None)
    assert (written.config, written.cameras) == (tmp_path / "uvw-calibrated.toml", None)
    assert load(tmp_path / "uvw-calibrated.toml")
    assert str(tmp_path) in str(failures[0])


@pytest.mark.slow
def test_the_values_are_printed_when_a_named_pose_is_beyond_a_limit_with_them(
    stage: tuple[Path, str], tmp_path: Path
) -> None:
    service, *given = options(stage, tmp_path)
    config, out = tmp_path / "uvw.toml", tmp_path / "new.toml"
    config.write_text(Path(str(service)).read_text(encoding="utf-8") + AT_LIMITS, encoding="utf-8")
    done = warm.trirail("align", "geometry", config, *given, "--out", out, "--yes", "--json")
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["written"]["config"] == str(out)
    assert "poses." in found["errors"][0]
    assert found["parameters"]["B encoder scale"] != 0.0
