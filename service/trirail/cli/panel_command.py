"""`trirail panel`: the operator's page, served on this machine's loopback for as long as the command lasts."""

from __future__ import annotations

import signal
from typing import Annotated

from cyclopts import Parameter

from trirail.cli.options import HERE, Service
from trirail.cli.robot_commands import show


def panel(
    *,
    port: int | None = None,
    open_: Annotated[bool, Parameter(name="--open", negative="", show_default=False)] = False,
    service: Service = HERE,
) -> int:
    """Serve the operator's page to browsers on this machine.

    With it the robot is seen live, jogged, stopped and commanded. Ends by Ctrl-C.

    Who has the address that is printed can move the robot; it is another one each time.

    Parameters
    ----------
    port
        Port of the loopback, 0 for any that is free; 9880 if absent, or any where that is taken.
    open_
        Open it in the browser.
    """
    from trirail.panel.server import Panel
    from trirail.processes.operating_system import Signals

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with service.open() as robot, Panel(robot, port) as served:
        show(
            service,
            {"url": served.url},
            f"the panel of {robot.name}, on this machine alone, until Ctrl-C: {served.url}",
        )
        if open_:
            import webbrowser

            webbrowser.open(served.url)
        with Signals() as ends:
            ends.first()
    return 0
