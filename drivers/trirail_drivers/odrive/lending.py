"""What a cycle exchanges with three ODrives, as tables of trirail_drivers.driver.cyclic.

A cycle begins with the setpoints of the one before, where the drives follow any, and with the requests for positions;
from time to time one of the drives is asked for its errors. Nothing ends it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from trirail_drivers.bus.can_frame import DATA_AT
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import packed_frames
from trirail_drivers.driver.cyclic import Cyclic
from trirail_drivers.odrive import cansimple
from trirail_drivers.odrive.axis import OdriveAxis


class Lending:
    """Fills in the tables of three drives."""

    def __init__(
        self, tables: Cyclic, axes: Sequence[OdriveAxis], errors: Sequence[Frame], requests: Sequence[Frame]
    ) -> None:
        """`errors` and `requests` are what asks each drive for its errors and position."""
        self._tables = tables
        self._axes = axes
        setpoint = cansimple.input_pos(0.0, 0.0)
        setpoints = [cansimple.command(axis.node, cansimple.SET_INPUT_POS, setpoint) for axis in axes]
        self._all = packed_frames([*setpoints, *requests])
        self._asking = self._all.part(len(setpoints), len(setpoints) + len(requests))
        tables.beats, tables.setpoints = packed_frames(errors), self._all.part(0, len(setpoints))
        self._data = [frame[DATA_AT:].data for frame in tables.setpoints.frames]
        self._expected: list[tuple[int, int]] = []
        """The states and results that are expected."""

    def fill(self, *, follow: bool, within: float) -> None:
        """Have what the next cycle sends and expects; where drives `follow` setpoints, `within` [m]."""
        self._tables.begin = self._all if follow else self._asking
        for axis, data in zip(self._axes, self._data, strict=True):
            axis.waits, axis.follows_within = follow, within if follow and axis.powered_up else math.inf
            if follow:
                data[:] = axis.input_pos(axis.wanted, axis.wanted_rate)
        said = [axis.said for axis in self._axes]
        if said != self._expected:
            self._expected = said
            self._tables.expect([row for number, axis in enumerate(self._axes) for row in axis.expected(number)])
