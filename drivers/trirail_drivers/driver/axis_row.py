"""State of one drive in memory shared with compiled code: one row of trirail_drivers.driver.cyclic.Cyclic.axes."""

from __future__ import annotations

import ctypes
import inspect
from typing import Any, Final

import numpy as np

_KINDS: Final[dict[str, Any]] = {"float": ctypes.c_double, "int": ctypes.c_int64, "bool": ctypes.c_bool}


def set_fields(structure: type[ctypes.Structure], **kinds: Any) -> None:
    """Make the annotated attributes of a structure its fields. `kinds` has the C types of further annotations."""
    types = _KINDS | kinds
    structure._fields_ = [(name, types[kind]) for name, kind in inspect.get_annotations(structure).items()]


NO_OFFSET: Final = -1
"""Offset that marks a value that a frame does not contain."""
NOTHING_SENT: Final = -1
"""Value of `outputs_sent` before any outputs were sent."""


class AxisRow(ctypes.Structure):
    """State of one drive; the Python attributes are views of the array's memory."""

    position: float
    """Newest position [m]."""
    actual: int
    """Newest position [counts]."""
    heard: float
    """Time of the last sign of life [s]."""
    status_heard: float
    """Time of the last statusword [s]."""
    statusword: int
    """Newest statusword."""
    syncs: int
    """Number of SYNCs sent."""
    sampled: int
    """Number of the SYNC at which the position was sampled."""
    late: int
    """Number of answers that arrived one cycle later than the answer before. A constant delay is not late."""
    lost: int
    """Number of SYNCs that were never answered. A SYNC is counted once a later SYNC has been answered."""
    between: bool
    """Whether this cycle's frames have been read and the next SYNC has not been sent."""
    prompt: bool
    """Whether the last position arrived before the frames of its SYNC's cycle were read."""
    came: bool
    """Whether a position has arrived in this cycle."""
    newest: float
    """Position received last, in drive units."""
    step: float
    """Last non-zero difference between consecutive positions, in drive units."""
    stands_at: int
    """Position at which the slider is at rest [counts]."""
    stands_since: float
    """Time since which the slider has been at rest there [s]."""
    command_age: int
    """Number of SYNCs since the last command to the drive."""
    target: float
    """Position written last, in drive units; a whole number unless `floats` is set."""
    offset: int
    """Velocity written last, in multiples of `velocity_step`."""
    controlword: int
    """Controlword sent last, if the drive has one."""
    wanted: float
    """Position written last [m]; NaN if none is waiting to be sent."""
    wanted_rate: float
    """Velocity written last [m/s]."""
    sent: float
    """Position sent with the last SYNC, if setpoints are sent with the SYNC [m]; NaN if none was sent."""
    sent_rate: float
    """Velocity sent with the last SYNC, if setpoints are sent with the SYNC [m/s]."""
    in_force: float
    """Position that the bus accepted last [m]; NaN if it has accepted none."""
    outputs: int
    """Wanted digital outputs: bits of 60FEh:01, limited to the mask."""
    outputs_sent: int
    """Digital outputs that the bus accepted last; NOTHING_SENT if it has accepted none since the set-up."""
    outputs_repeats: int
    """Number of frames that still repeat the outputs sent last, since a drive may have missed them."""
    inputs: int
    """Newest digital inputs: bits of 60FDh, limited to the mask."""

    # Constant while compiled code runs the cycles.
    floats: bool
    """Whether positions are 32-bit floats; otherwise they are integers."""
    waits: bool
    """Whether setpoints are sent with the next SYNC; otherwise immediately."""
    follows_within: float
    """Window of the following error that the driver monitors [m]; infinite if the driver does not monitor it."""
    counts_per_metre: float
    """Resolution of the encoder; negative if the counts decrease as the slider position increases."""
    zero: float
    """Slider position at zero counts [m]."""
    velocity_per_metre: float
    """Drive units of velocity per m/s, before the division by `velocity_step`."""
    velocity_step: float
    """Resolution of velocities, in drive units."""
    velocity_bytes: int
    """Size of a velocity in the setpoint frame [bytes]."""
    still: float
    """Largest movement at which the slider still counts as at rest [counts]."""
    far_apart: float
    """Difference between two positions after one SYNC above which they come from two sliders, in drive units."""
    heard_within: float
    """Largest age of `heard` [s]."""
    status_within: float
    """Largest age of `status_heard` [s]."""
    missed_limit: int
    """Number of consecutive unanswered SYNCs from which Python must run the cycle."""
    position_at: int
    """Offset of the position in the setpoint frame [bytes]."""
    velocity_at: int
    """Offset of the velocity in the setpoint frame [bytes]; NO_OFFSET if the frame has no velocity."""
    controlword_at: int
    """Offset of the controlword in the setpoint frame [bytes]; NO_OFFSET if the frame has no controlword."""
    has_outputs: bool
    """Whether the drive has digital outputs."""
    maps_outputs: bool
    """Whether the outputs are sent in a separate cyclic frame; otherwise Python sends them by SDO."""
    outputs_kept: int
    """Bits of 60FEh:01 outside the mask, sent unchanged since set-up; used for a drive without a mask 60FEh:02."""


set_fields(AxisRow)
AXIS: Final = np.dtype(AxisRow)
"""AxisRow as a numpy type, for compiled code."""
