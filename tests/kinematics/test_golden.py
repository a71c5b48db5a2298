"""Setpoints of the paper's robot are the same to the last bit as ever, and as the recursion in plain Python has them.

What is kept in tests/data is the SHA-256 of positions, velocities and accelerations, of sliders and edges, along
generated goals; sine and cosine are the C library's. Whoever changes the arithmetic on purpose writes it anew:
python tests/kinematics/test_golden.py.
"""

from __future__ import annotations

import hashlib
import random
import subprocess
import sys
from pathlib import Path

KEPT = Path(__file__).parents[1] / "data" / "setpoints.sha256"
GOALS, POINTS = 40, 25
PLAIN = """
import runpy, sys, types
plain = types.ModuleType("trirail.kinematics.compiled")
plain.compiled = lambda *signatures, **options: lambda function: function
plain.inlined = lambda function: function
sys.modules[plain.__name__] = plain
print(runpy.run_path(sys.argv[1])["digest"]())
"""
"""Run with nothing compiled: every function is the one that is written."""


def motions(seed: int = 0) -> list[list[list[float]]]:
    """Return rows pose, velocity, acceleration [m, rad, s] along quintics from rest to rest, one for each goal.

    In sums and products alone, which are the same wherever IEEE 754 is.
    """
    rnd, pose, made = random.Random(seed), [0.0, 0.0, 0.0], []
    for _ in range(GOALS):
        goal = [rnd.uniform(-reach, reach) for reach in (0.06, 0.06, 0.5)]
        way = [end - begin for begin, end in zip(pose, goal, strict=True)]
        for point in range(POINTS):
            t = point / (POINTS - 1)
            share = t * t * t * (10.0 + t * (6.0 * t - 15.0)), 30.0 * t * t * (1.0 - t) * (1.0 - t)
            bend = 60.0 * t * (1.0 - t) * (1.0 - 2.0 * t)
            made.append(
                [
                    [begin + share[0] * by for begin, by in zip(pose, way, strict=True)],
                    [share[1] * by for by in way],
                    [bend * by for by in way],
                ]
            )
        pose = goal
    return made


def digest() -> str:
    """Return the SHA-256 of all setpoints of the symmetric robot."""
    import numpy as np
    from trirail.kinematics.geometry import Geometry
    from trirail.kinematics.robot import inverse_into

    legs, rows, found = Geometry.symmetric(0.3).packed(), np.empty((6, 3)), hashlib.sha256()
    for motion in motions():
        if inverse_into(legs, np.array(motion), rows):
            raise ValueError(f"{motion} has no sliders")
        found.update(rows.astype("<f8").tobytes())
    return found.hexdigest()


def test_compiled_setpoints_are_as_kept() -> None:
    assert digest() == KEPT.read_text(encoding="ascii").strip()


def test_the_recursion_in_plain_python_gives_the_same_bits() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PLAIN, str(Path(__file__))], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == KEPT.read_text(encoding="ascii").strip()


if __name__ == "__main__":
    KEPT.write_text(f"{digest()}\n", encoding="ascii")
