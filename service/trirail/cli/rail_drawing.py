"""Drawing of a rail with the sliders' travel and the distance of a stop from full velocity at the end of the travel."""

from __future__ import annotations

from typing import Final

from trirail.cli import terminal
from trirail.diagnosis import Stops

_RAIL_COLUMNS: Final = 60
"""Number of characters in the drawing of a rail."""


def draw_lines(stops: Stops) -> list[str]:
    """Return the lines of the drawing, which is to scale except that each part is at least one character long."""
    low, high = stops.rail or stops.travel
    low, high = min(low, stops.travel[0]), max(high, stops.travel[1])

    def wide(length: float) -> int:
        return min(max(1, round(length / (high - low) * _RAIL_COLUMNS)), _RAIL_COLUMNS)

    def at(place: float) -> int:
        return round((place - low) / (high - low) * _RAIL_COLUMNS)

    begin, end = (at(place) for place in stops.travel)
    rows = [("travel", " " * begin + "━" * max(1, end - begin))]
    if stops.rail is not None:
        first, last = (at(place) for place in stops.rail)
        rows.insert(0, ("rail", " " * first + "─" * max(1, last - first)))
    for name, way in (("stop", stops.way), ("quick stop", stops.quick_way)):
        rows.append((name, " " * end + "▶" * min(wide(way), _RAIL_COLUMNS // 3)))
    ends = f"{low * 1e3:<{_RAIL_COLUMNS // 2}.4g}{high * 1e3:>{_RAIL_COLUMNS // 2}.4g} mm"
    return [f"{name:10} {line}" for name, line in rows] + [f"{'':10} {ends}"]


def show(stops: Stops) -> None:
    """Print the drawing and a table of the numbers."""
    terminal.print_line("")
    for line in draw_lines(stops):
        terminal.print_line(line)
    table = terminal.table(f"from {stops.velocity * 1e3:g} mm/s", "mm", "s")
    table.add_row("stop", f"{stops.way * 1e3:.3g}", f"{stops.time:.3g}")
    table.add_row("quick stop", f"{stops.quick_way * 1e3:.3g}", f"{stops.quick_time:.3g}")
    if stops.left is not None:
        table.add_row("rail left beyond the travel", f"{stops.left * 1e3:.3g}", "")
    terminal.print_table(table)
