"""Gives memory back that starting has touched and running does not need."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from pathlib import Path

_MADV_DONTNEED = 4

_libc = ctypes.CDLL(None)
_libc.madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


def trim() -> None:
    """Collect garbage, and return to the system what is free."""
    gc.collect()
    _libc.malloc_trim(0)


def give_back() -> None:
    """Trim, and unmap what of libraries their files have as well.

    Loading a library touches most of it, LLVM's 68 MB for instance; what is needed of it later comes from the page
    cache again.
    """
    trim()
    for start, end in _clean():
        _libc.madvise(start, end - start, _MADV_DONTNEED)


def _clean() -> Iterator[tuple[int, int]]:
    """Yield the addresses of each mapping of a library that is only read and has nothing of this process's own."""
    path, rights, start, end = "", "", 0, 0
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        first, *rest = line.split()
        if not first.endswith(":"):
            start, end = (int(address, 16) for address in first.split("-"))
            rights, path = rest[0], rest[-1]
        elif first == "Anonymous:" and rest[0] == "0" and rights[1] == "-" and ".so" in path:
            yield start, end
