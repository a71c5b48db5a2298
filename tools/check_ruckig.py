"""Check, before anything is installed, that Ruckig can be installed on this machine.

python tools/check_ruckig.py

On Linux, Ruckig 0.19 has ready-made packages for x86_64 and Python 3.11 to 3.14. Elsewhere pip compiles Ruckig, which
needs a C++ compiler and Python's headers. `make` runs this first, with the Python of the new environment.
"""

from __future__ import annotations

import platform
import shutil
import sys
import sysconfig
from pathlib import Path

NEWEST = (3, 14)
"""Newest Python for which there is a ready-made package."""


def is_compiled(system: str, machine: str, version: tuple[int, int]) -> bool:
    """Return whether pip has to compile Ruckig on a machine."""
    return system == "linux" and (machine != "x86_64" or version > NEWEST)


def missing(compiler: str | None, headers: Path) -> list[str]:
    """Return the Debian packages that the compilation lacks."""
    return ["g++"] * (compiler is None) + ["python3-dev"] * (not headers.is_file())


def main() -> int:
    """Print the next step of pip, or the missing packages; return the exit code."""
    machine = platform.machine()
    if not is_compiled(sys.platform, machine, sys.version_info[:2]):
        return 0
    here = f"{machine} and Python {platform.python_version()}"
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    packages = missing(compiler, Path(sysconfig.get_path("include"), "Python.h"))
    if packages:
        print(
            f"Ruckig has no ready-made package for {here}, so it is compiled, and this machine lacks what that needs. "
            f"Install it and run make again: sudo apt-get install {' '.join(packages)}",
            file=sys.stderr,
        )
        return 1
    print(f"Ruckig has no ready-made package for {here}: pip compiles it, which takes some minutes without output")
    return 0


if __name__ == "__main__":
    sys.exit(main())
