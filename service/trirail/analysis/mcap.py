"""Export of a recording as an MCAP file with ROS 2 messages, for Foxglove, PlotJuggler and `ros2 bag`.

This module needs the package rosbags.
"""

from __future__ import annotations

import dataclasses
import heapq
import tempfile
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from trirail import config
from trirail.analysis.new_file import new_file
from trirail.errors import KinematicsError, ServiceError
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.robot import inverse, jacobians
from trirail.telemetry import provenance
from trirail.telemetry.journal import Line
from trirail.telemetry.recording import Recording
from trirail.wire.records import slider_positions
from trirail.wire.vocabulary import MODES, Mode

# The definitions of these messages are the same in the ROS 2 releases Jazzy, Kilted and Lyrical.
STORE = get_typestore(Stores.ROS2_JAZZY)
Time, Header = STORE.types["builtin_interfaces/msg/Time"], STORE.types["std_msgs/msg/Header"]
Point, Vector3 = STORE.types["geometry_msgs/msg/Point"], STORE.types["geometry_msgs/msg/Vector3"]
Quaternion, PoseMessage = STORE.types["geometry_msgs/msg/Quaternion"], STORE.types["geometry_msgs/msg/Pose"]
Transform = STORE.types["geometry_msgs/msg/Transform"]
TransformStamped = STORE.types["geometry_msgs/msg/TransformStamped"]
DiagnosticStatus = STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
KeyValue = STORE.types["diagnostic_msgs/msg/KeyValue"]

TOPICS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/commanded_pose": "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/events": "std_msgs/msg/String",
}
"""Message type of each topic."""
BASE, MEASURED, COMMANDED = "base", "platform_measured", "platform_commanded"
"""Names of the frames in /tf. The URDF has a separate link for the platform, which the joints move."""
JOINTS = tuple(f"{joint}_{leg}" for joint in ("slider", "pivot", "cross") for leg in "abc")
"""Names of the joints in the URDF: first the sliders, then the pivots, then the cross slides of the legs A, B, C."""
OK, ERROR = 0, 2
"""Levels of diagnostic_msgs/DiagnosticStatus."""
BLOCK_ROWS = 2000
"""Number of cycles that are converted together."""
FIRST, LAST = np.datetime64(0, "s"), np.datetime64((1 << 31) - 1, "s")
"""Earliest and latest time of a message."""
Message = tuple[int, str, Any]
"""Wall-clock time [ns], topic and message."""


def write(recording: Recording, path: Path, every: float | None = None) -> int:
    """Write a recording as one MCAP file; return the number of messages.

    Each message has the wall-clock time of the record or the log line from which it is made. `every` is the interval of
    the joint states and poses [s]; None for those of all cycles.

    Raises ServiceError if the file already exists or cannot be written, if the recording has no configuration, if its
    clock was not set, or if `every` is not positive.
    """
    _check_clock(recording)
    settings = provenance.configuration(recording.texts)
    if settings is None:
        raise ServiceError(f"{recording.name}: MCAP needs the configuration, which this recording does not contain")
    geometry = config.corrected_geometry(settings)
    with new_file(path), tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as folder:
        count = _write_bag(Path(folder, "bag"), messages(recording, geometry, every))
        Path(folder, "bag/bag.mcap").replace(path)
    return count


def messages(recording: Recording, geometry: Geometry, every: float | None = None) -> Iterator[Message]:
    """Yield the messages of a recording, in order of time; the parameter `every` is that of `write`.

    The messages of the cycles are made one after the other: together they need 4 kB of memory per cycle, which is
    14 GB for an hour at 1 kHz. Only the few messages of the events are sorted.
    """
    time = itemgetter(0)
    others = sorted([*_log(recording), *_diagnostics(recording)], key=time)  # modes may last less than `every`
    thinned = recording if every is None else recording.part(every=every)
    return heapq.merge(_motion(thinned, geometry), others, key=time)


def joint_motion(records: NDArray[np.void], geometry: Geometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions [m, rad] and the velocities [m/s, rad/s] of all JOINTS, each (N, 9).

    The values of the sliders are measured. The values of the passive joints are calculated from the measured pose.

    With a correction map, the legs lead to the corrected pose. The URDF has no map, so its legs meet only if the
    passive joints are those of this pose.
    """
    sliders, velocity, pose = slider_positions(records), records["velocity"], records["pose"]
    if geometry.correction is not None:
        pose = pose + geometry.correction.at(pose)
        geometry = dataclasses.replace(geometry, correction=None)
    J1, J2 = jacobians(geometry, pose)
    twist = np.linalg.solve(J2, J1 @ velocity[:, :, np.newaxis])[:, :, 0]
    passive = inverse(geometry, pose, twist)
    pivots, turning = np.repeat(pose[:, 2:], 3, axis=1), np.repeat(twist[:, 2:], 3, axis=1)
    return (
        np.concatenate([sliders, pivots, passive.passive_position], axis=1),
        np.concatenate([velocity, turning, passive.passive_velocity], axis=1),
    )


def _write_bag(folder: Path, made: Iterator[Message]) -> int:
    """Write messages as a rosbag2 bag, which is a folder that contains the MCAP file; return the number of messages."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in TOPICS.items()}
        count = 0
        for wall, topic, message in made:
            bag.write(connections[topic], wall, STORE.serialize_cdr(message, TOPICS[topic]))
            count += 1
    return count


def _motion(recording: Recording, geometry: Geometry) -> Iterator[Message]:
    """Yield the messages of each cycle with a pose, in order of time. This differs from cycles if a clock was set.

    The cycles are converted in blocks, because the arrays of a whole recording would need much memory.
    """
    order = np.argsort(recording.wall, kind="stable")
    has_pose = recording.records["homed"].all(axis=1) & np.isfinite(recording.records["pose"]).all(axis=1)
    order = order[has_pose[order]]
    for start in range(0, len(order), BLOCK_ROWS):
        rows = order[start : start + BLOCK_ROWS]
        yield from _block_motion(recording.records[rows], _nanoseconds(recording.wall[rows]), geometry)


def _block_motion(records: NDArray[np.void], walls: list[int], geometry: Geometry) -> Iterator[Message]:
    try:
        positions, velocities = joint_motion(records, geometry)
    except (KinematicsError, np.linalg.LinAlgError):  # a row has no pose that the legs can reach: leave it out
        if half := len(records) // 2:
            yield from _block_motion(records[:half], walls[:half], geometry)
            yield from _block_motion(records[half:], walls[half:], geometry)
        return
    joint_state, pose_stamped = STORE.types["sensor_msgs/msg/JointState"], STORE.types["geometry_msgs/msg/PoseStamped"]
    tf_message, names, no_effort = STORE.types["tf2_msgs/msg/TFMessage"], list(JOINTS), np.zeros(0)
    poses = zip(records["pose"].tolist(), records["commanded_pose"].tolist(), strict=True)
    for wall, position, velocity, (measured, commanded) in zip(walls, positions, velocities, poses, strict=True):
        header = _header(wall, BASE)
        yield wall, "/joint_states", joint_state(_header(wall, ""), names, position, velocity, no_effort)
        yield wall, "/pose", pose_stamped(header, PoseMessage(Point(*measured[:2], 0.0), _turn(measured[2])))
        yield (
            wall,
            "/commanded_pose",
            pose_stamped(header, PoseMessage(Point(*commanded[:2], 0.0), _turn(commanded[2]))),
        )
        transforms = [
            TransformStamped(header, frame, Transform(Vector3(*pose[:2], 0.0), _turn(pose[2])))
            for frame, pose in ((MEASURED, measured), (COMMANDED, commanded))
        ]
        yield wall, "/tf", tf_message(transforms)


def _log(recording: Recording) -> Iterator[Message]:
    """Yield one message for each line of the log of events, as JSON.

    An event has the same JSON as in the service's publications. A line from the recorder has only a level and a text.
    """
    string = STORE.types["std_msgs/msg/String"]
    for line in recording.events:
        content = line.event if line.event is not None else {"level": line.level, "message": line.text}
        yield _wall(line), "/events", string(msgspec.json.encode(content).decode())


def _diagnostics(recording: Recording) -> Iterator[Message]:
    """Yield a message for each change of the mode, and a message for each fault."""
    modes = recording.records["mode"]
    changes = np.flatnonzero(np.diff(modes, prepend=np.uint8(255)))  # no mode has this number
    walls = _nanoseconds(recording.wall[changes])
    for row, wall in zip(changes.tolist(), walls, strict=True):
        mode = MODES[modes[row]]
        level = ERROR if mode == Mode.FAULT else OK
        yield _diagnosis(recording, wall, level, "mode", str(mode), {"t": repr(float(recording.t[row]))})
    for line in recording.events:
        if line.event is not None and line.event.kind == "fault":
            detail = msgspec.to_builtins(line.event.fault) if line.event.fault is not None else {}
            values = {name: str(value) for name, value in detail.items()} | {"t": repr(line.t)}
            yield _diagnosis(recording, _wall(line), ERROR, "fault", line.event.message, values)


def _diagnosis(recording: Recording, wall: int, level: int, name: str, text: str, values: dict[str, str]) -> Message:
    array = STORE.types["diagnostic_msgs/msg/DiagnosticArray"]
    pairs = [KeyValue(key, value) for key, value in values.items()]
    status = DiagnosticStatus(level, f"trirail: {name}", text, recording.name, pairs)
    return wall, "/diagnostics", array(_header(wall, ""), [status])


def _header(wall: int, frame: str) -> Any:
    return Header(Time(*divmod(wall, 1_000_000_000)), frame)


def _turn(angle: float) -> Any:
    """Return the quaternion of a rotation about z."""
    return Quaternion(0.0, 0.0, float(np.sin(angle / 2.0)), float(np.cos(angle / 2.0)))


def _check_clock(recording: Recording) -> None:
    """Raise ServiceError if the recording has a time that messages of ROS 2 cannot contain: their seconds are int32."""
    cycles = (recording.wall.min(), recording.wall.max()) if len(recording.wall) else ()
    walls = [*cycles, *(line.wall for line in recording.events)]
    for wall in (min(walls), max(walls)) if walls else ():
        if not FIRST <= wall <= LAST:
            raise ServiceError(
                f"{recording.name}: the clock showed {str(wall)[:19]}; messages of ROS 2 can have times from 1970 to "
                "2038, so export to CSV or Parquet instead"
            )


def _nanoseconds(walls: NDArray[np.datetime64]) -> list[int]:
    return [int(wall) for wall in walls.astype("datetime64[ns]").astype(np.int64)]


def _wall(line: Line) -> int:
    return int(line.wall.astype("datetime64[ns]").astype(np.int64))
