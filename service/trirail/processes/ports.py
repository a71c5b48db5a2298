"""Where the processes beside the loop connect."""

from __future__ import annotations

from typing import NamedTuple

from trirail.wire.links import Port


class Ports(NamedTuple):
    """One for each of them."""

    gateway: Port
    recorder: Port
    planner: Port
