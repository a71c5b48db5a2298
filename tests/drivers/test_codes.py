"""Error codes of drives in words: the standards' tables, and what is in none of them."""

from __future__ import annotations

import canopen.emcy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.cia402.codes import words


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (0x8611, "0x8611 (following error); look for what blocks the slider, or at limits and tuning"),
        (0x8130, "0x8130 (the master's heartbeat is missing); the service was stopped or too slow: trirail doctor"),
        (0x8140, "0x8140 (back from bus-off); look at cable, terminators and bitrate: trirail doctor"),
        (0x7305, "0x7305 (incremental encoder 1); look at the encoder and its cable"),
        (0x231F, "0x231F (current of the motor); look at motor, cable and load"),
        (0x2A00, "0x2A00 (current); look at motor, cable and load"),
        (0xFF07, "0xFF07 (the maker's own: see the drive's manual)"),
        (0xB000, "0xB000"),
    ],
)
def test_a_code_is_said_in_words(code: int, said: str) -> None:
    assert words(code) == said


@given(st.integers(0x1000, 0xFFFF))
def test_every_class_that_the_canopen_library_knows_has_words(code: int) -> None:
    known = str(canopen.emcy.EmcyError(code, 0, b"", 0.0).get_desc())
    assert ("(" in words(code)) or not known
    assert words(code).startswith(f"0x{code:04X}")
