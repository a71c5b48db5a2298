"""The rehearsal goes through what must come without delay, whatever the drives are, and leaves nothing behind."""

from __future__ import annotations

import gc
import os
import re
import tempfile
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from trirail.config import SIM, everything, load
from trirail.control.control import Control
from trirail.processes import loop_process
from trirail.processes.loop_process import STEP_WITHIN, rehearse
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


# ---------------------------------------------------------------------- configurations that make a robot slow, or odd

SHIPPED = sorted(SIM.parent.glob("*.toml"))
NUMBER = re.compile(r"(?<![\w.])-?\d[\d_]*(\.\d+)?(e[-+]?\d+)?(?![\w.])")
FACTORS = (1e-3, 1e-2, 0.1, 10.0, 1e2, 1e3)
LONGEST = 20 * STEP_WITHIN
"""More cycles than all steps of the rehearsal may take together."""


def scaled(text: str, rng: np.random.Generator) -> str:
    """A configuration with one of its numbers multiplied."""
    values = [
        (at + line.index("=") + found.start(), at + line.index("=") + found.end())
        for at, line in zip(np.cumsum([0, *map(len, text.splitlines(keepends=True))]), text.splitlines(), strict=False)
        if "=" in (code := line.partition("#")[0]) and '"' not in code
        for found in NUMBER.finditer(code[code.index("=") :])
    ]
    begin, end = values[rng.integers(len(values))]
    value = tomllib.loads(f"n = {text[begin:end]}")["n"]
    return f"{text[:begin]}{type(value)(value * rng.choice(FACTORS))!r}{text[end:]}"


@pytest.mark.generated(*range(8))
def test_a_configuration_with_any_number_multiplied_is_refused_or_starts(
    seed: int, tmp_path: Path, modes: list[Mode], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, cycles = np.random.default_rng(seed), 0
    solve = Control.solve

    def counted(control: Control, *given: object) -> object:
        nonlocal cycles
        cycles += 1
        return solve(control, *given)

    path = tmp_path / "scaled.toml"
    path.write_text(scaled(SHIPPED[int(rng.integers(len(SHIPPED)))].read_text(), rng))
    found = everything(path)
    if found.mistakes:
        assert all(mistake.key and mistake.text for mistake in found.mistakes)
        return
    monkeypatch.setattr(Control, "solve", counted)
    rehearse(found.config)
    assert cycles < LONGEST
    assert modes[0] is Mode.DISABLED


def test_a_robot_that_stops_slowly_starts_and_lacks_what_was_not_rehearsed(
    modes: list[Mode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_process, "STEP_WITHIN", 20)
    config = load(SIM)
    platform = msgspec.structs.replace(config.limits.platform, jerk=(0.004, 0.004, 0.024))
    config = msgspec.structs.replace(config, limits=msgspec.structs.replace(config.limits, platform=platform))
    assert rehearse(config) == ("rehearsed stops: the robot was still stopping after 20 cycles",)
    assert modes[-1] is Mode.STOPPING


@pytest.mark.parametrize("folder", ["x" * 100, "none"])
def test_where_no_sockets_can_be_made_the_robot_starts_and_lacks_what_was_not_rehearsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    (tmp_path / ("x" * 100)).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / folder))
    (lacking,) = rehearse(load(SIM))
    assert lacking.startswith("rehearsed stops: ")
