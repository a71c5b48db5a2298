"""`trirail router`: print the configuration of a router between robots and users, for Zenoh's own program zenohd."""

from __future__ import annotations

from pathlib import Path

from trirail.cli import terminal


def router(config: Path, /) -> int:
    """Print the configuration of a router to which robots ([zenoh] connect) and users connect.

    The output is for Zenoh's own program, zenohd, in the same version as the service's Zenoh.

    Parameters
    ----------
    config
        File with the router's robots, listening addresses, certificates and users.
    """
    from trirail.cli import router as routers

    terminal.json(routers.settings(routers.load(config)))
    return 0
