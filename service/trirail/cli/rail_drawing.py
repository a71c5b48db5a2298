"""Draws a rail with the sliders' travel on it, and how far a stop from full velocity at its end would go."""

from __future__ import annotations

from typing import Final

from trirail.cli import terminal
from trirail.diagnosis import Stops

_RAIL_COLUMNS: Final = 60
"""Characters in which a rail is drawn."""


def draw_lines(found: Stops) -> list[str]:
    """Return the lines of the drawing: to scale, but that nothing is too short to be seen."""
    low, high = found.rail or found.travel
    low, high = min(low, found.travel[0]), max(high, found.travel[1])

    def wide(length: float) -> int:
        return min(max(1, round(length / (high - low) * _RAIL_COLUMNS)), _RAIL_COLUMNS)

    def at(place: float) -> int:
        return round((place - low) / (high - low) * _RAIL_COLUMNS)

    begin, end = (at(place) for place in found.travel)
    rows = [("travel", " " * begin + "━" * max(1, end - begin))]
    if found.rail is not None:
        first, last = (at(place) for place in found.rail)
        rows.insert(0, ("rail", " " * first + "─" * max(1, last - first)))
    for name, way in (("stop", found.way), ("quick stop", found.quick_way)):
        rows.append((name, " " * end + "▶" * min(wide(way), _RAIL_COLUMNS // 3)))
    ends = f"{low * 1e3:<{_RAIL_COLUMNS // 2}.4g}{high * 1e3:>{_RAIL_COLUMNS // 2}.4g} mm"
    return [f"{name:10} {line}" for name, line in rows] + [f"{'':10} {ends}"]


def show(found: Stops) -> None:
    """Print it, and the numbers as a table."""
    terminal.print_line("")
    for line in draw_lines(found):
        terminal.print_line(line)
    table = terminal.table(f"from {found.velocity * 1e3:g} mm/s", "mm", "s")
    table.add_row("stop", f"{found.way * 1e3:.3g}", f"{found.time:.3g}")
    table.add_row("quick stop", f"{found.quick_way * 1e3:.3g}", f"{found.quick_time:.3g}")
    if found.left is not None:
        table.add_row("rail left beyond the travel", f"{found.left * 1e3:.3g}", "")
    terminal.out.print(table)
