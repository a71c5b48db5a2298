"""Compiled code is kept from one start to the next, and thrown away when any of its sources changes."""

import os
import re
import runpy
import shutil
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import trirail_drivers
from trirail.kinematics import compiled
from trirail_drivers.driver import row_updates

pytestmark = pytest.mark.long

COUNT = """
from trirail.kinematics import closed_forward, closure
functions = closure.inverse_into, closure.inverse_batch, closed_forward.forward_into, closed_forward.forward_batch
print(*(len(function.stats.cache_misses) for function in functions))
"""


def run(code: str, directory: Path) -> str:
    """Run code in a new interpreter, in which `trirail` is found in `directory` first."""
    environment = {**os.environ, "PYTHONPATH": str(directory)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=directory,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A folder trirail/kinematics with nothing in it but the decorator."""
    room = tmp_path / "trirail" / "kinematics"
    room.mkdir(parents=True)
    (tmp_path / "trirail" / "__init__.py").write_text("")
    (room / "__init__.py").write_text("")
    (room / "compiled.py").write_text(Path(compiled.__file__).read_text())
    return room


def test_a_second_start_compiles_nothing() -> None:
    root = Path(__file__).parents[2]
    run(COUNT, root)  # the first start, if there was none before
    assert run(COUNT, root) == "0 0 0 0"


@pytest.mark.core
def test_an_edit_of_inlined_code_is_noticed(room: Path, tmp_path: Path) -> None:
    """The constant is in one file, the function that is kept on disk in another, which does not change."""
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n"
        "from trirail.kinematics.recursion import inner\n"
        "@compiled('f8(f8)')\n"
        "def outer(x):\n"
        "    return inner(x)\n"
    )
    inner = "from trirail.kinematics.compiled import compiled\n@compiled()\ndef inner(x):\n    return {} * x\n"
    code = "from trirail.kinematics.closure import outer; print(outer(1.0), len(outer.stats.cache_misses))"
    (room / "recursion.py").write_text(inner.format(2.0))
    assert run(code, tmp_path) == "2.0 1"
    assert run(code, tmp_path) == "2.0 0"
    (room / "recursion.py").write_text(inner.format(3.0))
    assert run(code, tmp_path) == "3.0 1"


def test_kept_code_that_names_a_class_which_is_no_more_is_compiled_anew(room: Path, tmp_path: Path) -> None:
    """As after an update of the service, over what the version before has kept."""
    source = (
        "from typing import NamedTuple\n"
        "from trirail.kinematics.compiled import compiled\n"
        "class {0}(NamedTuple):\n"
        "    x: float\n"
        "@compiled()\n"
        "def doubled(value):\n"
        "    return 2.0 * value.x\n"
        "def twice(x):\n"
        "    return doubled({0}(x))\n"
    )
    code = "from trirail.kinematics.closure import doubled, twice; print(twice(1.0), len(doubled.stats.cache_misses))"
    for name in ("Before", "After"):
        (room / "closure.py").write_text(source.format(name))
        assert run(code, tmp_path) == "2.0 1"
        assert run(code, tmp_path) == "2.0 0"


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
@pytest.mark.parametrize(
    "damage", [lambda content: b"", lambda content: content[:-9], lambda content: bytes(len(content))]
)
def test_a_damaged_file_of_the_cache_is_compiled_anew(
    room: Path, tmp_path: Path, suffix: str, damage: Callable[[bytes], bytes]
) -> None:
    """A power failure leaves files empty, cut off or full of zeros."""
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n@compiled('f8(f8)')\ndef doubled(x):\n    return 2.0 * x\n"
    )
    code = "from trirail.kinematics.closure import doubled; print(doubled(1.0), len(doubled.stats.cache_misses))"
    assert run(code, tmp_path) == "2.0 1"
    assert run(code, tmp_path) == "2.0 0"
    (file,) = room.rglob(f"*{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert run(code, tmp_path) == "2.0 1"
    assert run(code, tmp_path) == "2.0 0"


def test_code_of_an_earlier_version_is_never_run(room: Path, tmp_path: Path) -> None:
    """Not even if its index is of this version, since the disk was full, or the power failed, before the new code was
    written.
    """
    source = "from trirail.kinematics.compiled import compiled\n@compiled('f8(f8)')\ndef times(x):\n    return {} * x\n"
    code = "from trirail.kinematics.closure import times; print(times(1.0))"
    (room / "closure.py").write_text(source.format(2.0))
    assert run(code, tmp_path) == "2.0"
    (room / "closure.py").write_text(source.format(3.0))
    full = "from numba.core.caching import IndexDataCacheFile as File\ndef fail(*_): raise OSError('full')\n"
    assert run(f"{full}File._save_data = fail\n{code}", tmp_path) == "3.0"
    assert run(code, tmp_path) == "3.0"


HOMELESS = """
import tempfile
from numba.core import caching
from numba.core.caching import UserProvidedCacheLocator
caching.CacheImpl._locator_classes = [UserProvidedCacheLocator]  # no other folder can be written
"""


def test_without_a_folder_of_its_own_compiled_code_is_in_one_for_temporary_files(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a user of the system without a home, whose installation cannot be written."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n@compiled('f8(f8)')\ndef doubled(x):\n    return 2.0 * x\n"
    )
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    code = f"{HOMELESS}\ntempfile.tempdir = {str(temporary)!r}\n" + (
        "from trirail.kinematics.closure import doubled; print(doubled(1.0), len(doubled.stats.cache_misses))"
    )
    assert run(code, tmp_path) == "2.0 1"
    assert run(code, tmp_path) == "2.0 0"
    (folder,) = temporary.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o777)  # others could exchange the code
    with pytest.raises(subprocess.CalledProcessError) as failed:
        run(code, tmp_path)
    assert (
        "does not belong to this user alone; set NUMBA_CACHE_DIR to a folder that can be written" in failed.value.stderr
    )


def test_a_user_without_a_home_gets_no_folder_in_the_working_directory(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HOME", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n@compiled('f8(f8)')\ndef doubled(x):\n    return 2.0 * x\n"
    )
    for name in ("temporary", "cwd"):
        (tmp_path / name).mkdir()
    code = f"""
import os, pwd, tempfile
from numba.core import caching
caching.CacheImpl._locator_classes.remove(caching.InTreeCacheLocator)  # the installation cannot be written
tempfile.tempdir = {str(tmp_path / "temporary")!r}
os.chdir({str(tmp_path / "cwd")!r})
pwd.getpwuid = {{}}.__getitem__  # the system does not know this user
from trirail.kinematics.closure import doubled
print(doubled(1.0))
"""
    assert run(code, tmp_path) == "2.0"
    assert not list((tmp_path / "cwd").iterdir())
    assert list((tmp_path / "temporary").glob("trirail-compiled-*/*/*.nbc"))


PACKAGE = Path(compiled.__file__).parents[1]
FOLDERS = sorted({file.parent for file in PACKAGE.rglob("*.py") if b"\n@compiled(" in file.read_bytes()})


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(PACKAGE)))
def test_every_room_with_compiled_code_belongs_to_the_fingerprint(folder: Path, tmp_path: Path) -> None:
    for file in PACKAGE.rglob("*.py"):
        (tmp_path / file.relative_to(PACKAGE)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, tmp_path / file.relative_to(PACKAGE))

    def fingerprint() -> str:
        return str(runpy.run_path(str(tmp_path / "kinematics" / "compiled.py"))["FINGERPRINT"])

    assert fingerprint() == compiled.FINGERPRINT
    edited = next(file for file in sorted(folder.glob("*.py")) if b"\n@compiled(" in file.read_bytes())
    with (tmp_path / edited.relative_to(PACKAGE)).open("a") as text:
        text.write("# edited\n")
    assert fingerprint() != compiled.FINGERPRINT


def test_every_file_of_the_drivers_that_compiled_code_uses_belongs_to_the_fingerprint() -> None:
    used = set()
    for file in [Path(row_updates.__file__), *(file for folder in FOLDERS for file in folder.glob("*.py"))]:
        text = file.read_text(encoding="utf-8")
        if "\n@compiled(" in text or file.name == "row_updates.py":
            for module, names in re.findall(r"^from trirail_drivers\.([\w.]+) import (.+)$", text, re.MULTILINE):
                inside = Path(trirail_drivers.__file__).parent / module.replace(".", "/")
                used |= {f"{module}/{name}" for name in names.split(", ")} if inside.is_dir() else {module}
    assert {f"{module.replace('.', '/')}.py" for module in used} == set(compiled.DRIVERS)


def test_processes_that_start_together_compile_once(room: Path, tmp_path: Path) -> None:
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n@compiled('f8(f8)')\ndef doubled(x):\n    return 2.0 * x\n"
    )
    code = "from trirail.kinematics.closure import doubled; print(len(doubled.stats.cache_misses))"
    command = [sys.executable, "-c", code]
    together = [subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    misses = [int(process.communicate(timeout=500)[0]) for process in together]
    assert sum(misses) == 1


def test_who_compiles_is_told_of_each_function_once(room: Path, tmp_path: Path) -> None:
    (room / "closure.py").write_text(
        "from trirail.kinematics.compiled import compiled\n"
        "@compiled('f8(f8)')\n"
        "def kept(x):\n"
        "    return 2.0 * x\n"
        "@compiled()\n"
        "def inlined(x):\n"
        "    return x\n"
        "@compiled(\n"
        "    'f8(f8)'\n"
        ")\n"
        "def other(x):\n"
        "    return inlined(x)\n"
    )
    code = (
        "from trirail.kinematics.compiled import FUNCTIONS, on_compile\n"
        "on_compile(print)\n"
        "import trirail.kinematics.closure\n"
        "print(FUNCTIONS)"
    )
    assert run(code, tmp_path).split() == ["kept", "other", "2"]
    assert run(code, tmp_path).split() == ["2"]


def test_only_functions_that_say_so_create_arrays(room: Path, tmp_path: Path) -> None:
    source = (
        "import numpy as np\n"
        "from trirail.kinematics.compiled import compiled\n"
        "@compiled('f8(i8)'{})\n"
        "def total(n):\n"
        "    return np.ones(n).sum()\n"
    )
    code = "from trirail.kinematics.closure import total; print(total(3))"
    (room / "closure.py").write_text(source.format(", allocates=True"))
    assert run(code, tmp_path) == "3.0"
    (room / "closure.py").write_text(source.format(""))
    with pytest.raises(subprocess.CalledProcessError) as refused:
        run(code, tmp_path)
    assert "np.ones(n)" in refused.value.stderr


@pytest.mark.parametrize("folder", ["kinematics", "control", "processes"])
def test_no_function_of_a_cycle_creates_arrays(folder: str) -> None:
    files = (Path(compiled.__file__).parents[1] / folder).rglob("*.py")
    assert not [file.name for file in files if "@compiled" in (text := file.read_text()) and "allocates=True" in text]


def test_only_functions_that_may_create_arrays_return_arrays() -> None:
    """A caller with `allocates` would free an array that another function returns too early."""
    import trirail.motion.path_planner
    import trirail.processes.loop  # noqa: F401

    returned = {each.py_func.__name__: str(each.py_func.__annotations__["return"]) for each in compiled._functions}
    assert [name for name, kind in returned.items() if "Array" in kind] == ["_sample_times"]
    (sampling,) = (each for each in compiled._functions if each.py_func.__name__ == "_sample_times")
    assert sampling.targetoptions["_nrt"]
