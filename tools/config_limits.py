"""Table of all limits and time-outs for configs/README.md, used by config_reference.py.

The place of a limit is a key of the configuration, `section.key`, or a constant with its unit, `module:NAME s`. Keys
and constants are looked up when the table is generated. This ensures that they exist, and that the table contains the
present values of constants.
"""

from __future__ import annotations

import importlib
from typing import NamedTuple


class Bound(NamedTuple):
    """Quantity with a limit: its name, the places of the limit, and the reaction if the limit is exceeded."""

    name: str
    places: tuple[str, ...]
    beyond: str


INTRODUCTION = """\
## Where a limit or time-out stands

`[limits]` bounds the robot's motion, `[drives]` has the settings and watchdogs of the drives,
`[watchdogs]` those of the service. A bound that depends on no robot is a constant, shown with its
name in the code. A following error is bounded twice: by the service, which stops all three drives
at the lower limit, and by the drives, which keep watching if the service has died.
"""

BOUNDS = (
    Bound("Travel of sliders and platform", ("limits.slider.position", "limits.slider.passive", "limits.platform.x",
          "limits.platform.y", "limits.platform.phi"), "a goal is refused, `out_of_workspace`"),
    Bound("Nearness to a singular angle", ("limits.singularity_margin",), "the configuration is refused"),
    Bound("Velocity, acceleration, jerk", ("limits.slider.velocity", "limits.slider.acceleration", "limits.slider.jerk",
          "limits.platform.velocity", "limits.platform.acceleration", "limits.platform.jerk"),
          "a goal is slowed; a trajectory without `stretch` is refused, `too_fast`"),
    Bound("Rest in position after a path", ("limits.in_position.sliders", "limits.in_position.pose",
          "limits.in_position.dwell", "limits.in_position.timeout"), "the goal ends `unsettled`, the robot holds"),
    Bound("Following error, watched by the service", ("limits.slider.following_error",), "fault, all three stop"),
    Bound("Following error, watched by the drives", ("drives.following_error",), "fault of that drive, all three stop"),
    Bound("Ramp of a quick stop", ("drives.quick_stop_deceleration",), "none: the drives brake with it"),
    Bound("Power up after `enable`", ("watchdogs.enable_timeout",), "fault"),
    Bound("Power off after a quick stop or `disable`", ("drives.stop_timeout",), "fault; the command fails"),
    Bound("A drive's answer during its set-up", ("drives.sdo_timeout",), "the service does not start"),
    Bound("Heartbeats of drives and service", ("drives.heartbeat",), "fault or the drive's own stop, after three"),
    Bound("Homing of one drive", ("drives.A.homing.timeout",), "fault"),
    Bound("The bus takes no frames", ("trirail_drivers.bus.wire:UNSENT_CYCLES cycles",), "fault"),
    Bound("Ticks missed in a row", ("watchdogs.max_overruns",), "controlled stop"),
    Bound("No sign of life from the gateway", ("watchdogs.gateway_timeout",), "controlled stop"),
    Bound("No sign of life from a process", ("trirail.processes.supervisor:MAX_SILENCE_S s",),
          "killed; the gateway is restarted, without the loop the service ends"),
    Bound("Controlled stop when the service ends", ("trirail.processes.ending:MAX_SHUTDOWN_S s",),
          "the drives' quick stop"),
    Bound("Goals that wait for the active one", ("motion.queue",), "refused, `queue_full`"),
    Bound("Unread messages, of one user and of all", ("trirail.processes.inbox:MAX_MESSAGES_OF_USER messages",
          "trirail.processes.inbox:MAX_MESSAGES messages"), "refused, `busy`; commands at twice as many"),
    Bound("Memory that messages hold until they are answered, of one user and of all",
          ("trirail.wire.sizes:MAX_UNREAD_OF_ONE bytes", "trirail.wire.sizes:MAX_UNREAD bytes"),
          "refused, `busy`; commands at twice as much"),
    Bound("Messages of one user: burst, and rate", ("trirail.processes.incoming:BURST messages",
          "trirail.processes.incoming:RATE messages/s"), "they wait"),
    Bound("Goals that wait for the loop, of one user and of all",
          ("trirail.processes.incoming:GOALS_OF_ONE goals", "trirail.processes.incoming:GOALS goals"),
          "refused, `busy`"),
    Bound("Active commands, of one user and of all", ("trirail.processes.requests:MAX_COMMANDS_OF_USER commands",
          "trirail.processes.requests:MAX_COMMANDS commands"), "refused, `busy`, except stops"),
    Bound("Zenoh sessions", ("trirail.wire.zenoh_session:SESSIONS sessions",), "not opened"),
    Bound("Connections to the port for stops", ("trirail.processes.stop_port:MAX_CALLERS connections",),
          "the oldest of the address, or of the user, is closed"),
    Bound("Wait of a goal until the loop can plan it", ("trirail.processes.incoming:GOAL_PATIENCE s",),
          "refused, `stopped`; a goal may have its own, `valid_for`: `expired`"),
    Bound("Points of a trajectory, in one message and in all",
          ("trirail.wire.sizes:MAX_PART points", "trirail.wire.sizes:MAX_POINTS points"), "refused, `malformed`"),
    Bound("The next part of a trajectory", ("trirail.processes.trajectory_parts:PARTS_WITHIN s",),
          "refused, `expired`, with the missing parts"),
    Bound("Renewal of a jog", (), "the robot brakes, `jog_over`"),
    Bound("Renewal of the lease", (), "controlled stop, the lease is free"),
    Bound("A command, in the service", ("trirail.processes.requests:REPLY_TIMEOUT_S s",),
          "error `timeout`; `home` and `enable` add their time-outs"),
    Bound("A command, in the client", ("trirail.client.async_client:REPLY_WITHIN s",
          "trirail.client.async_client:HOME_WITHIN s", "trirail.client.async_client:ENABLE_WITHIN s"),
          "`ServiceError`; the longer times are for `home` and `enable`"),
    Bound("Size of recordings", ("telemetry.rotate_minutes", "telemetry.rotate_mb", "telemetry.keep_mb"),
          "another file starts, the oldest is deleted"),
)  # fmt: skip


def table(known: set[str]) -> str:
    """Return the table, given the `known` keys of the configuration. Raises KeyError if a place does not exist."""
    rows = [f"| {name} | {_format_places(places, known)} | {beyond} |" for name, places, beyond in BOUNDS]
    return "\n".join([INTRODUCTION, "| bound | place | beyond it |", "|---|---|---|", *rows]) + "\n"


def _format_places(places: tuple[str, ...], known: set[str]) -> str:
    """Return a description of places. A section is named only once if consecutive places are in the same section."""
    words, last = [], ""
    for place in places:
        module, _, constant = place.partition(":")
        section, _, key = place.rpartition(".")
        if constant:
            name, unit = constant.split(" ")
            words.append(f"{vars(importlib.import_module(module))[name]:g} {unit} (`{name}`)")
        elif place not in known:
            raise KeyError(place)
        else:
            words.append(f"`{key}`" if section == last else f"`[{section}] {key}`")
            last = section
    return ", ".join(words) or "its own `timeout`"
