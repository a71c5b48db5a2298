"""An EDS is parsed once for all tests, for each drive that has it: parsing is half of what a simulated robot costs.

Each who asks gets objects of its own, by the file's content, so that a file that has changed is parsed anew. The warm
process does the same for the services that it forks.
"""

from __future__ import annotations

import functools
import io
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import canopen
from trirail_drivers.cia402 import eds
from trirail_drivers.simulated import dictionary

if TYPE_CHECKING:
    import pytest

_import_od, _compact_arrays, _sections_of = canopen.import_od, dictionary.compact_arrays, eds.sections_of


def pytest_configure(config: pytest.Config) -> None:
    """Stand between the drivers and what parses for them."""
    config.add_cleanup(stand_between)
    stand_between(import_od, compact_arrays, sections_of)


def stand_between(importing: Any = _import_od, compact: Any = _compact_arrays, sections: Any = _sections_of) -> None:
    """Have the drivers call these functions; without any, those that they call elsewhere."""
    canopen.import_od = importing
    dictionary.compact_arrays = compact
    eds.sections_of = sections


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


def sections_of(text: str) -> tuple[list[eds.Section], list[str]]:
    """In the place of eds.sections_of."""
    sections, notes = pickle.loads(_sections(text))
    return sections, notes


@functools.cache
def _sections(text: str) -> bytes:
    return pickle.dumps(_sections_of(text))
