"""A protocol is registered once: nothing else knows its name, and what it says of its traffic is so."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import trirail
import trirail_drivers
from conftest import Rig
from drivers.test_odrive import odrives
from trirail.config import SIM, load
from trirail_drivers import config
from trirail_drivers.protocols import PROTOCOLS

ROBOT = load(SIM)
CONFIGS = {"cia402": ROBOT, "odrive": odrives(ROBOT)}


def test_the_configuration_names_what_is_registered() -> None:
    assert get_args(get_type_hints(config.Drives)["protocol"]) == tuple(PROTOCOLS)
    assert all(name == protocol.name for name, protocol in PROTOCOLS.items())


def test_nothing_else_knows_a_protocols_name() -> None:
    named = {
        str(path.relative_to(root))
        for root in (Path(trirail.__file__).parent, Path(trirail_drivers.__file__).parent)
        for path in root.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in PROTOCOLS
    }
    # The simulated servo's EDS lies in the folder of that name.
    assert named == {"config.py", "protocols/cia402.py", "protocols/odrive.py", "simulated/drive.py"}


@pytest.mark.parametrize("name", PROTOCOLS)
def test_no_cycle_sends_more_than_is_said(name: str) -> None:
    rig = Rig(CONFIGS[name])
    sent = []

    def cycles(number: int) -> None:
        for _ in range(number):
            rig.cycle()
            sent.append(len(rig.sent))

    for command in ("enable", "disable", "enable"):
        rig.order(command)
        sent.append(len(rig.sent))
        cycles(1000)
    rig.bus.shutdown()
    assert PROTOCOLS[name].traffic.most_sent - 1 <= max(sent) <= PROTOCOLS[name].traffic.most_sent
