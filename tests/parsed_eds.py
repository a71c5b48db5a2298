"""An EDS is parsed once for all tests, for each drive that has it: parsing is half of what a simulated robot costs.

Each who asks gets objects of its own, by the file's content, so that a file that has changed is parsed anew.
"""

from __future__ import annotations

import functools
import io
import pickle
from pathlib import Path
from typing import Any

import canopen
import pytest
from trirail_drivers.simulated import dictionary

_import_od, _compact_arrays = canopen.import_od, dictionary.compact_arrays


def pytest_configure(config: pytest.Config) -> None:
    """Stand between the drivers and what parses for them."""
    patches = pytest.MonkeyPatch()
    patches.setattr(canopen, "import_od", import_od)
    patches.setattr("trirail_drivers.simulated.dictionary.compact_arrays", compact_arrays)
    config.add_cleanup(patches.undo)


def import_od(source: Any, node_id: int | None = None) -> canopen.ObjectDictionary:
    """In the place of canopen.import_od."""
    if not hasattr(source, "read"):
        return _import_od(source, node_id)
    objects = pickle.loads(_objects(source.read(), source.name, node_id))
    assert isinstance(objects, canopen.ObjectDictionary)
    return objects


@functools.cache
def _objects(text: str, name: str, node: int | None) -> bytes:
    source = io.StringIO(text)
    source.name = name
    return pickle.dumps(_import_od(source, node))


def compact_arrays(file: Path) -> dict[int, int]:
    """In the place of simulated.dictionary.compact_arrays."""
    return _arrays(file, file.read_bytes())


@functools.cache
def _arrays(file: Path, _content: bytes) -> dict[int, int]:
    return _compact_arrays(file)
