"""What the steps together would change: nodes that go to other sliders are exchanged; pure."""

from __future__ import annotations

from collections.abc import Sequence

from trirail_drivers.config import Drives
from trirail_drivers.interface import NAMES

from trirail.commissioning.judgement import Changes


def merged(found: Sequence[Changes], drives: Drives) -> tuple[dict[str, int | float], str]:
    """Put together what the steps would change; why the nodes cannot be exchanged, "" where they can.

    A node that moves to another slider leaves its own without one: the two are exchanged where nothing else was seen.
    """
    changes = {key: value for each in found for key, value in each.items()}
    nodes = {name: drive.node for name, drive in zip(NAMES, drives.each, strict=True)}
    moved = {name: int(changes[f"drives.{name}.node"]) for name in NAMES if f"drives.{name}.node" in changes}
    after = {**nodes, **moved}
    left = [node for node in nodes.values() if node not in after.values()]
    for name in NAMES:
        doubled = name not in moved and after[name] in moved.values()
        if doubled and left:
            after[name] = left.pop(0)
    if len(set(after.values())) < len(NAMES):
        kept = {key: value for key, value in changes.items() if not key.endswith(".node")}
        return kept, "two drives were seen to move one slider: look at the cables, and repeat those steps"
    for name, node in after.items():
        changes.pop(f"drives.{name}.node", None)
        if node != nodes[name]:
            changes[f"drives.{name}.node"] = node
    return dict(sorted(changes.items())), ""
