"""Bluesky devices that connect to a running service, with movable axes, readings and fly scans.

Needs trirail[bluesky].
"""

from __future__ import annotations

from trirail.errors import TrirailError

try:
    from trirail.bluesky.flight import Flight
    from trirail.bluesky.mover import UnfinishedError
    from trirail.bluesky.stage import Stage
except ModuleNotFoundError as error:
    if (error.name or "").partition(".")[0] not in ("bluesky", "ophyd_async", "event_model"):
        raise
    raise TrirailError("trirail.bluesky needs Bluesky: pip install 'trirail[bluesky]'") from error

__all__ = ["Flight", "Stage", "UnfinishedError"]
