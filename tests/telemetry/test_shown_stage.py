"""Who shows a robot knows its mechanism from what its service says of itself."""

import msgspec
import pytest
from trirail.config import SIM, geometry, load
from trirail.processes.publications import info
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.wire.state import Info


@pytest.mark.parametrize("name", ["sim", "uvw", "xxy", "uvw-ppr"])
def test_the_geometry_goes_over_the_wire(name: str) -> None:
    config = load(SIM.with_name(f"{name}.toml"))
    told = msgspec.json.decode(msgspec.json.encode(info(config)), type=Info)
    assert told.mechanism == config.geometry.kind
    shown = DrawnRobot.from_info(told)
    assert shown.geometry == geometry(config.geometry)
    assert shown.limits == config.limits
