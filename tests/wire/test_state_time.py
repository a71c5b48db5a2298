"""The wall-clock time of a state is that of its own cycle, whenever the state is made."""

from __future__ import annotations

import numpy as np
from control_rig import CONFIG
from trirail.processes.publications import StateMaker
from trirail.wire.records import DTYPE


def test_a_state_has_the_wall_clock_time_of_its_cycle() -> None:
    offset_ns = 1_700_000_000_000_000_000
    maker, rows = StateMaker(CONFIG, lambda: offset_ns), np.zeros(2, DTYPE)
    rows["cycle"], rows["deadline_ns"] = (10, 30), (5_010_000_000, 5_030_000_000)
    times = []
    for row in rows:
        maker.records(row[None])
        times.append(maker.newest().time)
    assert times == [1_700_000_005.01, 1_700_000_005.03]
    offset_ns += 3_600_000_000_000  # the clock is set
    assert maker.newest().time == 1_700_003_605.03
