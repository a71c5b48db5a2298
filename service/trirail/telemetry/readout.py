"""Readout beside the drawing: mode and fault in words, pose, goal, override, sliders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from trirail_drivers.interface import NAMES

from trirail.naming import Labels
from trirail.wire.vocabulary import MODES, Mode

PATH = "/readout"
_SPECIAL = str.maketrans({letter: f"\\{letter}" for letter in "\\`*_{}[]<>()#+-.!|~$&:"})
"""Escapes of Markdown's special characters, which are plain text behind a backslash (CommonMark 2.4)."""

_HEAD = "| | x [mm] | y [mm] | φ [°] | | {} | {} | {} |"
_ALIGNED = f"|---|{'--:|' * 3}---|{'--:|' * 3}"


class Standing(NamedTuple):
    """State that is not in the records, and holds until its next update."""

    goal: str | None = None
    """Id of the goal under way."""
    target: Sequence[float] | None = None
    """Pose that the goal leads to: x, y [m], phi [rad]; None for no goal or a jog."""
    override: float = 1.0
    """Rate at which motions shall run, 0 to 2."""
    fault: str | None = None
    """Reason of the robot's fault."""


def markdown(record: np.void, standing: Standing, names: Labels = NAMES) -> str:
    """Return the readout at a record, of wire.records.DTYPE, in millimetres, degrees and micrometres."""
    head = f"**{MODES[record['mode']].upper()}**   override {standing.override:.0%}"
    if standing.goal is not None:
        share, left = float(record["progress"]), float(record["remaining"])
        waits = share < 1.0 and (standing.override == 0.0 or MODES[record["mode"]] == Mode.HOLDING)
        words = "waits half-way" if waits else f"{left:.1f} s left"
        head += f"   goal **{standing.goal.translate(_SPECIAL)}**: {share:.0%}, {words}"
    wrong = [f"**{standing.fault.translate(_SPECIAL)}**"] if standing.fault else []
    target = ["–"] * 3 if standing.target is None else _pose(standing.target)
    place = record["position"] - record["backlash"]
    rows = [
        ("measured", *_pose(record["pose"]), "λ [mm]", *(f"{value * 1e3:.3f}" for value in place)),
        ("commanded", *_pose(record["commanded_pose"]), "v [mm/s]", *(f"{v * 1e3:.1f}" for v in record["velocity"])),
        ("goal", *target, "error [µm]", *(f"{value * 1e6:.0f}" for value in record["following_error"])),
    ]
    table = "\n".join([_HEAD.format(*names), _ALIGNED, *(f"| {' | '.join(row)} |" for row in rows)])
    return "\n\n".join([head, *wrong, table])


def _pose(pose: Sequence[float]) -> list[str]:
    x, y, phi = pose
    return [f"{x * 1e3:.3f}", f"{y * 1e3:.3f}", f"{np.degrees(phi):.3f}"]
