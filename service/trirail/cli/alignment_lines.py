"""Alignments of a recorded session as lines of its report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trirail.cli import terminal

if TYPE_CHECKING:
    from trirail.analysis.summary import AlignmentSummary

ENDED_WELL = ("reached", "calibrated", "checked")


def show(alignments: list[AlignmentSummary]) -> None:
    """Print each with what its marks had to go, look by look."""
    terminal.out.print("\nalignments")
    for each in alignments:
        colour = "green" if each.end in ENDED_WELL else "yellow"
        made = f", {terminal.counted(each.corrections, 'correction')}" if each.purpose == "alignment" else ""
        looks = f"{terminal.counted(each.looks, 'look')}{made} in {each.seconds:.2f} s"
        who = terminal.plain(f"{each.id}  {each.purpose} of {each.user}")
        words = f": {terminal.plain(each.message)}" if each.message else ""
        terminal.out.print(f"  {each.began:9.3f} s  [{colour}]{each.end:11}[/]  {who}, {looks}{words}", soft_wrap=True)
        for name, ways in each.residuals.items():
            shown = " → ".join("–" if way is None else f"{way * 1e6:.2f}" for way in ways)
            terminal.out.print(f"               {terminal.plain(name)}  {shown} µm to its target", soft_wrap=True)
