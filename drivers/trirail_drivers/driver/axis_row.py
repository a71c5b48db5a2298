"""State of one drive in memory shared with compiled code: a row of trirail_drivers.driver.cyclic.Cyclic.axes."""

from __future__ import annotations

import ctypes
import inspect
from typing import Any, Final

import numpy as np

NO_OFFSET: Final = -1
"""Offset of a number that a frame does not have."""
NOTHING_SENT: Final = -1
"""Value of `outputs_sent` before any outputs were sent."""


class AxisRow(ctypes.Structure):
    """State of one drive; the Python attributes are the memory of the array."""

    position: float
    """Newest position [m]."""
    actual: int
    """Newest position [counts]."""
    heard: float
    """Time of its last sign of life [s]."""
    status_heard: float
    """Time of its last statusword [s]."""
    statusword: int
    """Newest statusword."""
    seen_clear: int
    """Bits of the statusword that have been 0 since the driver cleared this."""
    syncs: int
    """Number of SYNCs sent."""
    sampled: int
    """Number of the SYNC at which the position was sampled."""
    late: int
    """Answers that came a cycle later than the previous one did: a constant delay is not late."""
    lost: int
    """SYNCs that were never answered, as far as later answers show."""
    between: bool
    """Whether this cycle's frames have been read, and the next SYNC was not sent."""
    prompt: bool
    """Whether the last position came before the frames of its SYNC's cycle were read."""
    came: bool
    """Whether a position has come in this cycle."""
    newest: int
    """Position received last [counts]."""
    step: int
    """Last difference between consecutive positions that was not 0 [counts]."""
    stands_at: int
    """Position at which the slider stands [counts]."""
    stands_since: float
    """Time since which it stands there [s]."""
    command_age: int
    """SYNCs since its last command."""
    target: int
    """Position sent last, in the drive's units, if these are integers."""
    offset: int
    """Velocity sent last, in the drive's units, if these are integers."""
    wanted: float
    """Position written last [m]; NaN if none waits to be sent."""
    wanted_rate: float
    """Velocity written last [m/s]."""
    sent: float
    """Position sent by the last SYNC, if setpoints wait for one [m]; NaN if none was sent."""
    sent_rate: float
    """Velocity sent by the last SYNC, if setpoints wait for one [m/s]."""
    in_force: float
    """Position that the bus took last [m]; NaN if it took none."""
    outputs: int
    """Wanted digital outputs: bits of 60FEh:01, within the mask."""
    outputs_sent: int
    """Digital outputs that the bus took last; NOTHING_SENT if it took none since the set-up."""
    inputs: int
    """Newest digital inputs: bits of 60FDh, within the mask."""

    # Constant while cycles are quiet.
    floats: bool
    """Whether positions are 32-bit floats; otherwise integers."""
    waits: bool
    """Whether setpoints are sent with the next SYNC; otherwise immediately."""
    follows_within: float
    """Window of the following error that the driver monitors [m]; infinite if it does not."""
    counts_per_metre: float
    """Negative where counts fall as the slider position rises."""
    zero: float
    """Slider position at zero counts [m]."""
    velocity_per_metre: float
    """Drive units of velocity per m/s, before the division by `velocity_step`."""
    velocity_step: float
    """Resolution of velocities in those units."""
    velocity_bytes: int
    """Size of a velocity in the setpoint's frame [bytes]."""
    still: float
    """Largest movement of a slider that counts as standing [counts]."""
    heard_within: float
    """Largest age of `heard` [s]."""
    status_within: float
    """Largest age of `status_heard` [s]."""
    position_at: int
    """Offset of the position in the setpoint's frame [bytes]."""
    velocity_at: int
    """Offset of the velocity in the setpoint's frame [bytes]; NO_OFFSET for none."""
    has_outputs: bool
    """Whether it has digital outputs."""
    maps_outputs: bool
    """Whether a frame of its own carries them; otherwise an SDO does, which only Python sends."""
    outputs_kept: int
    """Other bits of 60FEh:01, which are sent as they were at set-up: those of a drive without a mask 60FEh:02."""


_KINDS: Final[dict[str, Any]] = {"float": ctypes.c_double, "int": ctypes.c_int64, "bool": ctypes.c_bool}
AxisRow._fields_ = [(name, _KINDS[kind]) for name, kind in inspect.get_annotations(AxisRow).items()]
AXIS: Final = np.dtype(AxisRow)
"""AxisRow as a numpy type, for compiled code."""
