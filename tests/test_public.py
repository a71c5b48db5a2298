"""What `from trirail import …` offers, and what each name costs: nothing is loaded that was not asked for."""

import ast
import importlib
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import trirail
import trirail_drivers

HEAVY = ("numba", "numpy", "zenoh", "rerun", "can", "canopen", "ruckig", "rich", "cyclopts", "pandas")


def loaded_by(statement: str) -> set[str]:
    """Return the heavy packages that a new interpreter has loaded after a statement."""
    code = f"import sys\n{statement}\nprint(*(name for name in {HEAVY} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def top_level(*packages: ModuleType) -> Iterator[ast.stmt]:
    """Yield what stands at the top of each module of packages."""
    for package in packages:
        for file in Path(str(package.__file__)).parent.rglob("*.py"):
            yield from ast.parse(file.read_text(encoding="utf-8")).body


@pytest.mark.parametrize(
    ("statement", "loaded"),
    [
        ("import trirail; trirail.__version__; dir(trirail)", set()),
        ("from trirail import TrirailError, RefusedError, ServiceError, ConfigError, KinematicsError", set()),
        ("from trirail import Robot", {"zenoh"}),
        ("from trirail import Geometry, Leg, inverse, forward, jacobians", {"numba", "numpy"}),
        ("from trirail import read", {"numpy", "rerun"}),
        ("from trirail.cli import app", {"rich", "cyclopts"}),
        ("from trirail.telemetry.sessions import find", set()),
        ("from trirail.config import SIM, load; load(SIM)", {"numpy", "can", "canopen"}),
        ("from trirail.processes import supervisor", {"numpy"}),
        ("from trirail.processes import gateway", {"numpy", "zenoh"}),
        ("from trirail.motion import motion_planner", {"numpy", "numba", "ruckig"}),
        ("from trirail.processes import loop_process", {"numpy", "numba", "ruckig", "can", "canopen"}),
        ("from trirail.processes import recording", {"numpy", "rerun"}),
    ],
)
@pytest.mark.long
def test_each_name_loads_what_it_needs_and_no_more(statement: str, loaded: set[str]) -> None:
    assert loaded_by(statement) == loaded


def test_every_public_name_is_there_and_is_the_one_at_its_home() -> None:
    assert set(trirail.__all__) == {*trirail._MODULE_OF, "__version__"}
    assert set(trirail.__all__) <= set(dir(trirail))
    for name, home in trirail._MODULE_OF.items():
        assert getattr(trirail, name) is getattr(importlib.import_module(home), name)


def test_no_two_classes_of_the_packages_share_a_name() -> None:
    names = Counter(node.name for node in top_level(trirail, trirail_drivers) if isinstance(node, ast.ClassDef))
    assert [name for name, count in names.items() if count > 1] == []


def test_no_two_type_aliases_of_the_drivers_share_a_name() -> None:
    assigned = (node.targets[0] for node in top_level(trirail_drivers) if isinstance(node, ast.Assign))
    names = Counter(target.id for target in assigned if isinstance(target, ast.Name) and target.id[0] != "_")
    assert [name for name, count in names.items() if count > 1 and not name.isupper()] == []


def test_what_is_not_there_is_said_as_python_does() -> None:
    with pytest.raises(AttributeError, match="module 'trirail' has no attribute 'Robbot'"):
        trirail.Robbot  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'Robbot'"):
        from trirail import Robbot  # noqa: F401
