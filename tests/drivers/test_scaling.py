"""Metres and counts: there and back, and what a drive's 32 bits cannot hold is refused."""

from __future__ import annotations

import math

import pytest
from control_rig import CONFIG
from hypothesis import given
from hypothesis import strategies as st
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.units import Units
from trirail_drivers.config import Drive
from trirail_drivers.driver.row_updates import scale_setpoint
from trirail_drivers.driver.scaling import INT32_MAX, UINT32_MAX, Scale, scale_of
from trirail_drivers.errors import DriveError

drives = st.builds(
    Drive,
    node=st.just(1),
    counts_per_metre=st.floats(1e3, 1e8),
    direction=st.sampled_from([1, -1]),
    offset=st.floats(-1.0, 1.0),
)
positions = st.floats(-2.0, 2.0)


def units_of(scale: Scale) -> Units:
    """Counts, counts/s, counts/s²."""
    return Units(scale, scale.counts_per_metre, abs(scale.counts_per_metre))


def velocity_sent(scale: Scale, velocity: float) -> int | None:
    """What a drive is sent as its velocity, in counts/s, for a velocity in m/s; None if that is refused."""
    axis = Cia402Axis("A", 1, scale, CONFIG.drives)
    return axis.offset if scale_setpoint(axis, scale.offset, velocity) else None


@given(drive=drives, position=positions)
def test_metres_to_counts_and_back_is_within_half_a_count(drive: Drive, position: float) -> None:
    scale = scale_of("A", drive)
    error = abs(scale.metres(scale.counts(position)) - position)
    assert error <= 0.5 / drive.counts_per_metre + 1e-15


@given(drive=drives, counts=st.integers(-INT32_MAX, INT32_MAX))
def test_counts_to_metres_and_back_is_exact(drive: Drive, counts: int) -> None:
    scale = scale_of("A", drive)
    assert scale.counts(scale.metres(counts)) == counts


@given(drive=drives, position=positions, step=st.floats(1e-2, 1.0))
def test_direction_is_the_sign_of_counts_and_of_velocity(drive: Drive, position: float, step: float) -> None:
    scale = scale_of("A", drive)
    assert math.copysign(1, scale.counts(position + step) - scale.counts(position)) == drive.direction
    assert math.copysign(1, velocity_sent(scale, step) or 0) == drive.direction


@given(drive=drives)
def test_zero_counts_are_at_the_offset(drive: Drive) -> None:
    scale = scale_of("A", drive)
    assert scale.counts(drive.offset) == 0
    assert scale.metres(0) == drive.offset
    assert velocity_sent(scale, 0.0) == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_has_no_counts(value: float) -> None:
    scale = Scale(1e6, 0.0)
    with pytest.raises((ValueError, OverflowError)):
        scale.counts(value)
    assert velocity_sent(scale, value) is None


@pytest.mark.parametrize("offset", [2148.0, -2148.0, math.inf, math.nan])
def test_an_offset_beyond_int32_is_refused(offset: float) -> None:
    with pytest.raises(DriveError, match=r"drive B: .*32-bit"):
        scale_of("B", Drive(node=1, counts_per_metre=1e6, offset=offset))


def test_the_largest_offset_is_taken() -> None:
    scale = scale_of("A", Drive(node=1, counts_per_metre=1.0, offset=float(INT32_MAX)))
    assert scale.counts(0.0) == -INT32_MAX


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_windows_and_ramps_have_no_direction(direction: float) -> None:
    assert units_of(Scale(direction * 1e6, 0.3)).length("A", "following_error", 0.005) == 5000


@pytest.mark.parametrize("value", [1e-9, UINT32_MAX * 1e-6, math.inf, math.nan])
def test_a_window_that_means_none_is_refused(value: float) -> None:
    with pytest.raises(DriveError, match="drive C: following_error"):
        units_of(Scale(1e6, 0.0)).length("C", "following_error", value)
