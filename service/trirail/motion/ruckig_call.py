"""Ruckig, and what of its answers has to be dealt with."""

from __future__ import annotations

from collections.abc import Sequence

from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from trirail.errors import RefusalCode, RefusedError

JERK_SHARES = (1.0, 1.0 - 1e-6, 1.0 - 1e-3)
"""Ruckig finds no solution just where one kind of profile gives way to another, as for a distance of 2 a³ / j²
from rest to rest: there a hair less jerk has one."""


def solved(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory) -> bool:
    """Whether Ruckig has found a trajectory. Some of its failures raise, one (-101) by not being in its own enum."""
    try:
        return ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        return False


def solve_within(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory, jerk: Sequence[float]) -> None:
    """Have Ruckig find a trajectory for a request that lacks its limits of jerk. Raises RefusedError."""
    for share in JERK_SHARES:
        request.max_jerk = [share * limit for limit in jerk]
        if solved(ruckig, request, trajectory):
            return
    raise RefusedError(
        RefusalCode.NO_PLAN, "no motion leads there from the present one: send the goal again when it holds"
    )
