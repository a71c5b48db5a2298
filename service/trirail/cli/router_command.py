"""`trirail router`: a router between robots and users, or the same configuration for zenohd."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from trirail.cli import terminal
from trirail.cli.options import Flag


def router(config: Path, /, *, print_config: Annotated[bool, Flag] = False) -> int:
    """Run a router that robots dial, [zenoh] connect, and users connect to, until SIGTERM or Ctrl-C.

    Parameters
    ----------
    config
        Its configuration file: its robots, where it listens, certificates and users.
    print_config
        Print the same as a configuration of zenohd, Zenoh's own program, and end. It tells nobody his role.
    """
    from trirail.cli import router as routers

    settings = routers.load(config)
    if print_config:
        from trirail.wire.zenoh_session import nested

        terminal.json(nested(routers.settings(settings)))
        return 0
    robots = terminal.counted(len(settings.all_robots), "robot")
    words = f"routing  {', '.join(settings.zenoh.listen)}  between users and {robots}"
    routers.run(settings, lambda: terminal.say(words))
    return 0
