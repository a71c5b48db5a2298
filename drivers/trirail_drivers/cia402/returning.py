"""Set-up of a CiA 402 drive that has restarted or reappeared; see trirail_drivers.driver.recovery."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Sequence
from functools import partial
from typing import Any, Final

from trirail_drivers.bus.frames import FrameSender
from trirail_drivers.cia402.axis import Cia402Axis
from trirail_drivers.cia402.drive_units import Scaling, lost_settings
from trirail_drivers.cia402.duplicate_node import ANSWERS_AFTER
from trirail_drivers.cia402.one_drive import HAS_POWER, Identity, SetUp, SetupTask, Start
from trirail_drivers.cia402.sdo import Remote
from trirail_drivers.cia402.sdo_client import Client
from trirail_drivers.cia402.setup import check_identifiers, configure_one
from trirail_drivers.driver.recovery import ReturningDrive
from trirail_drivers.driver.refusals import replacement_refusal
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import Clock

SETTLED_AFTER: Final = 2 * ANSWERS_AFTER
"""Number of SYNCs after a boot-up message, or a heartbeat in a state without PDOs. Within this time, another node with
the same id shows itself by answers."""
_NUMBERS: Final = {"vendor": "vendor", "product": "product code", "revision": "revision", "serial": "serial number"}
"""Fields of an Identity, and their names in CiA 301 (1018h)."""
_MAY_DIFFER: Final = ("revision", "serial")
"""Fields of an Identity in which a permitted replacement may differ from the previous drive."""


class ReturningCia402(ReturningDrive[Cia402Axis, SetUp, Start]):
    """CiA 402 drive that may have to be set up again, by `setup.configure_one`."""

    work, counted = "configuring", "objects"

    def __init__(
        self,
        axis: Cia402Axis,
        one: SetupTask,
        fastest: float | None,
        configured: Callable[[SetUp, Start], None],
        setups: Callable[[], Sequence[SetUp]],
    ) -> None:
        """`configured` lets the drive take part in the cycle, and may raise DriveError. `setups` returns the set-ups of
        all drives.
        """
        super().__init__(axis)
        self.one = one
        self._fastest = fastest
        self._configured = configured
        self._setups = setups

    def start_setup(self, sender: FrameSender, clock: Clock) -> tuple[Coroutine[Any, Any, tuple[SetUp, Start]], Client]:
        """Return a new set-up over SDO, and its client."""
        before = self.one.remote.client
        client = Client(sender, before.node, before.od, before.timeout, clock)
        remote = Remote(self.axis.name, client)
        remote.logs = False
        check = None if self.setup is None else partial(self._check_same, self.setup)
        one = self.one._replace(remote=remote, check=check)
        return configure_one(one, self._fastest, self._check_identifiers), client

    def record_setup(self, made: SetUp, answered: int) -> None:
        """Record a complete set-up. The home offset stays that of the first one, with which positions are compared."""
        first = self.setup.home_offset if self.setup is not None else made.home_offset
        super().record_setup(made._replace(home_offset=first), answered)

    def accept(self, made: SetUp, begun: Start) -> str:
        """Let the drive take part in the cycle. If its home offset has changed, the drive counts as not homed, and a
        warning is returned.
        """
        self._configured(made, begun)
        if self.setup is None or made.home_offset == self.setup.home_offset:
            return ""
        self.axis.homed = False
        return (
            f"drive {self.axis.name}: object 607C:00 (home offset) is {made.home_offset}, was "
            f"{self.setup.home_offset}: home it, or restore the offset and restart the service"
        )

    def interrupt(self) -> None:
        """Abandon the conversation. The cycle waits for the answer to its last request."""
        if isinstance(self.client, Client) and self.client.asked is not None:
            self.axis.note_request(self.client.clock(), self.client.asked)
        super().interrupt()

    def may_have_power(self, *, stopping: bool) -> bool:
        """Whether the statusword shows power, or the drive is silent while drives are `stopping`."""
        axis = self.axis
        if axis.restarted:
            return False
        return stopping if axis.silent else axis.state in HAS_POWER

    @property
    def cause(self) -> str:
        """Reason for a new set-up, as the drive has reported it; "" if it has fallen silent."""
        left = self.axis.left_operational and not self.axis.silent
        return "is not in NMT operational" if left else super().cause

    @property
    def settled(self) -> bool:
        """Whether another node with the same id has had time to show itself, since the drive booted or left NMT
        operational.
        """
        return self.axis.syncs >= max(self.booted_at, self.axis.left_at) + SETTLED_AFTER

    def has_answered(self, now: float) -> bool:
        """Whether the cycle's last SDO request has been answered or has timed out.

        The set-up must wait for this, since an SDO server handles one request at a time (CiA 301).
        """
        return self.axis.accepts_request(now)

    def _check_same(self, last: SetUp, now: Identity, scaling: Scaling | None) -> None:
        """Raise DriveError if the drive is not the previous one, or would move in another direction or scale."""
        name, allowed, before = self.axis.name, self.one.drive.allow_replacement, last.identity
        numbers = {words: (getattr(before, field), getattr(now, field)) for field, words in _NUMBERS.items()}
        may_differ = [_NUMBERS[field] for field in _MAY_DIFFER]
        replaced = replacement_refusal(name, numbers, may_differ, allowed=allowed)
        lost = "" if scaling is None else lost_settings(name, last.scaling, scaling)
        if text := replaced or lost:
            raise DriveError(text)

    def _check_identifiers(self, looked: SetUp) -> None:
        """Raise DriveError if the drive has a PDO identifier that another drive uses."""
        check_identifiers([*(made for made in self._setups() if made.name != self.axis.name), looked])
