"""Compiled code is kept from one start to the next, and thrown away when any of its sources changes."""

import os
import subprocess
import sys
from pathlib import Path

from service import compiled

COUNT = """
from service import closure
functions = closure.inverse_into, closure.inverse_batch, closure.forward_into, closure.forward_batch
print(*(len(function.stats.cache_misses) for function in functions))
"""


def run(code: str, directory: Path) -> str:
    """Run code in a new interpreter, in which `service` is found in `directory` first."""
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


def test_a_second_start_compiles_nothing() -> None:
    root = Path(__file__).parents[1]
    run(COUNT, root)  # the first start, if there was none before
    assert run(COUNT, root) == "0 0 0 0"


def test_an_edit_of_inlined_code_is_noticed(tmp_path: Path) -> None:
    """The constant is in one file, the function that is kept on disk in another, which does not change."""
    package = tmp_path / "service"
    package.mkdir()
    for name in ("__init__.py", *compiled.SOURCES):
        (package / name).write_text("")
    (package / "compiled.py").write_text(Path(compiled.__file__).read_text())
    (package / "closure.py").write_text(
        "from service.compiled import compiled\n"
        "from service.recursion import inner\n"
        "@compiled('f8(f8)')\n"
        "def outer(x):\n"
        "    return inner(x)\n"
    )
    inner = "from service.compiled import compiled\n@compiled()\ndef inner(x):\n    return {} * x\n"
    code = "from service.closure import outer; print(outer(1.0), len(outer.stats.cache_misses))"
    (package / "recursion.py").write_text(inner.format(2.0))
    assert run(code, tmp_path) == "2.0 1"
    assert run(code, tmp_path) == "2.0 0"
    (package / "recursion.py").write_text(inner.format(3.0))
    assert run(code, tmp_path) == "3.0 1"
