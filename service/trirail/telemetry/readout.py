"""Text shown next to the robot's drawing, with mode, fault, pose, goal, override and slider values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from trirail_drivers.interface import NAMES

from trirail.naming import Labels
from trirail.wire.records import slider_positions
from trirail.wire.vocabulary import MODES, Mode

PATH = "/readout"
_ESCAPES = str.maketrans({letter: f"\\{letter}" for letter in "\\`*_{}[]<>()#+-.!|~$&:"})
"""Escape sequences for Markdown's special characters. After a backslash, they are plain text (CommonMark 2.4)."""

_TABLE_HEAD = "| | x [mm] | y [mm] | φ [°] | | {} | {} | {} |"
_TABLE_RULE = f"|---|{'--:|' * 3}---|{'--:|' * 3}"


_NO_POSE = ["–"] * 3


class ReadoutState(NamedTuple):
    """State that the readout shows in addition to the record. It is valid until it is updated."""

    goal: str | None = None
    """Id of the current goal."""
    target: Sequence[float] | None = None
    """Target pose of the goal: x, y [m], phi [rad]; None if there is no goal, or if the goal is a jog."""
    override: float = 1.0
    """Speed override, from 0 to 2; 1 is the planned speed."""
    fault: str | None = None
    """Reason for the robot's current fault; None if there is no fault."""


def markdown(record: np.void, state: ReadoutState, names: Labels = NAMES) -> str:
    """Return the readout for one record of wire.records.DTYPE as Markdown, in millimetres, degrees and micrometres."""
    head = f"**{MODES[record['mode']].upper()}**   override {state.override:.0%}"
    if state.goal is not None:
        share, left = float(record["progress"]), float(record["remaining"])
        waits = share < 1.0 and (state.override == 0.0 or MODES[record["mode"]] == Mode.HOLDING)
        words = "waits on its path" if waits else f"{left:.1f} s left"
        head += f"   goal **{state.goal.translate(_ESCAPES)}**: {share:.0%}, {words}"
    wrong = [f"**{state.fault.translate(_ESCAPES)}**"] if state.fault else []
    target = _NO_POSE if state.target is None else _pose(state.target)
    place = zip(slider_positions(record), record["homed"], strict=True)
    positions = [f"{value * 1e3:.3f}" if homed else "not homed" for value, homed in place]
    rows = [
        ("measured", *(_pose(record["pose"]) if record["homed"].all() else _NO_POSE), "λ [mm]", *positions),
        ("commanded", *_pose(record["commanded_pose"]), "v [mm/s]", *(f"{v * 1e3:.1f}" for v in record["velocity"])),
        ("goal", *target, "error [µm]", *(f"{value * 1e6:.0f}" for value in record["following_error"])),
    ]
    table = "\n".join([_TABLE_HEAD.format(*names), _TABLE_RULE, *(f"| {' | '.join(row)} |" for row in rows)])
    return "\n\n".join([head, *wrong, table])


def _pose(pose: Sequence[float]) -> list[str]:
    x, y, phi = pose
    return [f"{x * 1e3:.3f}", f"{y * 1e3:.3f}", f"{np.degrees(phi):.3f}"]
