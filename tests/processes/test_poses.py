"""Named poses in the gateway: what is taught, when it is answered, and what a goal of a name becomes."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import random
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
from conftest import Rig
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused_as, uncoded
from trirail.config import Config, LegTable, corrected_geometry, geometry, parse
from trirail.config.as_built import AsBuilt, geometry_of
from trirail.errors import ConfigError, RefusalCode, RefusedError, ServiceError
from trirail.kinematics.geometry import Geometry, travels
from trirail.kinematics.robot import inverse
from trirail.motion.limits import Bounds
from trirail.processes import poses
from trirail.processes.gateway import ROUTES
from trirail.processes.incoming import Incoming
from trirail.processes.pose_file import NAME, PoseFile, state_directory
from trirail.processes.poses import CHECK_PERIOD_S, MAX_CHANGES_UNDER_WAY, MAX_TAUGHT_POSES, Poses
from trirail.telemetry.provenance import toml
from trirail.wire.goals import NamedGoal, OwnLimits, PoseGoal
from trirail.wire.messages import ErrorReply, Notice
from trirail.wire.packets import Announcement, Refused
from trirail.wire.records import DTYPE
from trirail.wire.state import NamedPose
from trirail.wire.vocabulary import MODES, Mode

POSE = (0.02, -0.01, 0.1)
GEOMETRY = geometry(CONFIG.geometry)
ABSENT = {errno.ENOENT, errno.ENOTDIR, errno.EBADF, errno.ELOOP}
"""Errors that say, as pathlib sees it, that there is no file."""
PARKED = msgspec.structs.replace(CONFIG, poses={"park": (0.0, 0.05, 0.0)})


def record(
    pose: tuple[float, float, float] = POSE, mode: Mode = Mode.HOLDING, homed: int = 1, robot: Geometry = GEOMETRY
) -> np.void:
    made = np.zeros(1, DTYPE)[0]
    made["mode"], made["homed"] = MODES.index(mode), homed
    made["pose"], made["position"] = pose, inverse(robot, pose).position
    return made  # type: ignore[no-any-return]


class Asked:
    """The gateway around the poses: asks as ann, keeps answers, refusals and what everyone is told."""

    def __init__(self, config: Config, *, again: bool = False) -> None:
        self.replies: list[NamedPose] = []
        self.refusals: list[RefusedError] = []
        self.told: list[Notice] = []
        self.now = 0.0
        self.woken = threading.Event()
        self.poses = Poses(
            config, self._reply, self._refuse, self.told.append, self.woken.set, lambda: self.now, again=again
        )

    def _reply(self, incoming: Incoming, reply: msgspec.Struct) -> None:
        if isinstance(reply, ErrorReply):
            self.refusals.append(RefusedError(reply.code, reply.message))
        else:
            assert isinstance(reply, NamedPose)
            self.replies.append(reply)

    def _refuse(self, incoming: Incoming, refusal: RefusedError) -> None:
        self.refusals.append(refusal)

    def ask(self, kind: str, name: str, content: bytes = b"") -> None:
        key = f"trirail/demo/{kind}/ann/{name}"
        incoming = Incoming(kind, key, len(content), content, "", None, time.monotonic_ns())
        self.poses.edit(incoming, *ROUTES[kind].read(incoming, "demo").names)

    def teach(self, name: str, at: np.void | None = None) -> None:
        self.ask("teach", name)
        self.poses.measure(record() if at is None else at)
        self.write()

    def write(self) -> None:
        """Wait until what is under way has been written, and take it."""
        assert self.woken.wait(20.0)
        self.woken.clear()
        self.poses.settle()

    def look(self) -> None:
        """Let the file be checked, and take what was found."""
        self.poses.poll()
        self.write()

    def known(self) -> dict[str, tuple[float, float, float]]:
        return {pose.name: (pose.x, pose.y, pose.phi) for pose in self.poses.table().poses}


Make = Callable[..., Asked]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    made: list[Asked] = []

    def ask(config: Config, *, again: bool = False) -> Asked:
        made.append(Asked(config, again=again))
        return made[-1]

    yield ask
    for each in made:
        each.poses.close()


def test_a_pose_that_was_taught_with_another_geometry_is_flagged_until_it_is_taught_again(make: Make) -> None:
    make(CONFIG).teach("pick")
    leg_a, *others = GEOMETRY.legs
    turned = dataclasses.replace(leg_a, rail_angle=leg_a.rail_angle + 1e-6)
    legs = [LegTable(**leg.keys()) for leg in (turned, *others)]
    table = msgspec.structs.replace(CONFIG.geometry, l0=None, leg=tuple(legs))
    calibrated = make(msgspec.structs.replace(CONFIG, geometry=table))
    calibrated.teach("place")
    flags = {pose.name: pose.other_geometry for pose in calibrated.poses.table().poses}
    assert flags == {"pick": True, "place": False}
    assert ["pick" in line and "place" not in line for line in calibrated.poses.warnings()] == [True]
    calibrated.teach("pick")
    assert not any(pose.other_geometry for pose in calibrated.poses.table().poses)
    assert calibrated.poses.warnings() == ()


def with_map(x: float, made: str = "2026-05-01") -> Config:
    """Return a configuration with a correction of x, the same everywhere."""
    limits = CONFIG.limits.platform
    low, high = zip(*(limits.x, limits.y, limits.phi), strict=True)
    nodes = np.full((4, 4, 4, 3), (x, 0.0, 0.0)).tolist()
    errors = AsBuilt(made, geometry_of(GEOMETRY), low, high, nodes)
    return msgspec.structs.replace(CONFIG, correction=msgspec.structs.replace(CONFIG.correction, as_built=errors))


@pytest.mark.parametrize(
    ("before", "after", "is_other"),
    [
        (CONFIG, with_map(0.002), True),
        (with_map(0.002), CONFIG, True),
        (with_map(0.002), with_map(0.001), True),
        (with_map(0.002), with_map(0.002, "2026-06-01"), False),
    ],
)
def test_a_pose_that_was_taught_with_another_map_is_flagged(
    make: Make, before: Config, after: Config, is_other: bool
) -> None:
    make(before).teach("pick", record(robot=corrected_geometry(before)))
    (pick,) = make(after).poses.table().poses
    assert pick.other_geometry == is_other
    assert [("or correction map: pick;" in line) for line in make(after).poses.warnings()] == [True] * is_other


def test_a_pose_of_a_file_that_names_only_the_geometry_was_taught_without_a_map(make: Make, tmp_path: Path) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / NAME).write_text(json.dumps({"pick": [*POSE, geometry_of(GEOMETRY)], "old": POSE}))
    assert {pose.name: pose.other_geometry for pose in make(CONFIG).poses.table().poses} == {
        "pick": False,
        "old": False,
    }
    flags = {pose.name: pose.other_geometry for pose in make(with_map(0.002)).poses.table().poses}
    assert flags == {"pick": True, "old": False}


def test_a_pose_is_taught_where_the_next_record_has_the_robot_and_kept(make: Make) -> None:
    asked = make(CONFIG)
    asked.ask("teach", "pick")
    assert not asked.replies
    asked.poses.measure(record())
    asked.write()
    assert asked.replies == [NamedPose("pick", *POSE, taught=True)]
    assert uncoded(asked.told) == [
        Notice("pose", "info", "pose pick taught by ann: x 20 mm, y -10 mm, phi 5.7296°", user="ann")
    ]
    assert asked.known() == make(CONFIG).known() == {"pick": POSE}
    asked.teach("pick", record((0.0, 0.0, 0.0), Mode.DISABLED))
    assert asked.known() == {"pick": (0.0, 0.0, 0.0)}
    asked.ask("forget", "pick")
    asked.write()
    assert asked.replies[-1] == NamedPose("pick", 0.0, 0.0, 0.0, taught=True)
    assert uncoded(asked.told[-1:]) == [Notice("pose", "info", "pose pick removed by ann", user="ann")]
    assert asked.known() == make(CONFIG).known() == {}


@given(acts=st.lists(st.sampled_from(["teach a", "teach b", "forget a", "delete", "look", "restart"]), max_size=12))
def test_poses_whose_file_goes_are_neither_silently_kept_nor_lost(acts: list[str]) -> None:
    """Whenever it goes, everyone is told, once; while the service lasts nothing is lost, and it is written again."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", folder)
        asked, file = Asked(CONFIG), Path(folder) / CONFIG.robot.name / NAME
        known: set[str] = set()
        gone = False
        for act in acts:
            match act.split():
                case ["teach", name]:
                    asked.teach(name)
                    known, gone = known | {name}, False
                case ["forget", name] if name in known:
                    asked.ask("forget", name)
                    asked.write()
                    known, gone = known - {name}, False
                case ["delete"]:
                    gone = gone or file.exists()
                    file.unlink(missing_ok=True)
                case ["restart"]:
                    asked.poses.close()
                    asked = Asked(CONFIG)
                    known = set() if gone else known
            for _ in range(2):
                asked.now += CHECK_PERIOD_S
                before = [said for said in asked.told if said.kind == "service"]
                was_told = bool(asked.poses.warnings())
                asked.look()
                told = [said for said in asked.told if said.kind == "service"][len(before) :]
                assert len(told) == (gone and not was_told)
                assert bool(asked.poses.warnings()) is gone
                assert all(name in words for name in known for words in asked.poses.warnings())
            assert set(asked.known()) == known
            if not gone and file.exists():
                assert set(json.loads(file.read_text())) == known
        asked.poses.close()


@given(number=st.sampled_from(sorted(errno.errorcode.keys() - ABSENT)))
def test_a_folder_that_cannot_be_read_ends_neither_the_gateway_nor_the_answers(number: int) -> None:
    """A network home answers EIO or ESTALE while it is away, and a changed mode EACCES."""

    def fails(path: Path, **_: object) -> os.stat_result:
        raise OSError(number, os.strerror(number), str(path))

    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", folder)
        asked = Asked(CONFIG)
        asked.teach("a")
        with pytest.MonkeyPatch.context() as away:
            away.setattr(Path, "stat", fails)
            asked.look()
            asked.ask("forget", "a")
            asked.write()
        assert asked.poses.warnings() == (), "nobody knows that the file is gone"
        assert len(asked.replies) + len(asked.refusals) == 2, "each request is answered"
        asked.poses.close()


def test_a_folder_that_does_not_answer_holds_nobody_up(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, answers, stat = make(CONFIG), threading.Event(), Path.stat

    def slowly(path: Path, **how: bool) -> os.stat_result:
        assert answers.wait(20.0)
        return stat(path, **how)

    monkeypatch.setattr(Path, "stat", slowly)
    for asked.now in (10.0, 20.0, 30.0):
        asked.poses.poll()
        asked.poses.settle()
    answers.set()
    asked.write()
    asked.now += CHECK_PERIOD_S
    asked.look()


@pytest.mark.parametrize("step", ["mkstemp", "fsync", "replace"])
def test_a_first_pose_that_cannot_be_written_is_refused_and_nothing_counts_as_lost(
    make: Make, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Neither now nor after a restart: no file of poses has ever been there."""
    asked, full = make(CONFIG), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with monkeypatch.context() as patched:
        patched.setattr(tempfile if step == "mkstemp" else os, step, Mock(side_effect=full))
        asked.teach("pick")
    assert [refusal.code for refusal in asked.refusals] == [RefusalCode.FAILED]
    for each in (asked, make(CONFIG)):
        each.now += CHECK_PERIOD_S
        each.look()
        assert (each.told, each.poses.warnings()) == ([], ())
    asked.teach("pick")
    assert make(CONFIG).known() == {"pick": POSE}


def test_it_is_answered_told_and_known_only_when_it_is_on_the_disk(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing waits for the disk meanwhile: it may take longer than the loop waits for the gateway."""
    asked, slow = make(CONFIG), threading.Event()
    change = PoseFile.change

    def slowly(file: PoseFile, *arguments: Any) -> None:
        assert slow.wait(20.0)
        change(file, *arguments)

    monkeypatch.setattr(PoseFile, "change", slowly)
    asked.ask("teach", "pick")
    asked.poses.measure(record())
    asked.poses.settle()
    assert (asked.replies, asked.told, asked.known()) == ([], [], {})
    slow.set()
    asked.write()
    assert asked.known() == {"pick": POSE}


def test_a_disk_that_takes_nothing_is_told_and_the_pose_stays_what_it_was(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = make(CONFIG)
    asked.teach("pick")

    def full(*_: object) -> None:
        raise ServiceError("poses.json: No space left on device")

    monkeypatch.setattr(PoseFile, "change", full)
    asked.teach("pick", record((0.0, 0.0, 0.0)))
    (refusal,) = asked.refusals
    assert refusal.code is RefusalCode.FAILED
    assert str(refusal) == "pose pick is unchanged: poses.json: No space left on device"
    assert asked.known() == {"pick": POSE}


def test_the_end_of_the_gateway_answers_what_is_under_way(make: Make) -> None:
    asked = make(CONFIG)
    asked.ask("teach", "pick")
    asked.poses.measure(record())
    asked.ask("teach", "late")
    asked.poses.close()
    assert [reply.name for reply in asked.replies] == ["pick"]
    assert [refusal.code for refusal in asked.refusals] == [RefusalCode.ENDED]
    assert make(CONFIG).known() == {"pick": POSE}


@pytest.mark.parametrize("mode", Mode)
def test_where_the_robot_stands_can_be_taught_with_power_and_without(make: Make, mode: Mode) -> None:
    asked = make(CONFIG)
    asked.ask("teach", "pick")
    asked.poses.measure(record(mode=mode))
    if mode in (Mode.DISABLED, Mode.HOLDING):
        asked.write()
        assert asked.known() == {"pick": POSE}
        return
    (refusal,) = asked.refusals
    assert refusal.code is (RefusalCode.FAULT if mode is Mode.FAULT else RefusalCode.MOVING)


def test_where_it_is_not_known_to_stand_it_cannot_be_taught(make: Make) -> None:
    asked = make(CONFIG)
    asked.ask("teach", "pick")
    asked.poses.measure(record(homed=0))
    asked.ask("teach", "pick")
    stale = record()
    stale["position"] += 0.01  # sliders that belong to no pose leave the last one in the record
    asked.poses.measure(stale)
    assert [refusal.code for refusal in asked.refusals] == [RefusalCode.NOT_HOMED, RefusalCode.SINGULAR]
    assert asked.known() == {}


@pytest.mark.parametrize(
    ("kind", "name", "content", "code"),
    [
        ("teach", "park", b"", RefusalCode.CONFIGURED_POSE),
        ("forget", "park", b"", RefusalCode.CONFIGURED_POSE),
        ("forget", "pick", b"", RefusalCode.UNKNOWN_POSE),
        ("teach", "a b", b"", RefusalCode.BAD_NAME),
        ("teach", "5mm", b"", RefusalCode.BAD_NAME),
        ("teach", "-10", b"", RefusalCode.BAD_NAME),
        ("teach", "p" * 65, b"", RefusalCode.BAD_NAME),
        ("teach", "\x1b[2J", b"", RefusalCode.BAD_NAME),
        ("teach", "", b"", RefusalCode.BAD_NAME),
        ("teach", "*", b"", RefusalCode.WILDCARD),
        ("teach", "a/b", b"", RefusalCode.UNKNOWN_KEY),
        ("teach", "pick", b'{"x": 0}', RefusalCode.MALFORMED),
    ],
)
def test_what_is_refused_at_once(make: Make, kind: str, name: str, content: bytes, code: RefusalCode) -> None:
    asked = make(PARKED)
    with refused_as(code):
        asked.ask(kind, name, content)
    assert asked.known() == {"park": (0.0, 0.05, 0.0)}


def test_what_is_kept_and_what_is_under_way_is_bounded(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = make(CONFIG)
    for number in range(MAX_CHANGES_UNDER_WAY):
        asked.ask("teach", f"p{number}")
    with refused_as(RefusalCode.BUSY):
        asked.ask("teach", "pick")
    monkeypatch.setattr(poses, "MAX_TAUGHT_POSES", 2)
    full = make(CONFIG)
    for name in ("a", "b", "a"):
        full.teach(name)
    with refused_as(RefusalCode.BUSY):
        full.ask("teach", "c")
    assert MAX_TAUGHT_POSES == 1000


def test_a_goal_of_a_name_is_that_pose_with_all_that_it_asks_for(make: Make) -> None:
    asked = make(PARKED)
    asked.teach("pick")
    limits = OwnLimits(velocity=(0.1, 0.1, 0.5))
    goal = NamedGoal("pick", id="g", speed=0.5, valid_for=2.0, limits=limits, blend=0.01)
    assert asked.poses.resolve_name(goal) == PoseGoal(
        *POSE, id="g", speed=0.5, valid_for=2.0, limits=limits, blend=0.01
    )
    assert asked.poses.resolve_name(NamedGoal("park")) == PoseGoal(0.0, 0.05, 0.0)
    other = PoseGoal(0.0, 0.0, 0.0)
    assert asked.poses.resolve_name(other) is other
    assert asked.poses.resolve_name(NamedGoal("pikc")) == NamedGoal("pikc")


def test_a_goal_of_a_name_that_there_is_not_ends_as_rejected_by_its_id(rig: Rig) -> None:
    rig.enable()
    answer = rig.send("g", NamedGoal("pikc", id="g"))
    assert isinstance(answer, Refused)
    assert answer.code is RefusalCode.UNKNOWN_POSE
    assert rig.outcomes() == [("g", "rejected")]


def test_a_name_that_the_configuration_takes_later_is_the_configuration_s_and_told(make: Make) -> None:
    asked = make(CONFIG)
    asked.teach("park")
    later = make(PARKED)
    assert later.known() == {"park": (0.0, 0.05, 0.0)}
    assert later.poses.warnings() == (
        "pose park is defined in [poses], and the taught pose is not used: remove it with trirail forget park",
    )
    later.ask("forget", "park")
    later.write()
    assert later.poses.warnings() == ()
    assert later.known() == {"park": (0.0, 0.05, 0.0)}


def test_what_cannot_be_read_ends_the_start(make: Make) -> None:
    folder = state_directory("demo")
    folder.mkdir()
    (folder / "poses.json").write_text('{"pick": [0.0, 0.0')
    with pytest.raises(
        ServiceError, match=r"poses\.json: .*repair the file, or move it away and teach the poses again"
    ):
        make(CONFIG)


@pytest.mark.generated(0, 1, 2)
def test_a_gateway_that_is_started_again_goes_on_without_what_cannot_be_read_and_keeps_each_such_file(
    make: Make, seed: int
) -> None:
    chance, whole = random.Random(seed), b'{"pick": [0.0, 0.0, 0.0]}'
    contents = [whole[: chance.randrange(len(whole))], b"{" + chance.randbytes(9), b'{"a b": [0, 0, 0]}', b"[" * 9999]
    contents = chance.sample(contents, 3)
    folder = state_directory("demo")
    folder.mkdir()
    for content in contents:
        (folder / "poses.json").write_bytes(content)
        later = make(PARKED, again=True)
        assert later.known() == PARKED.poses
        (warning,) = later.poses.warnings()
        assert "; no taught poses are available now; the file is kept as " in warning
        for later.now in (0.0, 100.0):
            later.look()
        assert uncoded(later.told) == [Notice("service", "warning", warning)]
        assert [told.params for told in later.told] == [{"file": str(folder / "poses.json")}]
    kept = [path for path in folder.iterdir() if path.name.startswith("poses.json.broken")]
    assert sorted(path.read_bytes() for path in kept) == sorted(contents)
    later.teach("pick")
    assert later.poses.warnings() == (), "the file has every taught pose again"
    assert make(PARKED, again=True).known().keys() == {"park", "pick"}


@pytest.mark.parametrize("code", [errno.EIO, errno.EMFILE])
def test_a_gateway_that_is_started_again_waits_for_a_file_that_the_system_cannot_read(
    make: Make, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    make(PARKED).teach("pick")
    path = state_directory("demo") / NAME
    before, opened = path.read_bytes(), open

    def fails(file: object, *arguments: Any, **more: Any) -> Any:
        if file == path:
            raise OSError(code, os.strerror(code), str(path))
        return opened(file, *arguments, **more)  # type: ignore[call-overload]

    with monkeypatch.context() as broken:
        broken.setattr("builtins.open", fails)
        later = make(PARKED, again=True)
        (warning,) = later.poses.warnings()
        assert "; no taught poses are available now; the file is read again" in warning
        later.look()
        assert later.known() == PARKED.poses
        later.teach("place")
        assert [refusal.code for refusal in later.refusals] == [RefusalCode.FAILED]
    assert path.read_bytes() == before
    later.teach("place")  # before the file is read again
    later.now = 100.0
    later.look()
    assert later.known().keys() == {"park", "pick", "place"}
    assert later.poses.warnings() == ()
    assert make(PARKED).known().keys() == {"park", "pick", "place"}


def test_a_change_is_told_to_everyone(rig: Rig) -> None:
    rig.cycle(Announcement(Notice("pose", "info", "pose pick removed by ann", user="ann")))
    (notice,) = [notice for notice in rig.notices if notice.kind == "pose"]
    assert (notice.level, notice.user, notice.message) == ("info", "ann", "pose pick removed by ann")


# ---------------------------------------------------------------------- those of the configuration

numbers = st.floats(-0.4, 0.4)
TEXT = toml(CONFIG).replace("[poses]\n", "")


@given(pose=st.tuples(numbers, numbers, st.floats(-1.5, 1.2)))
def test_a_configured_pose_is_refused_where_the_robot_could_not_be_and_only_there(
    pose: tuple[float, float, float],
) -> None:
    """What a start refuses is what a goal to it would be refused for: what the gate before the drives knows."""
    try:
        parse(f"{TEXT}\n[poses]\npark = {list(pose)}\n")
        refused = ""
    except ConfigError as error:
        refused = str(error)
    bounds = Bounds(CONFIG.limits, CONFIG.period)
    found = bounds.pose_violation(pose)
    if found is None:
        motion = inverse(GEOMETRY, pose)
        still = np.zeros(3)
        found = bounds.setpoint_violation(np.array([motion.position, still, still, motion.passive_position]))
    assert refused.startswith("poses.park = [") == (found is not None), found
    assert bool(refused) == (found is not None)


@given(pose=st.tuples(numbers, numbers, st.floats(-1.5, 0.9)))
def test_travels_are_those_of_the_inverse_kinematics(pose: tuple[float, float, float]) -> None:
    motion = inverse(GEOMETRY, pose)
    assert np.abs(travels(GEOMETRY, pose) - [motion.position, motion.passive_position]).max() < 1e-12


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("park = [0.5, 0.0, 0.0]", "poses.park = [0.5, 0, 0]: x would be 0.5, outside limits.platform.x = [-0.15, "),
        ("park = [0.0, 0.0]", "poses.park = [0.0, 0.0]: expected array of length 3"),
        ("park = [0.0, 0.0, 9.0]", "poses.park[2] = 9.0: expected number, -6.28318 to 6.28318"),
        ("'my pose' = [0.0, 0.0, 0.0]", "poses: 'my pose' is not a valid name here: expected text matching"),
        ("park = [0.0, 0.0, nan]", "poses.park[2] = nan: it must be a finite number"),
    ],
)
def test_configured_poses_that_are_refused(wrong: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(f"{TEXT}\n[poses]\n{wrong}\n")
    assert said in str(refused.value)
