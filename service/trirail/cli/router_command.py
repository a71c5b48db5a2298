"""`trirail router`: the configuration of a router between robots and users, for zenohd, Zenoh's own program."""

from __future__ import annotations

from pathlib import Path

from trirail.cli import terminal


def router(config: Path, /) -> int:
    """Print the configuration of a router that robots dial, [zenoh] connect, and users connect to.

    It is for zenohd, Zenoh's own program, of the same version as the service's Zenoh.

    Parameters
    ----------
    config
        File with the router's robots, where it listens, certificates and users.
    """
    from trirail.cli import router as routers

    terminal.json(routers.settings(routers.load(config)))
    return 0
