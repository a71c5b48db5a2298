"""What a role may do at the page: that is offered there, and nothing else is passed on. The service decides again."""

from __future__ import annotations

from trirail.wire import access
from trirail.wire.vocabulary import Command, Role

GOAL, POSES, TAKEOVER = "goal", "poses", "takeover"
"""Permissions beside those of commands, which are called as these: to move, to teach poses, to take the lease over."""


def permissions(role: Role | None, takeover: Role) -> frozenset[str]:
    """Return what a role may, where `takeover` is the least that takes the lease over; None may nothing."""
    least = {GOAL: access.GOALS, POSES: access.POSES, TAKEOVER: takeover} | {each.value: each.role for each in Command}
    return frozenset(what for what, needed in least.items() if role is not None and role.includes(needed))
