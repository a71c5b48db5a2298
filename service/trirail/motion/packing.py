"""Paths and runs as they are sent between loop and planner, and written into recordings: bit for bit the same."""

from __future__ import annotations

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.motion.paths import Path, falls, sound
from trirail.motion.runs import Run, Seam
from trirail.wire.plan_packets import PackedPath, PackedRun

POWERS = 6
"""Coefficients of a piece."""


def pack_path(path: Path) -> PackedPath:
    """Return a path as it is sent."""
    return PackedPath(path.knots.tobytes(), path.pieces.tobytes(), path.in_sliders, path.tools.tobytes())


def unpack_path(packed: PackedPath, degrees: int) -> Path:
    """Return a path of so many coordinates from how it was sent; compiled code may then rely on its shape.

    Raises ValueError where it is none: of another shape, not ascending, not finite.
    """
    knots = np.frombuffer(packed.knots).copy()
    pieces = np.frombuffer(packed.pieces).copy()
    number = len(knots) - 1
    if number < 1 or len(pieces) != number * degrees * POWERS:
        raise ValueError(f"a path of {len(knots)} knots and {len(pieces)} coefficients in {degrees} coordinates")
    tools = np.frombuffer(packed.tools).copy()
    if len(tools) not in (0, 2 * number):
        raise ValueError(f"a path of {number} pieces with {len(tools)} coordinates of tools")
    if not sound(knots, pieces, tools):
        raise ValueError("a path whose numbers are not finite, or whose knots do not ascend")
    return Path(knots, pieces.reshape(number, degrees, POWERS), packed.in_sliders, tools.reshape(-1, 2))


def unpack_law(packed: PackedPath) -> Path:
    """Return a law from how it was sent. Raises ValueError where it is none: as a path, or where its time falls."""
    law = unpack_path(packed, 1)
    if falls(law.knots, law.pieces):
        raise ValueError("a law by which the time along its path falls")
    return law


def pack_run(run: Run) -> PackedRun:
    """Return a run as it is sent."""
    seams = tuple(seam.s for seam in run.seams)
    return PackedRun(pack_path(run.path), pack_path(run.law), run.target, run.time, seams)


def unpack_run(legs: Array, packed: PackedRun) -> Run:
    """Return a run from how it was sent, of a robot with such packed legs. Raises ValueError where it is none.

    What the path was before its seams is not sent: nobody plans from there.
    """
    path = unpack_path(packed.path, 3)
    run = Run(legs, path, unpack_law(packed.law), packed.target)
    run.time = packed.time
    run.seams.extend(Seam(s, path) for s in packed.seams)
    return run
