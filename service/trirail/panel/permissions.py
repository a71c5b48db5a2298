"""Permissions of a role on the page. The page offers only permitted actions; the service checks each action again."""

from __future__ import annotations

from trirail.wire import access
from trirail.wire.vocabulary import Command, Role

GOAL, POSES, TAKEOVER = "goal", "poses", "takeover"
"""Permissions to send goals, to teach poses and to take over the lease. A command's permission has the command's name.
"""


def permissions(role: Role | None, takeover: Role) -> frozenset[str]:
    """Return the permissions of a role; an empty set if `role` is None.

    `takeover` is the lowest role that may take over the lease.
    """
    least = {GOAL: access.GOAL_ROLE, POSES: access.POSE_ROLE, TAKEOVER: takeover} | {
        each.value: each.role for each in Command
    }
    return frozenset(name for name, needed in least.items() if role is not None and role.includes(needed))
