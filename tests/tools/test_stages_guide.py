"""configs/stages.md: its worked numbers are the service's."""

import math
import re

import pytest
from trirail.config import SIM, geometry, load
from trirail.kinematics.geometry import travels

GUIDE = SIM.with_name("stages.md").read_text(encoding="utf-8")
FILES = {"3-PRP": "uvw.toml", "3-PPR": "uvw-ppr.toml"}
ROWS = re.findall(
    r"^\| (.*?), (.*?), (.*?)° \| (3-P.P|3-P.R) \| (.*?) \| (.*?) \| (.*?) \|$", GUIDE.replace("−", "-"), re.M
)


@pytest.mark.parametrize(("x", "y", "degrees", "kind", "u", "v", "w"), ROWS)
def test_worked_numbers(x: str, y: str, degrees: str, kind: str, u: str, v: str, w: str) -> None:
    robot = geometry(load(SIM.with_name(FILES[kind])).geometry)
    pose = float(x) / 1e3, float(y) / 1e3, math.radians(float(degrees))
    assert (travels(robot, pose)[0] * 1e3).tolist() == pytest.approx([float(u), float(v), float(w)], abs=5.1e-7)


def test_small_angles() -> None:
    (u, v, w) = re.findall(r"small angles \| (\S+) \| (\S+) \| (\S+) \|", GUIDE.replace("−", "-"))[0]
    way = 57.5 * math.radians(1.0)
    assert [float(u), float(v), float(w)] == pytest.approx([way, -way, -way], abs=5.1e-7)
    assert len(ROWS) == 4
