"""What is sent between loop and planner comes back to the last bit; what is no law is refused."""

from __future__ import annotations

import numpy as np
import pytest
from motion.test_runs import ROBOT, run_of, way
from trirail.motion.packing import pack_path, pack_run, unpack_law, unpack_run
from trirail.motion.paths import Path, constant_law

LEGS = ROBOT.packed()


def backwards() -> Path:
    """A law that goes on for a tenth of a second, and then back."""
    pieces = np.zeros((2, 1, 6))
    pieces[0, 0, :2] = 0.0, 1.0
    pieces[1, 0, :2] = 0.1, -1.0
    return Path(np.array([0.0, 0.1, 0.2]), pieces)


def test_a_run_comes_back_as_it_was_sent() -> None:
    run = run_of(way((0.05, 0.02, 0.1)))
    run.time = 0.1
    again = unpack_run(LEGS, pack_run(run))
    assert (again.law_state, again.target) == (run.law_state, run.target)
    assert again.path.knots.tolist() == run.path.knots.tolist()


def test_a_law_by_which_time_falls_is_refused_wherever_one_is_taken() -> None:
    with pytest.raises(ValueError, match="falls"):
        unpack_law(pack_path(backwards()))
    run = run_of(way((0.05, 0.02, 0.1)))
    run.change_law(backwards(), 1.0)
    with pytest.raises(ValueError, match="falls"):
        unpack_run(LEGS, pack_run(run))
    assert unpack_law(pack_path(constant_law(0.5))).pieces[0, 0, 1] == 0.5
