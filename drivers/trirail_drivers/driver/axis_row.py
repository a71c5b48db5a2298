"""What is kept of one drive in memory that compiled code shares: a row of trirail_drivers.driver.cyclic.Cyclic.axes."""

from __future__ import annotations

import ctypes
import inspect
from typing import Any, Final

import numpy as np

NOWHERE: Final = -1
"""Of a place in a frame: it has no such number."""


class AxisRow(ctypes.Structure):
    """One drive's numbers, each in this one place: Python's attributes are the memory of the array."""

    position: float
    """Newest position [m]."""
    actual: int
    """Likewise [counts]."""
    heard: float
    """When a frame said last that the drive lives [s]."""
    status_heard: float
    """When it told its state last [s]."""
    statusword: int
    """The newest one."""
    seen_clear: int
    """Its bits that have been 0 since somebody began to watch."""
    syncs: int
    """How many SYNCs were sent."""
    sampled: int
    """The number of the SYNC at which the position was sampled."""
    late: int
    """Answers that came a cycle later than the one before: a drive that always takes so long is not late."""
    lost: int
    """SYNCs that were never answered, as far as later answers show."""
    between: bool
    """This cycle's frames have been read, and the next SYNC was not sent."""
    prompt: bool
    """The last position came before the cycle of its SYNC had read."""
    came: bool
    """A position has come in this cycle."""
    newest: int
    """Counts that came last."""
    step: int
    """How far these were from those before, where they differed."""
    stands_at: int
    """Counts where the slider has been."""
    stands_since: float
    """And since when [s]."""
    command_age: int
    """SYNCs since it was sent a command."""
    target: int
    """Position that was sent last, in its units, where these are whole."""
    offset: int
    """Velocity likewise."""
    wanted: float
    """Position that was written last [m]; NaN where none is to be sent."""
    wanted_rate: float
    """Velocity likewise [m/s]."""
    sent: float
    """Position that the last SYNC has sent, where setpoints wait for one [m]; NaN where it has sent none."""
    sent_rate: float
    """Velocity likewise [m/s]."""
    in_force: float
    """Position that the bus has taken last [m]; NaN where it has taken none."""

    # What stays as it is while cycles are quiet.
    floats: bool
    """Whether positions are 32-bit floats; else whole counts."""
    waits: bool
    """Whether setpoints go with the next SYNC; else at once."""
    follows_within: float
    """How far it may be from where it is to be [m]; infinite where nobody watches that."""
    counts_per_metre: float
    """Negative where counts fall as the slider position rises."""
    zero: float
    """Slider position at zero counts [m]."""
    velocity_per_metre: float
    """What velocities are multiplied with."""
    velocity_step: float
    """And then divided by."""
    velocity_bytes: int
    """So many bytes a velocity has."""
    still: float
    """Counts within which a slider stands."""
    heard_within: float
    """How old that may be [s]."""
    status_within: float
    """Likewise."""
    position_at: int
    """Where in its setpoint's frame the position goes."""
    velocity_at: int
    """Where the velocity goes; NOWHERE for none."""


_KINDS: Final[dict[str, Any]] = {"float": ctypes.c_double, "int": ctypes.c_int64, "bool": ctypes.c_bool}
AxisRow._fields_ = [(name, _KINDS[kind]) for name, kind in inspect.get_annotations(AxisRow).items()]
AXIS: Final = np.dtype(AxisRow)
"""The same for compiled code."""
