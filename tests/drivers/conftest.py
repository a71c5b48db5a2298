"""What tests of drives share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest


@pytest.fixture
def rigs() -> Iterator[list[Any]]:
    """A list for whatever has drives, which are closed at the end of the test."""
    made: list[Any] = []
    yield made
    for rig in made:
        rig.drives.close()
