"""Check of an ODrive that has restarted or reappeared; see trirail_drivers.driver.recovery."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from typing import Any, Final

from trirail_drivers.bus.frames import FrameSender
from trirail_drivers.driver.duplicate_node import far_apart
from trirail_drivers.driver.recovery import ReturningDrive
from trirail_drivers.driver.refusals import replacement_refusal
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import Clock
from trirail_drivers.odrive.axis import OdriveAxis
from trirail_drivers.odrive.client import OdriveClient
from trirail_drivers.odrive.protections import MAY_SEND_UNASKED
from trirail_drivers.odrive.setup import OdriveIdentity, OdriveSetup, OdriveSetupTask, OdriveStart, configure_one

COUNTED_TURNS: Final = 1.0
"""Distance from zero [turns] at which a position does not count from the place where the drive was switched on, if the
slider has not moved.
"""
UNMOVED_TURNS: Final = 0.1
"""Difference of positions of a slider that has not moved [turns]."""


class ReturningOdrive(ReturningDrive[OdriveAxis, OdriveSetup, OdriveStart]):
    """ODrive that may have to be set up again, by `setup.configure_one`."""

    work, counted = "checking its settings", "answers"

    def __init__(self, axis: OdriveAxis, one: OdriveSetupTask, configured: Callable[[OdriveStart], None]) -> None:
        """`configured` lets the drive take part in the cycle."""
        super().__init__(axis)
        self.one = one
        self._configured = configured

    def start_setup(
        self, sender: FrameSender, clock: Clock
    ) -> tuple[Coroutine[Any, Any, tuple[OdriveSetup, OdriveStart]], OdriveClient]:
        """Return a new set-up of the drive, and its client."""
        one = self.one
        client = OdriveClient(sender, self.axis.name, self.axis.node, one.drives.sdo_timeout, clock)
        return configure_one(one._replace(client=client), self._check), client

    def record_setup(self, made: OdriveSetup, answered: int) -> None:
        """Record a complete set-up. Two positions show a second drive only if they are sent on request alone."""
        super().record_setup(made, answered)
        unasked = MAY_SEND_UNASKED.intersection(made.missing_protections)
        self.axis.far_apart = math.inf if unasked else far_apart(self.axis)

    def accept(self, made: OdriveSetup, begun: OdriveStart) -> str:
        """Let the drive take part in the cycle.

        A drive whose position is relative counts as not homed after every set-up except the first, which accepts the
        position as it is: the drive has restarted, or it may have lost its supply and finished booting while silent.
        """
        relative, last = made.relative, self.axis.scale.exact(self.axis.position)
        if relative is None:
            relative = not (self.axis.homed and _has_kept(last, begun.turns))
        self._configured(begun)
        self.axis.homed = self.setup is None or not relative
        return ""

    def may_have_power(self, *, stopping: bool) -> bool:
        """Whether the drive's heartbeat shows power, or the drive is silent while drives are `stopping`."""
        if self.axis.silent:
            return stopping
        return self.axis.powered

    def _check(self, identity: OdriveIdentity) -> None:
        """Raise DriveError if the drive is neither the previous drive nor a permitted replacement.

        Raises DriveTimeout if the drive has not reported its serial number, but has done so before.
        """
        if self.setup is None:
            return
        before = self.setup.identity
        if before.serial is not None and identity.serial is None:
            raise DriveTimeout(self.axis.name, "answer to Address", self.one.drives.sdo_timeout)
        names = "firmware", "hardware"
        numbers: dict[str, tuple[object, object]] = dict(
            zip(names, zip(before.version.dotted, identity.version.dotted, strict=True), strict=True)
        )
        if before.serial is not None:
            numbers["serial number"] = before.serial, identity.serial
        allowed = self.one.drive.allow_replacement
        if text := replacement_refusal(self.axis.name, numbers, ("firmware", "serial number"), allowed=allowed):
            raise DriveError(text)


def _has_kept(last: float, turns: float) -> bool:
    """Whether a drive has certainly kept its position, given the positions before and after a restart [turns]."""
    return abs(turns) > COUNTED_TURNS and abs(turns - last) < UNMOVED_TURNS
