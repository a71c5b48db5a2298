"""Conversion of paths and runs to bytes and back, for messages between loop and planner and for recordings.

The conversion preserves the full precision of all numbers.
"""

from __future__ import annotations

import numpy as np

from trirail.kinematics.arrays import Array
from trirail.motion.paths import Path, is_valid_path, law_falls
from trirail.motion.runs import Run, Seam
from trirail.wire.plan_packets import PackedPath, PackedRun

POWERS = 6
"""Number of coefficients per piece and coordinate."""


def pack_path(path: Path) -> PackedPath:
    """Return a path in packed form."""
    return PackedPath(path.knots.tobytes(), path.pieces.tobytes(), path.in_sliders, path.tools.tobytes())


def unpack_path(packed: PackedPath, degrees: int) -> Path:
    """Return a path with `degrees` coordinates from its packed form.

    The shape is checked because compiled code accesses the arrays without checks.

    Raises
    ------
    ValueError
        The shape is wrong, a number is not finite, or a knot is less than the previous knot.
    """
    knots = np.frombuffer(packed.knots).copy()
    pieces = np.frombuffer(packed.pieces).copy()
    number = len(knots) - 1
    if number < 1 or len(pieces) != number * degrees * POWERS:
        raise ValueError(f"a path of {len(knots)} knots and {len(pieces)} coefficients in {degrees} coordinates")
    tools = np.frombuffer(packed.tools).copy()
    if len(tools) not in (0, 2 * number):
        raise ValueError(f"a path of {number} pieces with {len(tools)} coordinates of tools")
    if not is_valid_path(knots, pieces, tools):
        raise ValueError("a path whose numbers are not finite, or whose knots do not ascend")
    return Path(knots, pieces.reshape(number, degrees, POWERS), packed.in_sliders, tools.reshape(-1, 2))


def unpack_law(packed: PackedPath) -> Path:
    """Return a law from its packed form.

    Raises ValueError if the packed path is invalid (see unpack_path), or if the time along the path would decrease.
    """
    law = unpack_path(packed, 1)
    if law_falls(law.knots, law.pieces):
        raise ValueError("a law whose time along the path falls")
    return law


def pack_run(run: Run) -> PackedRun:
    """Return a run in packed form."""
    seams = tuple(seam.s for seam in run.seams)
    return PackedRun(pack_path(run.path), pack_path(run.law), run.target, run.time, seams)


def unpack_run(legs: Array, packed: PackedRun) -> Run:
    """Return a run from its packed form. `legs` is Geometry.packed(). Raises ValueError if the packed run is invalid.

    Seam.before is not part of the packed form, because the planner does not need the paths without the later goals.
    """
    path = unpack_path(packed.path, 3)
    run = Run(legs, path, unpack_law(packed.law), packed.target)
    run.time = packed.time
    run.seams.extend(Seam(s, path) for s in packed.seams)
    return run
