"""The rehearsal goes through what must come without delay, whatever the drives are, and leaves nothing behind."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from trirail.config import SIM, load
from trirail.control.control import Control
from trirail.processes.loop_process import rehearse
from trirail.wire.vocabulary import Mode

CONFIGS = sorted(file for file in (SIM, *(SIM.parent / "drives").glob("*.toml")))


@pytest.fixture
def modes(monkeypatch: pytest.MonkeyPatch) -> list[Mode]:
    """The modes that a control goes through, in their order."""
    seen: list[Mode] = []
    conclude = Control.conclude

    def watched(control: Control) -> None:
        conclude(control)
        if not seen or seen[-1] is not control.state.mode:
            seen.append(control.state.mode)

    monkeypatch.setattr(Control, "conclude", watched)
    return seen


@pytest.mark.long
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_stop_quick_stop_fault_and_a_lost_gateway_are_rehearsed(path: Path, modes: list[Mode]) -> None:
    gc.collect()
    before = os.listdir("/proc/self/fd")
    assert rehearse(load(path)) == ()
    up = [Mode.ENABLING, Mode.HOLDING, Mode.MOVING]
    stopped, faulted = [Mode.STOPPING, Mode.HOLDING, Mode.MOVING], [Mode.FAULT, Mode.DISABLED]
    assert modes == [
        Mode.DISABLED,
        *up,
        *stopped,
        *faulted,
        *up,
        *faulted,
        *up,
        Mode.STOPPING,
        Mode.HOLDING,
        Mode.DISABLED,
    ]
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= len(before)  # of other tests some may be closed meanwhile
