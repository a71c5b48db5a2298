"""What is drawn, read back from the columns that Rerun is given."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import made
import msgspec
import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.chunk import Chunk
from trirail.client.path_check import find_obstacle
from trirail.config import SIM, FramesTable, Input, LegTable, Output, load
from trirail.errors import ServiceError
from trirail.kinematics.geometry import Geometry, Leg
from trirail.processes.publications import info
from trirail.telemetry.columns import Timelines
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.scene import Scene
from trirail.telemetry.streams import Streams
from trirail.wire.records import DTYPE
from trirail.wire.state import Info
from trirail.wire.vocabulary import MODES, Mode
from trirail.workspace.part_positions import RobotParts, slider_points
from trirail.workspace.reach import ANGLE_STEP_RAD, Reach
from trirail.workspace.singularity import distance_to_singularity
from trirail_drivers.interface import Triple

CONFIG = load(SIM)
WALL_OFFSET_NS = 1_700_000_000_000_000_000
GENERAL = Geometry(
    legs=(
        Leg((0.01, -0.29), 1.02, 0.17, (0.088, -0.152), 0.03),
        Leg((0.27, 0.14), 3.17, 0.175, (0.083, 0.152), 2.06),
        Leg((-0.25, 0.16), -1.08, 0.172, (-0.171, 0.002), 4.21),
    )
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(DrawnRobot.from_config(CONFIG), WALL_OFFSET_NS)


def by_entity(chunks: list[Chunk]) -> dict[str, Chunk]:
    found = {chunk.entity_path: chunk for chunk in chunks}
    assert len(found) == len(chunks)
    return found


def values(chunk: Chunk, component: str) -> NDArray[Any]:
    """Return a component's values, (rows, …)."""
    return np.array(chunk.to_record_batch().column(component).to_pylist())


def test_every_field_of_every_record_is_kept_as_it_was(scene: Scene) -> None:
    records = made.records(0.2)
    (chunk,) = scene.complete(records)
    batch = chunk.to_record_batch()
    fields = batch.column("fields").flatten()
    for name in DTYPE.names or ():
        column = fields.field(name)
        flat = column.flatten() if records[name].ndim > 1 else column
        assert np.array_equal(flat.to_numpy().reshape(records[name].shape), records[name]), name
    steps = np.diff(batch.column("t").to_numpy()).astype(int)
    assert np.all(steps == 1_000_000)
    wall = batch.column("wall").to_numpy().astype(int)
    assert np.array_equal(wall, records["deadline_ns"] + WALL_OFFSET_NS)


def test_times_go_on_beyond_what_a_product_with_nanoseconds_can_hold() -> None:
    """The cycles of 107 days at 1 kHz, times 1e9, exceed 64 bits."""
    records = made.records(0.003)
    records["cycle"] += 2**63 // 10**9 - 1
    t = Timelines(1000, 0).for_records(records)["t"].to_numpy().astype(int)
    assert t.tolist() == [cycle * 1_000_000 for cycle in records["cycle"].tolist()]


@pytest.mark.parametrize("geometry", [Geometry.symmetric(0.3), GENERAL], ids=["symmetric", "general"])
def test_sliders_are_drawn_on_their_rail_and_on_their_edge(geometry: Geometry) -> None:
    records = made.records(5.0, geometry)
    records["pose"], records["position"] = records["commanded_pose"], records["commanded_position"]
    parts = RobotParts.from_geometry(geometry, CONFIG.limits.slider)
    config = _with_geometry(geometry)
    drawn = by_entity(Scene(DrawnRobot.from_config(config), 0).drawn(records, ReadoutState()))

    points = values(drawn["/robot/sliders"], "Points2D:positions")
    centre = values(drawn["/robot/platform"], "Transform3D:translation")[:, 0, :2]
    _, _, z, w = values(drawn["/robot/platform"], "Transform3D:quaternion")[:, 0].T
    assert len(points) == 500
    c, s = w * w - z * z, 2.0 * w * z
    turned = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    corners = centre[:, None] + np.einsum("nij,kj->nki", turned, parts.outline[0])
    for k in range(3):
        at = points[:, k]
        assert np.array_equal(at, points[:, 3 + k])  # its pin
        assert np.abs(_beside(at, *np.broadcast_to(parts.rails[k][:, None], (2, *at.shape)))).max() < 1e-6
        edges = [np.abs(_beside(at, corners[:, j], corners[:, j + 1])).max() for j in range(3)]
        assert min(edges) < 1e-6
        assert sorted(edges)[1] > 1e-2


def test_the_symmetric_robot_is_two_equal_triangles() -> None:
    parts = RobotParts.from_geometry(Geometry.symmetric(0.3), CONFIG.limits.slider)
    (outline,) = parts.outline
    sides = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    assert sides == pytest.approx([math.sqrt(3.0) * 0.3] * 3)
    assert np.array_equal(outline[0], outline[3])
    assert outline[:3].mean(axis=0) == pytest.approx([0.0, 0.0])
    for low, high in zip(parts.travel, parts.rails, strict=True):
        assert np.linalg.norm(low[1] - low[0]) == pytest.approx(0.51)
        assert np.linalg.norm(high[0] - low[0]) == pytest.approx(np.linalg.norm(high[1] - low[1]))


def test_a_platform_with_parallel_edges_is_drawn_as_its_edges() -> None:
    legs = GENERAL.legs
    parallel = Geometry(legs=(legs[0], legs[1], Leg((-0.25, 0.16), -1.08, 0.172, (-0.171, 0.002), 0.03)))
    parts = RobotParts.from_geometry(parallel, CONFIG.limits.slider)
    assert [len(edge) for edge in parts.outline] == [2, 2, 2, 5]  # with the table over them
    assert [len(arm) for arm in parts.arms] == [2, 2, 2]


def test_sliders_follow_their_rails() -> None:
    at = slider_points(Geometry.symmetric(0.3), np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    assert at[1, 0] - at[0, 0] == pytest.approx([0.05, 0.1 * math.sqrt(3.0) / 2.0])
    assert np.array_equal(at[1, 1:], at[0, 1:])


def test_curves_are_in_the_units_of_people(scene: Scene) -> None:
    records = made.records(0.5)
    slider = CONFIG.limits.slider
    records["position"][9] = *slider.positions[0], 0.0
    drawn = by_entity(scene.drawn(records, ReadoutState()))
    newest = records[9::10]
    position = values(drawn["/sliders/position"], "Scalars:scalars")
    assert position[:, :3] == pytest.approx(newest["position"] * 1e3)
    assert np.all(position[:, 3:] == [slider.positions[0][0] * 1e3, slider.positions[0][1] * 1e3])
    phi = values(drawn["/pose/phi"], "Scalars:scalars")
    assert phi[:, 0] == pytest.approx(np.degrees(newest["pose"][:, 2]))
    t = drawn["/pose/phi"].to_record_batch().column("t").to_numpy().astype(int)
    assert np.array_equal(t, newest["cycle"] * 1_000_000)


def test_sliders_are_drawn_without_the_backlash_compensation(scene: Scene) -> None:
    """It is in the positions of the drives. The carriages are where the readout and the published state have them."""
    records = made.records(0.5)
    compensated = records.copy()
    compensated["backlash"] = np.where(records["velocity"] > 0.0, 1e-3, -1e-3)
    compensated["position"] += compensated["backlash"]
    alone, other = (by_entity(scene.drawn(each, ReadoutState())) for each in (records, compensated))
    for path, component in (("/sliders/position", "Scalars:scalars"), ("/robot/sliders", "Points2D:positions")):
        assert values(other[path], component) == pytest.approx(values(alone[path], component), abs=1e-6, nan_ok=True), (
            path
        )


@pytest.mark.parametrize("backlash", [(0.0, 0.0, 0.0), (1e-3, 0.0, 2e-4)])
@pytest.mark.parametrize("phi", [-1.0, 0.0, 0.7])
def test_the_outline_encloses_the_centres_that_the_service_accepts(backlash: Triple, phi: float) -> None:
    robot = dataclasses.replace(DrawnRobot.from_config(CONFIG), backlash=backlash)
    records = made.records(0.1)
    records["pose"][:, 2] = phi = ANGLE_STEP_RAD * round(phi / ANGLE_STEP_RAD)
    drawn = by_entity(Scene(robot, WALL_OFFSET_NS).drawn(records, ReadoutState()))["/robot/workspace"]
    corners = values(drawn, "LineStrips2D:strips")[0, 0, :-1]
    middle = corners.mean(axis=0)
    for corner in corners:
        for beyond in (-1e-5, 1e-5):
            x, y = (corner + beyond * (corner - middle) / np.linalg.norm(corner - middle)).tolist()
            assert (find_obstacle(robot, (*middle, phi), (x, y, phi), None, "base") is None) is (beyond < 0.0)


def test_a_position_that_is_not_known_is_not_drawn(scene: Scene) -> None:
    records = made.records(0.2)
    records["homed"][:100, 1] = 0
    drawn = by_entity(scene.drawn(records, ReadoutState()))

    def shown(path: str, component: str) -> NDArray[Any]:
        known: NDArray[np.bool_] = np.isfinite(values(drawn[path], component))
        return known

    position = shown("/sliders/position", "Scalars:scalars")[:, :3]
    assert position[:10].tolist() == [[True, False, True]] * 10
    assert position[10:].all()
    assert shown("/robot/sliders", "Points2D:positions")[:10, :3, 0].tolist() == [[True, False, True]] * 10
    for path, component in (
        ("/pose/centre", "Scalars:scalars"),
        ("/pose/phi", "Scalars:scalars"),
        ("/pose/singularity", "Scalars:scalars"),
        ("/robot/platform", "Transform3D:translation"),
        ("/robot/commanded", "Transform3D:translation"),
        ("/robot/trace", "LineStrips2D:strips"),
    ):
        first = shown(path, component).reshape(20, -1)[:, 0]
        assert first.tolist() == [False] * 10 + [True] * 10, path
    assert shown("/robot/platform", "Transform3D:quaternion").all()  # an invalid one would place it at the origin


def test_no_spike_is_lost_to_thinning(scene: Scene) -> None:
    records = made.records(0.5)
    records["following_error"][123] = [-2e-3, 1e-3, 0.0]
    records["lateness_ns"][271] = 5_000_000
    drawn = by_entity(scene.drawn(records, ReadoutState()))
    error = values(drawn["/sliders/following_error"], "Scalars:scalars")
    assert error[12, :2] == pytest.approx([-2000.0, 1000.0])
    timing = values(drawn["/loop/timing"], "Scalars:scalars")
    assert timing[27, [1, 3]] == pytest.approx([5000.0, 1000.0])  # with the period


@pytest.mark.parametrize("apart", [False, True])
def test_a_gap_in_the_cycles_is_a_gap_in_time_and_in_the_curves(scene: Scene, apart: bool) -> None:
    """Whether the cycles are missing within a batch or between two."""
    streams, batches = Streams(DrawnRobot.from_config(CONFIG), "x", WALL_OFFSET_NS), list[Chunk]()

    class Kept:
        def write_chunks(self, chunks: list[Chunk]) -> None:
            batches.extend(chunks)

    streams.attach(Kept(), 1000 if apart else 5)
    records = made.records(0.1)
    for part in (records[:33], records[58:]):
        streams.records(part.tobytes())
    streams.flush()

    def drawn(path: str, component: str) -> dict[int, bool]:
        """Whether there is a value, by time [ms]."""
        of = [each for each in batches if each.entity_path == path]
        t = np.concatenate([each.to_record_batch().column("t").to_numpy().astype(int) // 1_000_000 for each in of])
        known = np.concatenate([np.isfinite(values(each, component)).reshape(each.num_rows, -1)[:, 0] for each in of])
        return dict(zip(t.tolist(), known.tolist(), strict=True))

    at = dict.fromkeys([9, 19, 29, 32, 59, 69, 79, 89, 99], True)
    assert drawn("/robot/platform", "Transform3D:translation") == at
    for path in ("/pose/phi", "/loop/timing"):
        assert drawn(path, "Scalars:scalars") == at | {33: False}


def test_modes_are_said_when_they_change_and_at_the_start_of_a_batch(scene: Scene) -> None:
    records = made.records(0.1)
    records["mode"][40:] = MODES.index(Mode.STOPPING)
    mode = by_entity(scene.drawn(records, ReadoutState()))["/mode"]
    assert values(mode, "StateChange:state").tolist() == [["moving"], ["stopping"]]
    t = mode.to_record_batch().column("t").to_numpy().astype(int)
    assert np.array_equal(t, [0, 40_000_000])


@pytest.mark.parametrize("fault_at", [0, 40])
def test_the_readout_is_that_of_a_mode_from_its_first_cycle_on(scene: Scene, fault_at: int) -> None:
    """A file has one batch of drawings per second, and a fault in its middle must not be shown as a motion."""
    before, records = np.split(made.records(0.2), [100])
    records["mode"][fault_at:] = MODES.index(Mode.FAULT)
    shown = by_entity(scene.drawn(records, ReadoutState(fault="drive B: silent"), before[-1]))["/readout"]
    t = shown.to_record_batch().column("t").to_numpy().astype(int)
    assert np.array_equal(t // 1_000_000, [100 + fault_at, 199])
    assert all("**FAULT**" in text for text in values(shown, "TextDocument:text")[:, 0])


def test_what_is_still_is_there_once(scene: Scene) -> None:
    paths = [path for path, _ in scene.still()]
    assert len(set(paths)) == len(paths)
    assert {"/robot", "/robot/rails", "/robot/platform/outline", "/sliders/position", "/mode"} <= set(paths)


def _with_geometry(geometry: Geometry) -> Any:
    legs = tuple(LegTable(**{name: getattr(leg, name) for name in Leg.__slots__}) for leg in geometry.legs)
    table = msgspec.structs.replace(CONFIG.geometry, l0=None, leg=legs)
    return msgspec.structs.replace(CONFIG, geometry=table)


def _beside(points: NDArray[Any], start: NDArray[Any], end: NDArray[Any]) -> NDArray[Any]:
    """Return how far points lie from the lines through `start` and `end`, all (N, 2)."""
    along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    off = points - start
    distance: NDArray[Any] = along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]
    return distance


def test_the_goal_is_drawn_where_it_leads_and_not_without_one(scene: Scene) -> None:
    record = made.records(0.1)[-1]
    (chunk,) = scene.goal(record, (0.03, -0.02, 0.4))
    (lines,) = chunk.to_record_batch().column("LineStrips2D:strips").to_pylist()
    outline = np.array(lines[0])
    assert outline[:3].mean(axis=0) == pytest.approx([0.03, -0.02], abs=1e-6)
    (home,) = RobotParts.from_geometry(Geometry.symmetric(0.3), CONFIG.limits.slider).outline
    assert math.dist(outline[0], (0.03, -0.02)) == pytest.approx(math.dist(home[0], (0.0, 0.0)), abs=1e-6)
    turned = np.arctan2(*(outline[0] - [0.03, -0.02])[::-1]) - np.arctan2(*home[0][::-1])
    assert math.remainder(turned, math.tau) == pytest.approx(0.4, abs=1e-5)
    (none,) = scene.goal(record, None)
    assert none.to_record_batch().column("LineStrips2D:strips").to_pylist() == [[]]


def test_the_distance_to_singularity_is_that_of_the_mathematics() -> None:
    for geometry, tolerance in ((Geometry.symmetric(0.3), 1e-9), (GENERAL, math.radians(1.5))):
        poses = made.records(5.0)["commanded_pose"][::10]
        found = Reach(geometry, CONFIG.limits).singularity_distance(poses)
        assert found == pytest.approx(np.abs(distance_to_singularity(geometry, poses)), abs=tolerance)


def test_limits_of_the_following_error_come_into_view_with_it(scene: Scene) -> None:
    records = made.records(0.1)
    limits = values(by_entity(scene.drawn(records, ReadoutState()))["/sliders/following_error"], "Scalars:scalars")[
        :, 3:
    ]
    assert np.isnan(limits.astype(float)).all()
    records["following_error"][50, 1] = 3.5e-3
    limits = values(by_entity(scene.drawn(records, ReadoutState()))["/sliders/following_error"], "Scalars:scalars")[
        :, 3:
    ]
    assert np.isnan(limits[:, 0].astype(float)).all()
    assert np.all(limits[:, 1] == 4000.0)


def test_a_robot_is_the_same_by_its_configuration_and_by_its_services_words() -> None:
    answered = msgspec.json.decode(msgspec.json.encode(info(CONFIG)), type=Info)
    told, configured = DrawnRobot.from_info(answered), DrawnRobot.from_config(CONFIG)
    assert (told.name, told.limits, told.rate_hz) == (configured.name, configured.limits, configured.rate_hz)
    assert told.geometry.legs == configured.geometry.legs


@pytest.mark.parametrize(
    "differs", [{"limits": {"platform": {}}}, {"geometry": ()}, {"mechanism": "stewart"}, {"frames": {"tool": 7}}]
)
def test_a_service_of_another_version_is_no_programming_error(differs: dict[str, Any]) -> None:
    """Its robot cannot be drawn, in `trirail view --records` either, and that is told in one line."""
    told = msgspec.structs.replace(info(CONFIG), **differs)
    with pytest.raises(ServiceError, match=f"another version, {told.version}: "):
        DrawnRobot.from_info(told)


def test_tools_and_work_frames_are_drawn_with_their_names_as_a_service_tells_them() -> None:
    frames = FramesTable(tool={"camera": (0.03, -0.02)}, work={"part": (0.05, 0.01, math.pi / 2.0)})
    told = msgspec.json.decode(msgspec.json.encode(info(msgspec.structs.replace(CONFIG, frames=frames))), type=Info)
    drawn = dict(Scene(DrawnRobot.from_info(told), WALL_OFFSET_NS).still())
    tools, part = drawn["/robot/platform/tools"], drawn["/robot/frames/part"]
    assert isinstance(tools, rr.Points2D)
    assert isinstance(part, rr.LineStrips2D)
    assert tools.positions is not None
    assert tools.labels is not None
    assert tools.positions.as_arrow_array().to_pylist() == [pytest.approx((0.03, -0.02))]
    assert tools.labels.as_arrow_array().to_pylist() == ["camera"]
    assert part.strips is not None
    (x, y) = np.array(part.strips.as_arrow_array().to_pylist())
    assert [x[0], y[0]] == [pytest.approx((0.05, 0.01))] * 2
    assert (x[1] - x[0])[0] == pytest.approx(0.0, abs=1e-6)
    assert (x[1] - x[0])[1] > 0.0
    assert (y[1] - y[0])[0] < 0.0


def test_outputs_and_inputs_are_drawn_where_they_change() -> None:
    config = msgspec.structs.replace(
        CONFIG, outputs={"valve": Output("A", 16), "lamp": Output("A", 17)}, inputs={"part": Input("C", 20)}
    )
    records = made.records(0.2)
    on = np.arange(len(records)) % 40 >= 25
    records["outputs"], records["inputs"] = 1 << 18, 1 << 21  # bits that nobody has named
    records["outputs"][:, 0] |= np.where(on, 1 << 16, 0).astype(np.uint32)
    records["inputs"][:, 2] |= np.where(on, 0, 1 << 20).astype(np.uint32)
    for robot in (DrawnRobot.from_config(config), DrawnRobot.from_info(info(config))):
        drawn = by_entity(Scene(robot, 0).drawn(records, ReadoutState()))
        valve = drawn["/signals/outputs/valve"].to_record_batch()
        changes = np.flatnonzero(np.diff(on, prepend=not on[0]))
        assert valve.column("t").to_numpy().astype(int).tolist() == (records["cycle"][changes] * 1_000_000).tolist()
        levels = valve.column("StateChange:state").to_pylist()
        assert levels == [["on" if each else "off"] for each in on[changes]]
        part = drawn["/signals/inputs/part"].to_record_batch().column("StateChange:state").to_pylist()
        assert part == [["off" if level == ["on"] else "on"] for level in levels]
        assert drawn["/signals/outputs/lamp"].to_record_batch().column("StateChange:state").to_pylist() == [["off"]]
        still = dict(Scene(robot, 0).still())
        assert {path for path in still if path.startswith("/signals")} == {
            path for path in drawn if path.startswith("/signals")
        }
