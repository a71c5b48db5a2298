"""Ruckig, and what of its answers has to be dealt with."""

from __future__ import annotations

from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory


def solved(ruckig: Ruckig, request: InputParameter, trajectory: Trajectory) -> bool:
    """Whether Ruckig has found a trajectory. Some of its failures raise, one (-101) by not being in its own enum."""
    try:
        return ruckig.calculate(request, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        return False
