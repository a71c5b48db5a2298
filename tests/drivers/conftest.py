"""What tests of drives share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from rigs import Closing, DriverRig
from trirail_drivers.odrive.flat_endpoints import KNOWN_TABLES, Endpoint
from trirail_drivers.odrive.protections import ABSOLUTE_SETPOINTS


@pytest.fixture
def closing() -> Iterator[Closing]:
    """Gives back what it is given, whatever has drives; these are closed at the end of the test."""
    with ExitStack() as kept:

        def closing(rig: Any) -> Any:
            kept.callback(rig.drives.close)
            return rig

        yield closing


@pytest.fixture
def ready(new: DriverRig[Any, Any]) -> DriverRig[Any, Any]:
    """Drives that are set up, without power; a module's fixture `new` has them as they were switched on."""
    new.ready()
    return new


@pytest.fixture
def enabled(ready: DriverRig[Any, Any]) -> DriverRig[Any, Any]:
    """Drives with power, holding their position."""
    ready.enable()
    ready.bus.sent.clear()
    return ready


@pytest.fixture
def absolute_odrives(monkeypatch: pytest.MonkeyPatch) -> None:
    """ODrives tell that their positions are absolute, as they do where a user gives their flat_endpoints.json."""
    for table in KNOWN_TABLES:
        monkeypatch.setitem(table.endpoints, ABSOLUTE_SETPOINTS, Endpoint(900, "bool"))
