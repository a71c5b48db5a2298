"""The lease: who alone may move the robot, for as long as his client gives signs of life. One at a time, or nobody.

It is kept here, behind gateway and planner, so that whatever is lost on the way from the holder's hand ends it: his
program, the network, the gateway. Time is counted in cycles, so that a recorded session comes out again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from trirail.errors import RefusalCode, RefusedError
from trirail.wire.messages import Level
from trirail.wire.vocabulary import AcquireLease, LeasePolicy, ReleaseLease

REMEMBERED_IDS = 1000
"""Leases that have ended and do not come back by a late sign of life; older ones are forgotten."""


class LeaseChange(NamedTuple):
    """The lease has another holder, or none: what everyone is told."""

    level: Level
    message: str


class _Held(NamedTuple):
    user: str
    id: str | None
    timeout: float
    alive_until: int
    """The cycle in which it ends unless there has been a sign of life."""


class LeaseArbiter:
    """Who holds it, and what follows. `check` says whether a user may move the robot."""

    def __init__(self, policy: LeasePolicy, period: float) -> None:
        self._required = policy == "required"
        self._period = period
        self._held: _Held | None = None
        self._over: dict[tuple[str, str], str] = {}
        """Leases that have ended, by user and id, and why."""

    @property
    def user(self) -> str | None:
        """Who holds it; None for nobody."""
        return self._held.user if self._held is not None else None

    @property
    def alive_until(self) -> float:
        """The last cycle in which it is held without another sign of life; infinite where nobody holds it."""
        return self._held.alive_until if self._held is not None else math.inf

    def check(self, user: str) -> None:
        """Raise RefusedError where a user's goals and commands do not move the robot now."""
        if self._held is None:
            if self._required:
                raise RefusedError(
                    RefusalCode.NO_LEASE,
                    "nobody holds the lease, and the robot moves for its holder alone: send acquire first",
                )
        elif self._held.user != user:
            raise RefusedError(
                RefusalCode.LEASED, f"{self._held.user} holds the lease: only his goals and commands count"
            )

    def acquire(self, user: str, lease: AcquireLease, cycle: int) -> LeaseChange | None:
        """Let a user have the lease; None for a sign of life of who has it. Raises RefusedError."""
        before = self._held
        if lease.id is not None and (why := self._over.get((user, lease.id))) is not None:
            raise RefusedError(RefusalCode.LEASE_OVER, f"{why}: acquire a new one")
        again = before is not None and (before.user, before.id) == (user, lease.id)
        change = None if again else LeaseChange("info", f"lease acquired by {user}")
        if before is not None and not again:
            if not lease.force:
                whose = "another client of the same user" if before.user == user else before.user
                problem = f"{whose} holds the lease: wait until it is free, or take it over"
                raise RefusedError(RefusalCode.LEASED, problem)
            change = self._end("warning", f"lease taken over by {user} from {before.user}")
        self._held = _Held(user, lease.id, lease.timeout, cycle + round(lease.timeout / self._period))
        return change

    def release(self, user: str, lease: ReleaseLease) -> LeaseChange:
        """Let a user give his lease back. Raises RefusedError where he has none, or not that one."""
        held = self._held
        if held is not None and held.user == user and lease.id in (None, held.id):
            return self._end("info", f"lease released by {held.user}")
        if lease.id is not None and (why := self._over.get((user, lease.id))) is not None:
            raise RefusedError(RefusalCode.LEASE_OVER, f"{why}: there is nothing to release")
        if held is None:
            raise RefusedError(RefusalCode.NO_LEASE, "nobody holds the lease: there is nothing to release")
        whose = "another client of the same user" if held.user == user else held.user
        raise RefusedError(RefusalCode.LEASED, f"{whose} holds the lease, and only its holder can release it")

    def silent(self, cycle: int) -> LeaseChange | None:
        """End the lease where no sign of life has come in time."""
        held = self._held
        if held is None or cycle <= held.alive_until:
            return None
        return self._end("warning", f"lease of {held.user} is over: no sign of life for {held.timeout:g} s")

    def _end(self, level: Level, why: str) -> LeaseChange:
        held, self._held = self._held, None
        if held is not None and held.id is not None:
            self._over[held.user, held.id] = why
            if len(self._over) > REMEMBERED_IDS:
                del self._over[next(iter(self._over))]
        return LeaseChange(level, why)
