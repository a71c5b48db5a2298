"""Time-outs of the service's end, each of which leaves time for the one before it."""

from __future__ import annotations

from trirail_drivers.config import Drives

MAX_SHUTDOWN_S = 3.0
"""Maximum duration of the controlled stop when the service ends [s]. After this time, the drives quick-stop."""
MARGIN_S = 1.0
"""Time for everything that has no time-out of its own [s]."""


def stops_within(drives: Drives) -> float:
    """Return the maximum time for which the loop waits until the drives have lost power, or report that they keep it
    [s].
    """
    return MAX_SHUTDOWN_S + drives.stop_timeout + MARGIN_S


def loop_ends_within(drives: Drives) -> float:
    """Return the maximum time until the loop's process ends [s].

    It includes the time to close the drives, see trirail_drivers.driver.driver.Driver.close: another quick stop, and
    two answers of the drives' outputs.
    """
    return stops_within(drives) + drives.stop_timeout + 2.0 * drives.sdo_timeout + MARGIN_S
