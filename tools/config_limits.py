"""Which limit and which time-out stands where, and why there: a table of configs/README.md, for config_reference.py.

A place is a key of the configuration, `section.key`, or what is fixed: a constant of a module with its unit,
`module:NAME s`. Both are looked up when the table is made: none can be named that is not there, and what is fixed is
told with the value in force.
"""

from __future__ import annotations

import importlib
from typing import NamedTuple


class Bound(NamedTuple):
    """Something that is bounded: in words, where that stands, and what happens beyond."""

    what: str
    places: tuple[str, ...]
    beyond: str


INTRODUCTION = """\
## Where a limit or time-out stands

What the robot may do is in `[limits]`, what the drives do and watch in `[drives]`, what the
service watches in `[watchdogs]`. What depends on no robot is fixed: a value, with its name in the
code. A following error is bounded twice: by the service, which stops all three at once at the lower
limit, and by the drives, which go on watching when the service is dead.
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
    Bound("Ramp of a quick stop", ("drives.quick_stop_deceleration",), "none: it is what the drives brake with"),
    Bound("Power up after `enable`", ("watchdogs.enable_timeout",), "fault"),
    Bound("Power off after a quick stop or `disable`", ("drives.stop_timeout",), "fault; the command fails"),
    Bound("A drive's answer while it is set up", ("drives.sdo_timeout",), "the service does not start"),
    Bound("Heartbeats of drives and service", ("drives.heartbeat",), "fault or the drive's own stop, after three"),
    Bound("Homing of one drive", ("drives.A.homing.timeout",), "fault"),
    Bound("The bus takes no frames", ("trirail_drivers.bus.wire:UNSENT_CYCLES cycles",), "fault"),
    Bound("Ticks missed in a row", ("watchdogs.max_overruns",), "controlled stop"),
    Bound("No sign of life from the gateway", ("watchdogs.gateway_timeout",), "controlled stop"),
    Bound("No sign of life from a process", ("trirail.processes.supervisor:SILENT s",),
          "it is killed, if it could have given one; a gateway is started again, with the loop the service ends"),
    Bound("Controlled stop when the service ends", ("trirail.processes.loop:SHUTDOWN s",), "the drives' quick stop"),
    Bound("Goals that wait for the one under way", ("motion.queue",), "refused, `queue_full`"),
    Bound("Unread messages, of one user and of all", ("trirail.processes.inbox:UNREAD_OF_ONE messages",
          "trirail.processes.inbox:UNREAD messages"), "refused, `busy`; commands at twice as many"),
    Bound("Messages of one user that are read at once, and then a second", ("trirail.processes.incoming:BURST messages",
          "trirail.processes.incoming:RATE messages/s"), "they wait"),
    Bound("Goals that the loop has not been given yet, of one user and of all",
          ("trirail.processes.incoming:GOALS_OF_ONE goals", "trirail.processes.incoming:GOALS goals"),
          "refused, `busy`"),
    Bound("Commands under way, of one user and of all", ("trirail.processes.requests:UNDER_WAY commands",
          "trirail.processes.requests:UNDER_WAY_OF_ALL commands"), "refused, `busy`, but for what stops the robot"),
    Bound("Zenoh sessions", ("trirail.wire.zenoh_session:SESSIONS sessions",), "not opened"),
    Bound("Connections to the door for stops", ("trirail.processes.stop_door:PLACES connections",),
          "the oldest of the address, or of the user, goes"),
    Bound("Wait of a goal for those before it", ("trirail.processes.incoming:GOAL_PATIENCE s",),
          "refused, `stopped`; a goal may have its own, `valid_for`: `expired`"),
    Bound("Renewal of a jog", (), "the robot brakes, `jog_over`"),
    Bound("Sign of life of who holds the lease", (), "controlled stop, the lease is free"),
    Bound("A command, as the service waits for it", ("trirail.processes.requests:REPLY_WITHIN s",),
          "error `timeout`; for `home` later by the time-outs of homing"),
    Bound("A command, as the client waits for it", ("trirail.client.client:REPLY_WITHIN s",
          "trirail.client.client:HOME_WITHIN s"), "`ServiceError`; the longer one is for `home`"),
    Bound("Size of recordings", ("telemetry.rotate_minutes", "telemetry.rotate_mb", "telemetry.keep_mb"),
          "another file begins, the oldest is deleted"),
)  # fmt: skip


def table(known: set[str]) -> str:
    """Return the table. `known` are the keys of the configuration; KeyError for a place that is not there."""
    rows = [f"| {what} | {_said(places, known)} | {beyond} |" for what, places, beyond in BOUNDS]
    return "\n".join([INTRODUCTION, "| what is bounded | where | beyond it |", "|---|---|---|", *rows]) + "\n"


def _said(places: tuple[str, ...], known: set[str]) -> str:
    """Say places; a section that is that of the place before is not said again."""
    said, last = [], ""
    for place in places:
        module, _, constant = place.partition(":")
        section, _, key = place.rpartition(".")
        if constant:
            name, unit = constant.split(" ")
            said.append(f"{vars(importlib.import_module(module))[name]:g} {unit} (`{name}`)")
        elif place not in known:
            raise KeyError(place)
        else:
            said.append(f"`{key}`" if section == last else f"`[{section}] {key}`")
            last = section
    return ", ".join(said) or "its own `timeout`"
