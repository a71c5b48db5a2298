"""Frames: the worst-case arithmetic, and the CiA 402 state machine as tables."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.interface import PowerState
from trirail_drivers.timing import BusTiming, frame_bits

P = PowerState
MEGABIT = BusTiming(1_000_000)


@given(n=st.integers(0, 8), pattern=st.integers(0, 2**98 - 1))
def test_no_content_makes_a_frame_longer_than_the_worst_case(n: int, pattern: int) -> None:
    open_to_stuffing = 34 + 8 * n
    bits = [pattern >> i & 1 for i in range(open_to_stuffing)]
    assert open_to_stuffing + _stuff_bits(bits) + 13 <= frame_bits(n)


def _stuff_bits(bits: list[int]) -> int:
    """Stuff bits a transmitter inserts: after five equal ones, itself counted in the next run."""
    stuffed, last, run = 0, None, 0
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - bit, 1
    return stuffed


@pytest.mark.parametrize("n", range(9))
def test_worst_case_is_reached(n: int) -> None:
    bits = [0] * 5 + [i // 4 % 2 ^ 1 for i in range(34 + 8 * n - 5)]
    assert len(bits) + _stuff_bits(bits) + 13 == frame_bits(n)


def test_a_kilohertz_fills_three_quarters_of_a_megabit() -> None:
    assert canopen_frames.TRAFFIC.cycle_seconds(MEGABIT) == pytest.approx(745e-6)
    assert canopen_frames.TRAFFIC.bus_load(1000, MEGABIT, 0.1) == pytest.approx(0.75, abs=0.001)


@given(bitrate=st.sampled_from([125_000, 250_000, 500_000, 1_000_000]), heartbeat=st.floats(0.05, 1.0))
def test_the_highest_rate_fills_the_bus(bitrate: int, heartbeat: float) -> None:
    rate = canopen_frames.TRAFFIC.highest_rate(BusTiming(bitrate), heartbeat)
    assert canopen_frames.TRAFFIC.bus_load(rate, BusTiming(bitrate), heartbeat) == pytest.approx(1.0)


@pytest.mark.parametrize("state", list(PowerState))
def test_stopping_asks_the_same_of_every_state(state: PowerState) -> None:
    assert canopen_frames.controlword(state, P.QUICK_STOP_ACTIVE) == 0x02
    assert canopen_frames.controlword(state, P.SWITCH_ON_DISABLED) == 0x00


@pytest.mark.parametrize("state", list(PowerState))
@pytest.mark.parametrize("wanted", [P.OPERATION_ENABLED, P.QUICK_STOP_ACTIVE, P.SWITCH_ON_DISABLED])
def test_no_transition_resets_a_fault(state: PowerState, wanted: canopen_frames.TargetState) -> None:
    assert not canopen_frames.controlword(state, wanted) & canopen_frames.FAULT_RESET
