"""What a process asks of the system for itself."""

from __future__ import annotations

import _ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from control_rig import CONFIG
from trirail.processes import realtime


def test_memory_is_released_whatever_the_folders_of_libraries_are_called(tmp_path: Path) -> None:
    folder = os.fsencode(tmp_path) + b"/caf\xe9"
    os.mkdir(folder)
    library = os.fsdecode(folder + b"/loaded.so")
    shutil.copy(_ctypes.__file__, library)
    load = f"import ctypes; ctypes.CDLL({library!r}); from trirail.processes import realtime; "
    code = f"{load}realtime.release_startup_memory(); print(ctypes.CDLL({library!r})._name.count('caf'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("1\n", "")


def test_memory_is_released_as_far_as_the_kernel_tells_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_smaps(_: Path, **_more: object) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(Path, "read_text", no_smaps)
    realtime.release_startup_memory()


def test_a_file_for_sleep_states_that_cannot_be_opened_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a security module forbids what the file's mode allows."""
    opened = []

    def forbidden(path: str, flags: int) -> int:
        opened.append(path)
        raise PermissionError(1, "Operation not permitted", path)

    monkeypatch.setattr(realtime, "_MEASURES", ())
    monkeypatch.setattr(os, "open", forbidden)
    assert realtime.acquire(CONFIG.loop) == ()
    assert opened == ["/dev/cpu_dma_latency"]


@pytest.mark.parametrize(("inherited", "score"), [(0, 500), (300, 800), (500, 1000), (900, 1000), (1000, 1000)])
def test_the_recorder_ends_first_whatever_score_the_service_inherits(inherited: int, score: int) -> None:
    code = (
        "from pathlib import Path; from trirail.processes.realtime import offer_to_oom_killer; "
        f"file = Path('/proc/self/oom_score_adj'); file.write_text('{inherited}'); "
        "offer_to_oom_killer(); print(int(file.read_text()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == (f"{score}\n", "")
