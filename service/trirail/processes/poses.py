"""Named poses as the gateway knows them: those of [poses], and those that are taught and kept.

A disk may take longer than the loop waits for a sign of life: what is taught is written by a thread of its own, and
is answered, told and known to goals when it is on the disk.
"""

from __future__ import annotations

import queue
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import msgspec
import numpy as np

from trirail.config import Config, corrected_geometry
from trirail.errors import RefusalCode, RefusedError, ServiceError
from trirail.kinematics.geometry import travels
from trirail.processes.incoming import Incoming
from trirail.processes.pose_file import PoseFile, state_directory
from trirail.wire import boundary, zenoh_session
from trirail.wire.goals import Coordinates, Goal, NamedGoal
from trirail.wire.kinds.pose import pose_in_place_of
from trirail.wire.messages import ErrorReply
from trirail.wire.packets import PoseChanged, Remark
from trirail.wire.state import NamedPose, NamedPoses
from trirail.wire.text import check_name, check_new_pose
from trirail.wire.vocabulary import MODES, Mode, NoContent

MOST = 1000
"""Poses that may be kept."""
UNDER_WAY = 32
"""Poses that may be taught or removed at once; beyond that they are refused."""
LOOK_EVERY = 2.0
"""How often it is looked whether the file of taught poses is there [s]."""
BELONGS = 1e-3
"""A measured pose whose sliders are not where they are measured is none [m]: it is of earlier cycles, and theirs is
none that closes the loops."""


class _Change(NamedTuple):
    """A pose to be taught, or to be removed."""

    incoming: Incoming
    user: str
    name: str
    pose: Coordinates | None


class Poses:
    """Takes what comes on …/poses, …/teach and …/forget, and puts poses in the place of their names.

    `reply` answers, `refuse` says no, `tell` has everyone told, `wake` has `settle` called soon, from any thread.
    Raises ServiceError where what was taught cannot be read.
    """

    def __init__(
        self,
        config: Config,
        reply: Callable[[Incoming, msgspec.Struct], None],
        refuse: Callable[[Incoming, RefusedError], None],
        tell: Callable[[PoseChanged | Remark], object],
        wake: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._robot = config.robot.name
        self._geometry = corrected_geometry(config)
        self._configured = config.poses
        self._file = PoseFile(state_directory(config.robot.name))
        self._taught = self._file.read()
        self._reply, self._refuse, self._tell, self._wake = reply, refuse, tell, wake
        self._to_measure: deque[_Change] = deque()
        self._under_way = 0
        self._written: queue.SimpleQueue[tuple[_Change, ServiceError | None]] = queue.SimpleQueue()
        self._writer = ThreadPoolExecutor(1, "poses")
        self._clock = clock
        self._next_look = clock()
        self._gone = ""
        """That the file of taught poses has gone, and what that means; empty while it is there."""

    def warnings(self) -> tuple[str, ...]:
        """Return what people should know, one line each: a file that has gone, names that the configuration has now."""
        both = sorted(self._taught.keys() & self._configured.keys())
        gone = (self._gone,) if self._gone else ()
        return *gone, *(
            f"pose {name} is that of [poses]; the taught one is not used: trirail forget {name}" for name in both
        )

    def poll(self) -> None:
        """See whether the file of taught poses is still there, once in a while; have everyone told where it is not."""
        if self._clock() < self._next_look:
            return
        self._next_look = self._clock() + LOOK_EVERY
        before, self._gone = self._gone, self._lost() if self._file.gone else ""
        if self._gone and not before:
            self._tell(Remark("warning", self._gone))

    def _lost(self) -> str:
        """Say what it means that the file has gone."""
        if not self._taught:
            return f"{self._file.path} has gone: what was taught is lost, if anything was"
        known = ", ".join(sorted(self._taught))
        return (
            f"{self._file.path} has gone: taught poses are known only until the service ends ({known}); "
            "the next trirail teach or forget writes them again"
        )

    def table(self) -> NamedPoses:
        """Return all that there are."""
        found = {**self._taught, **self._configured}
        return NamedPoses(
            tuple(NamedPose(name, *found[name], taught=name not in self._configured) for name in sorted(found))
        )

    def of_name(self, goal: Goal) -> Goal:
        """Return the pose goal that a named one means; any other, and one of a name that there is not, as it is."""
        pose = (self._configured.get(goal.name) or self._taught.get(goal.name)) if isinstance(goal, NamedGoal) else None
        if pose is None:
            return goal
        return pose_in_place_of(goal, *pose)

    def edit(self, incoming: Incoming) -> None:
        """Take a query on …/teach or …/forget. Raises RefusedError."""
        kind = incoming.kind
        user, name = boundary.names(incoming.key, zenoh_session.key(self._robot, kind), ("user", "pose"))
        check_name(name, "pose")
        incoming.content(NoContent | None, f"{kind} takes no content")
        if self._under_way >= UNDER_WAY:
            raise RefusedError(RefusalCode.BUSY, f"{self._under_way} poses are being taught already: send fewer")
        if kind == "forget":
            self._check_known(name)
            self._write(_Change(incoming, user, name, None))
            return
        check_new_pose(name)
        if name in self._configured:
            raise RefusedError(
                RefusalCode.CONFIGURED_POSE, f"{name} is in [poses]: teach another name, or change it there"
            )
        if len(self._taught) >= MOST and name not in self._taught:
            raise RefusedError(RefusalCode.BUSY, f"{MOST} poses are kept already: remove one")
        self._under_way += 1
        self._to_measure.append(_Change(incoming, user, name, None))

    def measure(self, record: np.void) -> None:
        """Take the pose to be taught from a record: the newest that there is, and later than the request."""
        while self._to_measure:
            wanted = self._to_measure.popleft()
            self._under_way -= 1
            try:
                self._write(wanted._replace(pose=self._measured(record)))
            except RefusedError as refusal:
                self._refuse(wanted.incoming, refusal)

    def settle(self) -> None:
        """Answer and tell what has been written."""
        while True:
            try:
                change, failure = self._written.get_nowait()
            except queue.Empty:
                return
            self._under_way -= 1
            pose = change.pose or self._taught.get(change.name)
            if failure is not None or pose is None:  # the latter where two have removed it at once
                why = f"{change.name} is as it was: {failure or 'it has been removed already'}"
                self._refuse(change.incoming, RefusedError(RefusalCode.FAILED, why))
                continue
            if change.pose is not None:
                self._taught[change.name] = pose
            else:
                del self._taught[change.name]
            self._reply(change.incoming, NamedPose(change.name, *pose, taught=True))
            self._tell(PoseChanged(change.user, _words(change)))

    def close(self) -> None:
        """Write what is to be written and answer it; what waits for a record has none any more."""
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
            raise RefusedError(RefusalCode.CONFIGURED_POSE, f"{name} is in [poses]: remove it there")
        there_are = ", ".join(sorted(self._taught)) or "none"
        raise RefusedError(RefusalCode.UNKNOWN_POSE, f"no pose {name!r} was taught: there is {there_are}")

    def _measured(self, record: np.void) -> Coordinates:
        """Return where the robot stands, measured. Raises RefusedError where it moves, or that is not known."""
        mode = MODES[record["mode"]]
        if mode is Mode.FAULT:
            raise RefusedError(RefusalCode.FAULT, "the robot is in fault: remove the cause, then send reset")
        if mode not in (Mode.DISABLED, Mode.HOLDING):
            raise RefusedError(RefusalCode.MOVING, f"the robot is {mode}: teach a pose when it stands")
        if not np.all(record["homed"]):
            raise RefusedError(RefusalCode.NOT_HOMED, "it is not known where the sliders are: send home first")
        x, y, phi = record["pose"].tolist()
        there = travels(self._geometry, (x, y, phi))[0]
        if not np.abs(there - record["position"] + record["backlash"]).max() <= BELONGS:
            raise RefusedError(RefusalCode.SINGULAR, "the sliders are where they belong to no pose: move them")
        return x, y, phi

    def _write(self, change: _Change) -> None:
        self._under_way += 1
        self._writer.submit(self._keep, change)

    def _keep(self, change: _Change) -> None:
        """Write a change; in the thread that does nothing else."""
        failure = None
        try:
            self._file.change(change.name, change.pose, dict(self._taught))
        except ServiceError as error:
            failure = error
        self._written.put((change, failure))
        self._wake()


def _words(change: _Change) -> str:
    if change.pose is None:
        return f"pose {change.name} removed by {change.user}"
    x, y, phi = (f"{round(value, 4) + 0.0:g}" for value in np.array(change.pose) * (1e3, 1e3, np.degrees(1.0)))
    return f"pose {change.name} taught by {change.user}: x {x} mm, y {y} mm, phi {phi}°"
