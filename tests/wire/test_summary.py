"""What a fleet reads of a robot: short whatever the robot says, and a valid message."""

from __future__ import annotations

import msgspec
import numpy as np
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.publications import StateMaker
from trirail.wire.packets import Status
from trirail.wire.records import DTYPE
from trirail.wire.sizes import MAX_NAME
from trirail.wire.state import SUMMARY_BYTES, RobotSummary, State, summary_of


def state(goal: str | None, fault: str | None, missed: int) -> State:
    made, rows = StateMaker(CONFIG), np.zeros(1, DTYPE)
    rows["overruns"], rows["cycle"], rows["lateness_ns"] = missed, 10**12, 10**12
    made.records(rows)
    made.update(Status(goal, 1.0, fault))
    return made.newest()


@given(
    st.none() | st.text(min_size=1, max_size=MAX_NAME),
    st.none() | st.text(min_size=1, max_size=2000),
    st.integers(0, 10**9),
    st.floats(0.0, 1e6),
)
def test_a_summary_is_short_and_says_what_is_so(goal: str | None, fault: str | None, missed: int, age: float) -> None:
    made = summary_of(state(goal, fault, missed), age, "10.20.30.dev4+gabcdef012")
    encoded = msgspec.json.encode(made)
    assert len(encoded) < SUMMARY_BYTES
    assert msgspec.json.decode(encoded, type=RobotSummary) == made
    assert (made.mode, made.missed) == ("disabled", missed)
    for said, whole in ((made.fault, fault), (made.goal, goal)):
        assert (said is None) == (whole is None)
        if said is not None and whole is not None:
            assert said == whole or (said.endswith("…") and whole.startswith(said[:-1]))
