"""What a cycle exchanges with three ODrives, as tables of trirail_drivers.driver.cyclic.

A cycle begins with the setpoints of the one before, where the drives follow any, and with the requests for positions;
from time to time one of the drives is asked for its errors. Nothing ends it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packets import BusAccess, packets
from trirail_drivers.driver.cyclic import Cyclic, Row
from trirail_drivers.interface import Triple
from trirail_drivers.odrive import frames
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.setpoints import SetpointSender

_NEVER = (math.nan, math.nan)


class Tables:
    """The tables of three drives, and what goes from their driver into them and back."""

    def __init__(
        self, bus: BusAccess, axes: Sequence[OdriveAxis], errors: Sequence[Frame], requests: Sequence[Frame], due: int
    ) -> None:
        """`errors` and `requests` are what asks each drive for its errors and position; `due` setpoints are kept."""
        self._axes = axes
        setpoint = frames.input_pos(0.0, 0.0)
        setpoints = [frames.command(axis.node, frames.SET_INPUT_POS, setpoint) for axis in axes]
        self._all = packets([*setpoints, *requests])
        self._asking = self._all.part(len(setpoints), len(setpoints) + len(requests))
        self.cyclic = Cyclic(bus, self._all, packets(errors), self._all.part(0, len(setpoints)), due)
        self.cyclic.end = self.cyclic.end[:0]

    def fill(self, sender: SetpointSender, due: Sequence[Triple | None], *, follow: bool, within: float) -> None:
        """Write what is kept of the drives; where they `follow` setpoints, `within` [m]."""
        cyclic = self.cyclic
        cyclic.begin = self._all if follow else self._asking
        written, sent = sender.written, sender.sent
        for axis, frame in zip(self._axes, cyclic.setpoints.frames, strict=True):
            number = self._axes.index(axis)
            if written is not None and follow:
                data = axis.input_pos(written[0][number], written[1][number])
                frame[:] = np.frombuffer(frames.command(axis.node, frames.SET_INPUT_POS, data).packed, np.uint8)
        rows = []
        for number, axis in enumerate(self._axes):
            row: Row = axis.lend()
            row["waits"], row["follows_within"] = follow, within if follow and axis.powered_up else math.inf
            row["wanted"] = (written[0][number], written[1][number]) if written is not None else _NEVER
            row["sent"] = (sent[0][number], sent[1][number]) if sent is not None else _NEVER
            row["in_force"] = sender.in_force[number] if sender.in_force else math.nan
            rows.append(row)
        cyclic.write(rows)
        cyclic.history[:] = [place or (math.nan,) * 3 for place in due]
        cyclic.expect([expected for number, axis in enumerate(self._axes) for expected in axis.expected(number)])

    def empty(self, sender: SetpointSender, due: deque[Triple | None]) -> None:
        """Go on from what they hold."""
        rows = self.cyclic.rows()
        for axis, row in zip(self._axes, rows, strict=True):
            axis.take_back(row)
        sender.written, sender.sent = _setpoints(rows, "wanted"), _setpoints(rows, "sent")
        if sender.in_force:
            sender.in_force = [row["in_force"] for row in rows]
        due.extend((a, b, c) if math.isfinite(a) else None for a, b, c in self.cyclic.history.tolist())


def _setpoints(rows: Sequence[Row], name: str) -> tuple[Triple, Triple] | None:
    (a, da), (b, db), (c, dc) = (row[name] for row in rows)
    return ((a, b, c), (da, db, dc)) if math.isfinite(a) else None
