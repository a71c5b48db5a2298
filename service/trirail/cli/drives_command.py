"""`trirail drives`: who is on the bus, and what its set-up would change."""

from __future__ import annotations

import time
from typing import Annotated

from cyclopts import App

from trirail.cli import drive_parameters, terminal
from trirail.cli.options import ConfigFile, Flag, Json

app = App(name="drives", help="Show the drives; save, compare, restore their parameters.")
for command in drive_parameters.COMMANDS:
    app.command(command)

UNTRIED = "no make of drive was tried on hardware yet: go on with trirail commission, the hand on the emergency stop"
"""What the examples of makes say in their first line, too."""


@app.default
def drives(config: ConfigFile = None, /, *, apply: Annotated[bool, Flag] = False, json: Json = False) -> int:
    """Show each drive: who it says it is, its modes and units, and what its set-up would change, and why.

    Reads only, unless told to apply; no drive gets power, and nothing is stored in one. Not while the service runs.

    Parameters
    ----------
    apply
        Write the differences, and read them back.
    """
    from trirail_drivers.connection.opening import open_bus
    from trirail_drivers.errors import DriveError
    from trirail_drivers.protocols import PROTOCOLS

    from trirail.commissioning import drives_told
    from trirail.config import SIM, load
    from trirail.diagnosis.check import is_simulated

    settings = load(config or SIM)
    inspect = PROTOCOLS[settings.drives.protocol].inspect
    if inspect is None:
        protocol = settings.drives.protocol
        raise DriveError(f"drives of protocol {protocol} have no objects to be shown; trirail commission finds them")
    with open_bus(settings.can, settings.drives) as bus:
        fastest = settings.limits.slider.fastest
        found = inspect(bus, settings.drives, settings.period, time.monotonic, fastest, apply=apply)
    fit = not any(each["refused"] for each in found)
    if json:
        terminal.json({"ok": fit, "applied": apply, "drives": found})
    else:
        for each in found:
            for line in (
                *drives_told.identity(each, settings.geometry.labels),
                *drives_told.differences(each, applied=apply),
            ):
                terminal.say(line)
        if not is_simulated(settings.can):
            terminal.say(UNTRIED)
    return 0 if fit else 1
