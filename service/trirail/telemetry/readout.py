"""Readout beside the drawing, with mode, fault, pose, goal, override and sliders as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from trirail_drivers.interface import NAMES

from trirail.naming import Labels
from trirail.wire.vocabulary import MODES, Mode

PATH = "/readout"
_ESCAPES = str.maketrans({letter: f"\\{letter}" for letter in "\\`*_{}[]<>()#+-.!|~$&:"})
"""Escapes of Markdown's special characters, which are plain text after a backslash (CommonMark 2.4)."""

_TABLE_HEAD = "| | x [mm] | y [mm] | φ [°] | | {} | {} | {} |"
_TABLE_RULE = f"|---|{'--:|' * 3}---|{'--:|' * 3}"


class ReadoutState(NamedTuple):
    """State in the readout that is not in the records; it is valid until its next update."""

    goal: str | None = None
    """Id of the current goal."""
    target: Sequence[float] | None = None
    """Pose to which the goal leads: x, y [m], phi [rad]; None if there is no goal or it is a jog."""
    override: float = 1.0
    """Speed override, 0 to 2."""
    fault: str | None = None
    """Reason for the robot's fault."""


def markdown(record: np.void, state: ReadoutState, names: Labels = NAMES) -> str:
    """Return the readout for a record of wire.records.DTYPE as Markdown, in millimetres, degrees and micrometres."""
    head = f"**{MODES[record['mode']].upper()}**   override {state.override:.0%}"
    if state.goal is not None:
        share, left = float(record["progress"]), float(record["remaining"])
        waits = share < 1.0 and (state.override == 0.0 or MODES[record["mode"]] == Mode.HOLDING)
        words = "waits on its path" if waits else f"{left:.1f} s left"
        head += f"   goal **{state.goal.translate(_ESCAPES)}**: {share:.0%}, {words}"
    wrong = [f"**{state.fault.translate(_ESCAPES)}**"] if state.fault else []
    target = ["–"] * 3 if state.target is None else _pose(state.target)
    place = record["position"] - record["backlash"]
    rows = [
        ("measured", *_pose(record["pose"]), "λ [mm]", *(f"{value * 1e3:.3f}" for value in place)),
        ("commanded", *_pose(record["commanded_pose"]), "v [mm/s]", *(f"{v * 1e3:.1f}" for v in record["velocity"])),
        ("goal", *target, "error [µm]", *(f"{value * 1e6:.0f}" for value in record["following_error"])),
    ]
    table = "\n".join([_TABLE_HEAD.format(*names), _TABLE_RULE, *(f"| {' | '.join(row)} |" for row in rows)])
    return "\n\n".join([head, *wrong, table])


def _pose(pose: Sequence[float]) -> list[str]:
    x, y, phi = pose
    return [f"{x * 1e3:.3f}", f"{y * 1e3:.3f}", f"{np.degrees(phi):.3f}"]
