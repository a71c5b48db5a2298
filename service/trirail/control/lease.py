"""Management of the lease, the exclusive right of one user to move the robot.

The client of the user must renew the lease regularly. The lease is managed by the control, not by the gateway. The
lease therefore ends if the client, the network or the gateway fails. The time-out is counted in cycles, because a
replay of a recorded session must give the same result.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Level
from trirail.wire.vocabulary import AcquireLease, LeasePolicy, ReleaseLease

REMEMBERED_IDS = 1000
"""Number of ended leases that are remembered, so that a late renewal cannot revive an ended lease."""


class LeaseChange(NamedTuple):
    """Message that announces a change of the lease holder."""

    level: Level
    message: EventText


class _Lease(NamedTuple):
    user: str
    id: str | None
    timeout: float
    alive_until: int
    """Last cycle of the lease if the lease is not renewed."""


class LeaseArbiter:
    """Current lease, and the rules for acquiring, renewing and releasing a lease."""

    def __init__(self, policy: LeasePolicy, period: float) -> None:
        self._required = policy == "required"
        self._period = period
        self._held: _Lease | None = None
        self._ended: dict[tuple[str, str], str] = {}
        """Reasons why leases have ended. The keys are user and id of the lease."""

    @property
    def user(self) -> str | None:
        """Name of the user who holds the lease; None if no user holds the lease."""
        return self._held.user if self._held is not None else None

    @property
    def alive_until(self) -> float:
        """Last cycle of the lease if the lease is not renewed; infinite if no user holds a lease."""
        return self._held.alive_until if self._held is not None else math.inf

    def check(self, user: str) -> None:
        """Raise RefusedError if the user is not allowed to move the robot now."""
        if self._held is None:
            if self._required:
                raise RefusedError(
                    RefusalCode.NO_LEASE,
                    "no user holds the lease, which this robot requires for motion: send acquire first",
                )
        elif self._held.user != user:
            raise RefusedError(
                RefusalCode.LEASED, f"{self._held.user} holds the lease: goals and commands of other users are refused"
            )

    def acquire(self, user: str, lease: AcquireLease, cycle: int) -> LeaseChange | None:
        """Grant or renew a lease. Return the announcement of a new holder, or None after a renewal.

        Raises RefusedError if the lease with this id has ended, or if another client holds the lease and `lease.force`
        is not set.
        """
        before = self._held
        if lease.id is not None and (why := self._ended.get((user, lease.id))) is not None:
            raise RefusedError(RefusalCode.LEASE_OVER, f"{why}: acquire a new lease")
        again = before is not None and (before.user, before.id) == (user, lease.id)
        change = (
            None
            if again
            else LeaseChange("info", coded(f"lease acquired by {user}", EventCode.LEASE_ACQUIRED, user=user))
        )
        if before is not None and not again:
            if not lease.force:
                whose = "another client of the same user" if before.user == user else before.user
                problem = f"{whose} holds the lease: wait until it is free, or take it over"
                raise RefusedError(RefusalCode.LEASED, problem)
            words = f"lease taken over by {user} from {before.user}"
            text = coded(words, EventCode.LEASE_TAKEN_OVER, user=user, before=before.user)
            change = self._end("warning", text)
        self._held = _Lease(user, lease.id, lease.timeout, cycle + round(lease.timeout / self._period))
        return change

    def release(self, user: str, lease: ReleaseLease) -> LeaseChange:
        """Release the lease of a user. Raises RefusedError if the user does not hold this lease."""
        held = self._held
        if held is not None and held.user == user and lease.id in (None, held.id):
            return self._end("info", coded(f"lease released by {user}", EventCode.LEASE_RELEASED, user=user))
        if lease.id is not None and (why := self._ended.get((user, lease.id))) is not None:
            raise RefusedError(RefusalCode.LEASE_OVER, f"{why}: there is nothing to release")
        if held is None:
            raise RefusedError(RefusalCode.NO_LEASE, "no user holds the lease: there is nothing to release")
        whose = "another client of the same user" if held.user == user else held.user
        raise RefusedError(RefusalCode.LEASED, f"{whose} holds the lease: only the holder can release it")

    def expire(self, cycle: int) -> LeaseChange | None:
        """End the lease if it was not renewed in time. Return None if there is no lease or the lease is still valid."""
        held = self._held
        if held is None or cycle <= held.alive_until:
            return None
        words = f"lease of {held.user} has expired: it was not renewed within {held.timeout:g} s"
        expired = coded(words, EventCode.LEASE_EXPIRED, user=held.user, timeout=held.timeout)
        return self._end("warning", expired)

    def _end(self, level: Level, why: EventText) -> LeaseChange:
        held, self._held = self._held, None
        if held is not None and held.id is not None:
            self._ended[held.user, held.id] = why.text
            if len(self._ended) > REMEMBERED_IDS:
                del self._ended[next(iter(self._ended))]
        return LeaseChange(level, why)
