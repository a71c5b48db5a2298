"""`trirail fleet`: live table of all robots that a user may see; robots that need attention are listed first."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import msgspec
from rich.live import Live
from rich.table import Table

from trirail.cli import terminal
from trirail.cli.options import HERE, Service
from trirail.wire.state import RobotSummary
from trirail.wire.text import wall_clock

if TYPE_CHECKING:
    from trirail.client.fleet import Fleet, Member

SNAPSHOT_S = 2.5
"""Time for which --json receives summaries [s]. Each robot sends at least one per second."""
UNREADABLE = "another version of trirail, whose summary cannot be read here"
REFRESH_S = 0.5
"""Interval at which the table is redrawn [s]."""


def fleet(*, service: Service = HERE) -> int:
    """Show all robots at --connect, usually a router, until Ctrl-C; those that need attention are first.

    A robot is silent if its loop has sent nothing for 3 s. If the output is a file or pipe, the command prints a line
    whenever a robot changes. With --json, it prints once after 2.5 s; `lateness` is in µs, and the fields are null for
    a robot of another version whose summary cannot be read.
    """
    never = threading.Event()
    from trirail.client.fleet import Fleet

    with Fleet(service.connect, service.robot, service.tls) as seen:
        if service.json:
            never.wait(SNAPSHOT_S)
            now = time.monotonic()
            terminal.json({"robots": [_as_json(member, now) for member in seen.members()]})
            return 0
        with contextlib.suppress(KeyboardInterrupt):
            if not terminal.can_redraw():
                _print_changes(seen, never)
            with Live(console=terminal.out, auto_refresh=False) as live:
                while not never.wait(REFRESH_S):
                    live.update(table(seen.members(), time.monotonic()), refresh=True)
    return 0


def _print_changes(seen: Fleet, never: threading.Event) -> None:
    """Print a line for each robot, and print the line again whenever it changes."""
    printed: dict[str, str] = {}
    for member in terminal.end_with_reader(_members(seen, never)):
        line = _line(member, time.monotonic())
        if printed.get(member.robot) != line:
            printed[member.robot] = line
            terminal.print_line(f"{wall_clock(time.time())}  {line}")


def _members(seen: Fleet, never: threading.Event) -> Iterator[Member]:
    while not never.wait(REFRESH_S):
        yield from seen.members()


def _line(member: Member, now: float) -> str:
    from trirail.client.fleet import Attention

    summary, need = member.summary, member.need(now)
    if need is Attention.SILENT:
        return f"{member.robot}  silent"
    if summary is None:
        return f"{member.robot}  {UNREADABLE}"
    words = (member.robot, summary.mode, summary.fault or "", f"goal {summary.goal}" if summary.goal else "")
    return "  ".join(filter(None, words))


def _as_json(member: Member, now: float) -> dict[str, object]:
    summary = member.summary
    fields = dict.fromkeys(RobotSummary.__struct_fields__) if summary is None else msgspec.to_builtins(summary)
    return {"robot": member.robot, "need": member.need(now).name.lower(), **fields, "age": round(member.age(now), 2)}


def table(members: Sequence[Member], now: float) -> Table:
    """Return a table with one row per robot."""
    from trirail.client.fleet import Attention

    drawn = Table("robot", "mode", "needs", "goal", "lateness p99.9", "missed", "version", box=None, pad_edge=False)
    for member in members:
        summary, need = member.summary, member.need(now)
        needs = {
            Attention.SILENT: f"[bold red]silent for {member.age(now):.0f} s[/]",
            Attention.FAULT: f"[bold red]{terminal.plain((summary and summary.fault) or 'reset')}[/]",
            Attention.UNREADABLE: f"[yellow]{UNREADABLE}[/]",
            Attention.NOTHING: "",
        }[need]
        if summary is None:
            drawn.add_row(terminal.plain(member.robot), "[dim]unknown[/]", needs)
            continue
        mode = f"[{terminal.COLOURS.get(summary.mode, 'white')}]{terminal.plain(summary.mode)}[/]"
        drawn.add_row(
            terminal.plain(member.robot),
            "[dim]unknown[/]" if need is Attention.SILENT else mode,
            needs,
            terminal.plain(summary.goal or ""),
            f"{summary.lateness:.0f} µs",
            str(summary.missed),
            terminal.plain(summary.version),
        )
    needy = sum(member.need(now) is not Attention.NOTHING for member in members)
    drawn.caption = f"{terminal.counted(len(members), 'robot')}, {needy} need{'s' if needy == 1 else ''} attention"
    return drawn
