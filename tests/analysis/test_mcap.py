"""A recording as MCAP and its mechanism as URDF, read back by programs that are not ours."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import tracemalloc
from pathlib import Path
from typing import Any

import made
import msgspec
import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from trirail import config
from trirail.analysis import mcap
from trirail.analysis.urdf import document
from trirail.cli import recording_commands
from trirail.config import SIM, as_built, load
from trirail.errors import ServiceError, TrirailError
from trirail.kinematics.correction import Correction
from trirail.kinematics.geometry import singular_angles
from trirail.kinematics.robot import inverse
from trirail.telemetry import journal, provenance
from trirail.telemetry.reading import read
from trirail.telemetry.recorder import Recorder
from trirail.telemetry.recording import Recording
from trirail.wire.messages import Event, FaultDetail
from trirail.wire.records import DTYPE
from trirail.wire.vocabulary import MODES, Mode

SHIPPED = sorted(path for path in SIM.parent.glob("*.toml"))
SINGULAR = singular_angles(config.geometry(load(SIM).geometry))[0]
FAULT = Event("fault", "error", "drive B: EMCY 8611h", seq=1, t=0.4, cycle=400, time=0.0,
              fault=FaultDetail("emcy", "B", 0x8611))  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("mcap") / "made.rrd"
    recorder = Recorder(load(SIM), path.parent, path=path, live=False)
    recorder.records(made.records(0.5).tobytes())
    recorder.close()
    found = read(path)
    line = journal.Line(FAULT.t, found.wall[400], "ERROR", FAULT.message, FAULT)
    return found._replace(events=[*found.events, line])


@pytest.fixture(scope="module")
def exported(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mcap") / "made.mcap"
    assert mcap.write(recording, path) > 4 * len(recording.records)
    assert [each.name for each in path.parent.iterdir()] == [path.name]
    return path


def by_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def by_rosbags(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with Reader(path) as bag:
        for connection, wall, data in bag.messages():
            message = mcap.STORE.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((wall, message))
    return found


@pytest.mark.parametrize("reader", [by_mcap, by_rosbags])
def test_every_number_comes_back_to_the_last_bit(reader: Any, recording: Recording, exported: Path) -> None:
    found = reader(exported)
    assert set(found) == set(mcap.TOPICS)
    records, walls = recording.records, recording.wall.astype("datetime64[ns]").astype(np.int64).tolist()
    for topic in ("/joint_states", "/pose", "/commanded_pose", "/tf"):
        assert [wall for wall, _ in found[topic]] == walls
    stamps = [(m.header.stamp.sec, m.header.stamp.nanosec) for _, m in found["/pose"]]
    assert [sec * 10**9 + nanosec for sec, nanosec in stamps] == walls
    positions = np.array([m.position for _, m in found["/joint_states"]])
    np.testing.assert_array_equal(positions[:, :3], records["position"] - records["backlash"])
    np.testing.assert_array_equal([m.velocity[:3] for _, m in found["/joint_states"]], records["velocity"])
    assert {tuple(m.name) for _, m in found["/joint_states"]} == {mcap.JOINTS}
    for topic, field in (("/pose", "pose"), ("/commanded_pose", "commanded_pose")):
        poses = [m.pose for _, m in found[topic]]
        np.testing.assert_array_equal([(p.position.x, p.position.y) for p in poses], records[field][:, :2])
        angles = [2.0 * math.atan2(p.orientation.z, p.orientation.w) for p in poses]
        np.testing.assert_allclose(angles, records[field][:, 2], rtol=0.0, atol=1e-15)
    frames = [[t.child_frame_id for t in m.transforms] for _, m in found["/tf"]]
    assert frames == [[mcap.MEASURED, mcap.COMMANDED]] * len(records)
    events = [json.loads(m.data) for _, m in found["/events"]]
    assert msgspec.convert(events[-1], Event) == FAULT


@given(
    unhomed=st.sets(st.tuples(st.integers(0, 499), st.integers(0, 2)), max_size=20),
    unknown=st.sets(st.tuples(st.integers(0, 499), st.sampled_from((math.nan, math.inf, SINGULAR))), max_size=5),
)
def test_cycles_without_a_pose_have_no_motion_and_end_nothing(
    recording: Recording, unhomed: set[tuple[int, int]], unknown: set[tuple[int, float]]
) -> None:
    settings = load(SIM)
    records = recording.records.copy()
    for row, slider in unhomed:
        records["homed"][row, slider] = False
    for row, value in unknown:
        records["pose"][row] = 0.0, 0.0, value
    without = {row for row, _ in unhomed | unknown}
    times = [int(wall) for row, wall in enumerate(recording.wall.astype(np.int64)) if row not in without]
    made = list(mcap.messages(recording._replace(records=records), config.corrected_geometry(settings)))
    for topic in ("/joint_states", "/pose", "/commanded_pose", "/tf"):
        assert [wall for wall, name, _ in made if name == topic] == times
    assert {name for _, name, _ in made} == set(mcap.TOPICS)


@pytest.mark.parametrize("shown", ["1969-12-31T23:59:59", "2038-01-19T03:14:08", "2250-01-01T00:00:00"])
@pytest.mark.parametrize("where", ["cycles", "events"])
def test_a_clock_that_messages_cannot_contain_is_named(
    recording: Recording, tmp_path: Path, shown: str, where: str
) -> None:
    """As on a machine without a battery-backed clock, or whose clock was set wrongly."""
    if where == "cycles":
        wall = recording.wall.copy()
        wall[7] = np.datetime64(shown)
        strange = recording._replace(wall=wall)
    else:
        line = recording.events[-1]._replace(wall=np.datetime64(shown, "ns"))
        strange = recording._replace(events=[*recording.events, line])
    with pytest.raises(ServiceError, match=f"the clock showed {shown}; .* export to CSV or Parquet"):
        mcap.write(strange, tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_modes_and_faults_are_diagnostics(recording: Recording, exported: Path) -> None:
    statuses = [m.status[0] for _, m in by_mcap(exported)["/diagnostics"]]
    assert [(s.name, s.message) for s in statuses] == [("trirail: mode", "moving"), ("trirail: fault", FAULT.message)]
    assert {pair.key: pair.value for pair in statuses[1].values} == {
        "cause": "emcy", "drive": "B", "code": str(0x8611), "t": "0.4",
    }  # fmt: skip


@given(changed=st.sets(st.integers(0, 499)), every=st.sampled_from([None, 1e-3, 0.01, 0.0375, 1.0]))
def test_no_change_of_the_mode_is_lost_if_the_rows_are_fewer(
    recording: Recording, changed: set[int], every: float | None
) -> None:
    """Some modes last for one cycle."""
    records = recording.records.copy()
    for row in changed:
        records["mode"][row] = MODES.index(Mode.ENABLING)
    rows = [row for row, mode in enumerate(records["mode"]) if not row or mode != records["mode"][row - 1]]
    made = list(mcap.messages(recording._replace(records=records), config.geometry(load(SIM).geometry), every))
    statuses = [(wall, message.status[0]) for wall, topic, message in made if topic == "/diagnostics"]
    walls = recording.wall.astype(np.int64)
    assert [(wall, status.message) for wall, status in statuses if status.name == "trirail: mode"] == [
        (walls[row], MODES[records["mode"][row]]) for row in rows
    ]
    kept = recording.part(every=every).wall.astype(np.int64).tolist()
    assert [wall for wall, topic, _ in made if topic == "/pose"] == kept


def test_velocities_are_those_of_the_positions(recording: Recording) -> None:
    settings = load(SIM)
    records = made.records(0.5)
    records["position"], records["pose"] = records["commanded_position"], records["commanded_pose"]
    records["velocity"], records["backlash"] = records["commanded_velocity"], 0.0
    positions, velocities = mcap.joint_motion(records, config.geometry(settings.geometry))
    slopes = np.gradient(positions, 1.0 / made.RATE_HZ, axis=0)
    np.testing.assert_allclose(velocities[1:-1], slopes[1:-1], atol=1e-4)


@pytest.mark.generated(*range(4))
@pytest.mark.parametrize("name", ["sim", "uvw", "uvw-ppr", "xxy"])
def test_the_legs_of_a_robot_with_a_map_meet_in_every_record(name: str, seed: int) -> None:
    settings, rng = load(SIM.with_name(f"{name}.toml")), np.random.default_rng(seed)
    geometry, platform = config.geometry(settings.geometry), settings.limits.platform
    low, high = np.transpose([platform.x, platform.y, platform.phi])
    nodes = rng.uniform(-1.0, 1.0, (4, 4, 4, 3)) * (1e-4, 1e-4, 1e-3)
    corrected = dataclasses.replace(geometry, correction=Correction(tuple(low), tuple(high), nodes))
    path = np.linspace(0.1, -0.2, 200)[:, None] * np.where(rng.uniform(size=3) > 0.5, high, low)
    step = 1.0 / made.RATE_HZ
    motion = inverse(corrected, path, np.gradient(path, step, axis=0))
    records = np.zeros(len(path), DTYPE)
    records["pose"], records["position"], records["velocity"] = path, motion.position, motion.velocity
    positions, velocities = mcap.joint_motion(records, corrected)
    np.testing.assert_allclose(positions[:, 6:], motion.passive_position, atol=1e-9)
    np.testing.assert_allclose(velocities[1:-1], np.gradient(positions, step, axis=0)[1:-1], atol=1e-4)
    robot = yourdfpy.URDF.load(io.StringIO(document("robot", geometry, settings.limits)), load_meshes=False)
    for joints in positions[::50]:
        robot.update_cfg(dict(zip(mcap.JOINTS, joints, strict=True)))
        platforms = [robot.get_transform(link, "base") for link in ("platform", "centre_b", "centre_c")]
        np.testing.assert_allclose(platforms[1:], [platforms[0]] * 2, atol=1e-9)


def test_a_map_in_the_recorded_configuration_is_used(recording: Recording, tmp_path: Path) -> None:
    plain = load(SIM)
    platform = plain.limits.platform
    nodes = np.full((4, 4, 4, 3), (1e-3, -5e-4, 0.0))
    low, high = np.transpose([platform.x, platform.y, platform.phi]).tolist()
    errors = as_built.measured_today(Correction(low, high, nodes), config.geometry(plain.geometry))
    changed = msgspec.structs.replace(plain, correction=msgspec.structs.replace(plain.correction, as_built=errors))
    text = provenance.toml(changed)
    found = recording._replace(texts={**recording.texts, provenance.CONFIGURATION: text})
    mcap.write(found, tmp_path / "map.mcap")
    joints = [message.position for _, message in by_mcap(tmp_path / "map.mcap")["/joint_states"]]
    geometry = config.corrected_geometry(changed)
    np.testing.assert_array_equal(joints, mcap.joint_motion(recording.records, geometry)[0])
    assert np.abs(joints - mcap.joint_motion(recording.records, config.geometry(plain.geometry))[0]).max() > 1e-4


def test_a_file_is_never_written_over(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "session.mcap"
    path.write_text("mine")
    with pytest.raises(ServiceError, match="already exists: choose another file"):
        mcap.write(recording, path)
    assert path.read_text() == "mine"
    with pytest.raises(ServiceError, match="needs the configuration"):
        mcap.write(recording._replace(texts={}), tmp_path / "other.mcap")
    with pytest.raises(TrirailError, match=r"must end in \.mcap"):
        recording_commands.export(path, out=tmp_path / "a.csv", format="mcap")
    with pytest.raises(TrirailError, match="--columns"):
        recording_commands.export(path, columns="pose", format="mcap")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_joints_of_a_pose_bring_every_leg_to_the_platform(path: Path) -> None:
    settings = load(path)
    geometry = config.geometry(settings.geometry)
    robot = yourdfpy.URDF.load(io.StringIO(document("robot", geometry, settings.limits)), load_meshes=False)
    assert robot.validate()
    assert set(robot.actuated_joint_names) == set(mcap.JOINTS)
    low, high = np.array([settings.limits.platform.x, settings.limits.platform.y, settings.limits.platform.phi]).T
    for share in (0.0, 0.3, -0.2):
        x, y, phi = share * np.where(share > 0.0, high, -low)
        motion = inverse(geometry, (x, y, phi))
        angles = dict(zip(mcap.JOINTS, [*motion.position, phi, phi, phi, *motion.passive_position], strict=True))
        robot.update_cfg(angles)
        c, s = math.cos(phi), math.sin(phi)
        wanted = [[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        for link in ("platform", "centre_b", "centre_c"):
            np.testing.assert_allclose(robot.get_transform(link, "base"), wanted, atol=1e-12)


def test_urdf_goes_to_a_file_or_to_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "robot.urdf"
    assert recording_commands.urdf(out=path) == 0
    assert recording_commands.urdf() == 0
    assert capsys.readouterr().out.endswith(path.read_text(encoding="utf-8"))
    with pytest.raises(ServiceError, match="already exists"):
        recording_commands.urdf(out=path)


@pytest.mark.long
def test_the_memory_of_an_export_does_not_grow_with_the_recording(recording: Recording) -> None:
    geometry = config.geometry(load(SIM).geometry)

    def peak(times: int) -> int:
        records, wall = np.tile(recording.records, times), np.tile(recording.wall, times)
        wall += np.arange(len(wall)) // len(recording.wall) * np.timedelta64(1, "s")
        repeated = recording._replace(records=records, wall=wall, t=np.tile(recording.t, times))
        tracemalloc.start()
        count = sum(1 for _ in mcap.messages(repeated, geometry))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert count > 4 * len(records)
        return most

    peak(1)  # what is loaded and compiled once
    assert peak(30) - peak(10) < 500 * 20 * len(recording.records)


@settings(max_examples=20)
@given(st.lists(st.integers(-2 * 10**9, 2 * 10**9), max_size=3), st.integers(1, 200))
def test_messages_are_in_order_of_time_though_the_clock_was_set(
    recording: Recording, steps: list[int], rows: int
) -> None:
    """Each message still has the time of its own record or line."""
    records, wall = recording.records[:200], recording.wall[:200].copy()
    for number, step in enumerate(steps, 1):
        wall[number * len(wall) // 4 :] += np.timedelta64(step, "ns")
    changed = recording._replace(records=records, wall=wall, t=recording.t[:200])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap, "BLOCK_ROWS", rows)
        made = list(mcap.messages(changed, config.geometry(load(SIM).geometry)))
    times = [time for time, _, _ in made]
    assert times == sorted(times)
    poses = {(time, message.pose.position.x) for time, topic, message in made if topic == "/pose"}
    assert poses == set(zip(wall.astype(np.int64).tolist(), records["pose"][:, 0].tolist(), strict=True))
    assert sum(topic == "/events" for _, topic, _ in made) == len(recording.events)
