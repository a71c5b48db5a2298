"""What tests of drives share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from rigs import Closing, DriverRig


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
