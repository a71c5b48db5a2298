"""Tables of a compiled cycle with three ODrives; see trirail_drivers.driver.cyclic.

A cycle begins with the setpoints of the previous cycle, if the drives follow setpoints, and with the position requests.
Every ERROR_PERIOD it also requests the errors of one drive. Nothing is sent at the end of a cycle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from trirail_drivers.bus.can_frame import DATA_AT
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import packed_frames
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.driver.row_updates import put_setpoint, scale_setpoint
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import OdriveAxis


class CycleTableWriter:
    """Writer that fills the tables of three drives."""

    def __init__(
        self, tables: Cyclic, axes: Sequence[OdriveAxis], errors: Sequence[Frame], requests: Sequence[Frame]
    ) -> None:
        """`errors` and `requests` are the frames that request the errors and the position of each drive."""
        self._tables = tables
        self._axes = axes
        nothing = bytes(cansimple.INPUT_POS.size)
        setpoints = [cansimple.command(axis.node, cansimple.SET_INPUT_POS, nothing) for axis in axes]
        self._all = packed_frames([*setpoints, *requests])
        self._requests = self._all.part(len(setpoints), len(setpoints) + len(requests))
        tables.beats, tables.setpoints = packed_frames(errors), self._all.part(0, len(setpoints))
        self._expected: list[tuple[int, int]] = []
        """Axis state and procedure result of each drive for which the expected frames were last written."""

    def fill(self, *, follow: bool, within: float) -> None:
        """Fill the tables for the next cycle.

        `follow` is True if the drives follow setpoints; the following error may then be at most `within` [m].
        """
        self._tables.begin = self._all if follow else self._requests
        for axis, frame in zip(self._axes, self._tables.setpoints.frames, strict=True):
            axis.waits, axis.follows_within = follow, within if follow and axis.powered_up else math.inf
            if follow:
                scale_setpoint(axis, axis.wanted, axis.wanted_rate)
                put_setpoint(axis, frame[DATA_AT:])
        states = [axis.heartbeat_state for axis in self._axes]
        if states != self._expected:
            self._expected = states
            self._tables.expect([row for number, axis in enumerate(self._axes) for row in axis.expected_rows(number)])
