"""Named poses in the gateway: poses in the [poses] section of the configuration, and taught poses in a file.

A separate thread writes taught poses and checks their file, because the disk may take longer than the time-out of the
gateway's heartbeat. A taught pose is confirmed, announced and usable in goals when it has been written to the disk.
"""

from __future__ import annotations

import contextlib
import math
import queue
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from trirail.config import Config, as_built, corrected_geometry, geometry
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.kinematics.geometry import travels
from trirail.processes.incoming import Incoming
from trirail.processes.pose_file import PoseFile, Taught, TaughtPose, may_pass, state_directory
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.goals import Coordinates, Goal, NamedGoal
from trirail.wire.kinds.pose import pose_in_place_of
from trirail.wire.messages import ErrorReply, Notice
from trirail.wire.records import slider_positions
from trirail.wire.state import NamedPose, NamedPoses
from trirail.wire.text import check_new_pose
from trirail.wire.vocabulary import MODES, Mode

MAX_TAUGHT_POSES = 1000
"""Maximum number of taught poses."""
MAX_CHANGES_UNDER_WAY = 32
"""Maximum number of changes in progress; further changes are refused."""
CHECK_PERIOD_S = 2.0
"""Interval between two checks that the file of taught poses exists [s]."""
MAX_CLOSURE_ERROR_M = 1e-3
"""Maximum difference between measured slider positions and those calculated from the measured pose [m].

If the difference is larger, no pose matches the present slider positions, and the measured pose is that of an earlier
cycle.
"""


class _Change(NamedTuple):
    """Request to teach a pose, or to remove it if `pose` is None."""

    incoming: Incoming
    user: str
    name: str
    pose: TaughtPose | None


class Poses:
    """Handler of queries on …/poses, …/teach and …/forget, which also replaces names in goals by poses.

    Parameters
    ----------
    reply, refuse, announce
        Functions that answer a message, refuse a message, and publish a notice.
    wake
        Function that makes the gateway call `settle` soon. It may be called from any thread.
    again
        True if the gateway is being restarted. If the file of taught poses is invalid, a restarted gateway renames the
        file and serves the robot without taught poses. If the system cannot read the file, the gateway tries it again.

    Raises
    ------
    ServiceError
        The file of taught poses cannot be read at the first start.

    """

    def __init__(
        self,
        config: Config,
        reply: Callable[[Incoming, msgspec.Struct], None],
        refuse: Callable[[Incoming, RefusedError], None],
        announce: Callable[[Notice], object],
        wake: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
        *,
        again: bool = False,
    ) -> None:
        self._geometry = corrected_geometry(config)
        self._geometry_id = as_built.corrected_geometry_of(geometry(config.geometry), config.correction.as_built)
        self._configured = config.poses
        self._file = PoseFile(state_directory(config.robot.name))
        self._lacking = ""
        """Reason why the taught poses are missing; empty if the file has been read."""
        self._unread = False
        """True while the file may be valid but has not been read."""
        self._taught = self._read(again=again)
        self._reply, self._refuse, self._announce, self._wake = reply, refuse, announce, wake
        self._to_measure: deque[_Change] = deque()
        self._lacking_announced = False
        self._under_way = 0
        self._finished: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        """Functions that handle the results of the writer's thread, in the order of the results."""
        self._writer = ThreadPoolExecutor(1, "poses")
        self._clock = clock
        self._next_check = clock()
        self._gone = ""
        """Warning that the file of taught poses has been deleted; empty while it exists."""

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about taught poses, with one line per warning."""
        both = sorted(self._taught.keys() & self._configured.keys())
        foreign = sorted(name for name in self._taught.keys() - both if self._is_foreign(self._taught[name]))
        other = (
            f"poses taught with another [geometry] or correction map: {', '.join(foreign)}; check each with trirail "
            "goto NAME, then repeat trirail teach NAME"
        )
        return *filter(None, (self._lacking, self._gone, other if foreign else "")), *(
            f"pose {name} is defined in [poses], and the taught pose is not used: remove it with trirail forget {name}"
            for name in both
        )

    def _is_foreign(self, pose: TaughtPose) -> bool:
        return pose.geometry not in ("", self._geometry_id)

    def poll(self) -> None:
        """Begin to check periodically that the file of taught poses exists; `settle` announces its loss."""
        if self._clock() < self._next_check:
            return
        self._next_check = math.inf  # until this check has ended, for which a disk may take long
        if self._lacking and not self._lacking_announced:
            lacking = coded(self._lacking, EventCode.POSES_UNREADABLE, file=str(self._file.path))
            self._announce(Notice("service", "warning", lacking.text, **lacking.fields))
            self._lacking_announced = True
        self._writer.submit(self._check_file)

    def _on_checked(self, taught: Taught | None, *, is_gone: bool) -> None:
        """Use the poses of a file that could not be read before, and announce the loss of the file once."""
        if taught is not None:
            self._taught, self._unread, self._lacking = taught, False, ""
        self._next_check = self._clock() + CHECK_PERIOD_S
        before, self._gone = self._gone, self._lost_warning() if is_gone and not self._lacking else ""
        if self._gone and not before:
            gone = coded(self._gone, EventCode.POSES_LOST, file=str(self._file.path))
            self._announce(Notice("service", "warning", gone.text, **gone.fields))

    def _read(self, *, again: bool) -> Taught:
        try:
            return self._file.read()
        except ServiceError as error:
            if not again:
                raise
            self._lacking = f"{error}; no taught poses are available now"
            self._unread = may_pass(error)
            if self._unread:
                self._lacking += f"; the file is read again every {CHECK_PERIOD_S:g} s"
                return {}
            with contextlib.suppress(OSError):  # if the file cannot be renamed, changes of poses will be refused
                self._lacking += f"; the file is kept as {self._file.set_aside()}"
            return {}

    def _lost_warning(self) -> str:
        """Return the text of the warning that the file has been deleted."""
        if not self._taught:
            return f"{self._file.path} no longer exists: any taught poses in the file are lost"
        known = ", ".join(sorted(self._taught))
        return (
            f"{self._file.path} no longer exists: taught poses ({known}) are kept only until the service ends; "
            "the next trirail teach or forget writes them again"
        )

    def table(self) -> NamedPoses:
        """Return all named poses. If a configured and a taught pose have the same name, return the configured pose."""
        named = {name: self._named(name, pose) for name, pose in self._taught.items()}
        named |= {name: NamedPose(name, *pose, taught=False) for name, pose in self._configured.items()}
        return NamedPoses(tuple(named[name] for name in sorted(named)))

    def _named(self, name: str, pose: TaughtPose) -> NamedPose:
        return NamedPose(name, *pose.pose, taught=True, other_geometry=self._is_foreign(pose))

    def resolve_name(self, goal: Goal) -> Goal:
        """Convert a named goal to a pose goal. Return other goals, and goals with an unknown name, unchanged."""
        if not isinstance(goal, NamedGoal):
            return goal
        taught = self._taught.get(goal.name)
        pose = self._configured.get(goal.name) or (taught.pose if taught is not None else None)
        return goal if pose is None else pose_in_place_of(goal, *pose)

    def edit(self, incoming: Incoming, user: str, name: str) -> None:
        """Handle a query on …/teach or …/forget. Raises RefusedError if the query is invalid."""
        if self._under_way >= MAX_CHANGES_UNDER_WAY:
            raise RefusedError(
                RefusalCode.BUSY,
                f"{self._under_way} poses are already being taught or removed, which is the maximum: send fewer",
            )
        if incoming.kind == "forget":
            self._check_known(name)
            self._write(_Change(incoming, user, name, None))
            return
        check_new_pose(name)
        if name in self._configured:
            raise RefusedError(
                RefusalCode.CONFIGURED_POSE,
                f"pose {name} is defined in [poses]: use another name, or change the pose in that section",
            )
        if len(self._taught) >= MAX_TAUGHT_POSES and name not in self._taught:
            raise RefusedError(
                RefusalCode.BUSY, f"the maximum of {MAX_TAUGHT_POSES} taught poses is reached: remove one first"
            )
        self._under_way += 1
        self._to_measure.append(_Change(incoming, user, name, None))

    def measure(self, record: np.void) -> None:
        """Teach the requested poses at the pose in a record, which must be newer than the requests."""
        while self._to_measure:
            wanted = self._to_measure.popleft()
            self._under_way -= 1
            try:
                self._write(wanted._replace(pose=TaughtPose(*self._measured(record), self._geometry_id)))
            except RefusedError as refusal:
                self._refuse(wanted.incoming, refusal)

    def settle(self) -> None:
        """Answer and announce the changes that have been written, and announce the loss of the file."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._finished.get_nowait()()

    def _on_written(self, change: _Change, failure: ServiceError | None) -> None:
        self._under_way -= 1
        pose = change.pose or self._taught.get(change.name)
        if failure is not None or pose is None:  # None if two clients have removed the pose at the same time
            why = f"pose {change.name} is unchanged: {failure or 'another client has removed it'}"
            self._refuse(change.incoming, RefusedError(RefusalCode.FAILED, why))
            return
        if change.pose is not None:
            self._taught[change.name] = pose
        else:
            del self._taught[change.name]
        if not self._unread:
            self._lacking = ""  # the file now has every taught pose
        self._reply(change.incoming, self._named(change.name, pose))
        text = _words(change)
        self._announce(Notice("pose", "info", text.text, user=change.user, **text.fields))

    def close(self) -> None:
        """Finish and answer all pending changes. Requests that wait for a record are answered with an error."""
        for wanted in self._to_measure:
            self._reply(wanted.incoming, ErrorReply(RefusalCode.ENDED, "the service has ended"))
        self._to_measure.clear()
        self._writer.shutdown()
        self.settle()

    def _check_known(self, name: str) -> None:
        if name in self._taught:
            return
        check_new_pose(name)
        if name in self._configured:
            raise RefusedError(
                RefusalCode.CONFIGURED_POSE, f"pose {name} is defined in [poses]: remove it from that section"
            )
        there_are = ", ".join(sorted(self._taught)) or "none"
        raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r} has been taught; taught poses: {there_are}")

    def _measured(self, record: np.void) -> Coordinates:
        """Return the measured pose. Raises RefusedError if the robot is in fault or moves, or its pose is unknown."""
        mode = MODES[record["mode"]]
        if mode is Mode.FAULT:
            raise RefusedError(RefusalCode.FAULT, "the robot is in fault: remove the cause, then send reset")
        if mode not in (Mode.DISABLED, Mode.HOLDING):
            raise RefusedError(RefusalCode.MOVING, f"the robot is {mode}: teach a pose when it is at rest")
        if not np.all(record["homed"]):
            raise RefusedError(RefusalCode.NOT_HOMED, "the positions of the sliders are unknown: send home first")
        x, y, phi = record["pose"].tolist()
        there = travels(self._geometry, (x, y, phi))[0]
        if not np.abs(there - slider_positions(record)).max() <= MAX_CLOSURE_ERROR_M:
            raise RefusedError(
                RefusalCode.SINGULAR, "the slider positions do not correspond to any pose: move the sliders"
            )
        return x, y, phi

    def _write(self, change: _Change) -> None:
        self._under_way += 1
        self._writer.submit(self._keep, change)

    def _keep(self, change: _Change) -> None:
        """Write a change to the file. This method runs in the writer's thread."""
        failure = None
        try:
            self._file.change(change.name, change.pose, dict(self._taught))
        except ServiceError as error:
            failure = error
        self._finished.put(partial(self._on_written, change, failure))
        self._wake()

    def _check_file(self) -> None:
        """Check that the file exists, and read it if that has failed. This method runs in the writer's thread."""
        taught = None
        if self._unread:
            with contextlib.suppress(ServiceError):
                taught = self._file.read()
        self._finished.put(partial(self._on_checked, taught, is_gone=self._file.is_gone()))
        self._wake()


def _words(change: _Change) -> EventText:
    if change.pose is None:
        words = f"pose {change.name} removed by {change.user}"
        return coded(words, EventCode.POSE_REMOVED, pose=change.name, user=change.user)
    x, y, phi = (f"{round(value, 4) + 0.0:g}" for value in np.array(change.pose.pose) * (1e3, 1e3, np.degrees(1.0)))
    words = f"pose {change.name} taught by {change.user}: x {x} mm, y {y} mm, phi {phi}°"
    x_m, y_m, phi_rad = change.pose.pose
    return coded(words, EventCode.POSE_TAUGHT, pose=change.name, user=change.user, x=x_m, y=y_m, phi=phi_rad)
