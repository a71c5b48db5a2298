"""What tests of drives share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from rigs import DriverRig


@pytest.fixture
def rigs() -> Iterator[list[Any]]:
    """A list for whatever has drives, which are closed at the end of the test."""
    made: list[Any] = []
    yield made
    for rig in made:
        rig.drives.close()


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
