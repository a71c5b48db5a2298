"""Draws a rail with the sliders' travel on it, and how far a stop from full velocity at its end would go."""

from __future__ import annotations

from typing import Final

from trirail.cli import terminal
from trirail.diagnosis import Stops

_WIDE: Final = 60
"""Characters in which a rail is drawn."""


def drawn(found: Stops) -> list[str]:
    """Return the lines of the drawing: to scale, but that nothing is too short to be seen."""
    low, high = found.rail or found.travel
    low, high = min(low, found.travel[0]), max(high, found.travel[1])

    def wide(length: float) -> int:
        return min(max(1, round(length / (high - low) * _WIDE)), _WIDE)

    def at(place: float) -> int:
        return round((place - low) / (high - low) * _WIDE)

    begin, end = (at(place) for place in found.travel)
    rows = [("travel", " " * begin + "━" * max(1, end - begin))]
    if found.rail is not None:
        first, last = (at(place) for place in found.rail)
        rows.insert(0, ("rail", " " * first + "─" * max(1, last - first)))
    for name, way in (("stop", found.way), ("quick stop", found.quick_way)):
        rows.append((name, " " * end + "▶" * min(wide(way), _WIDE // 3)))
    ends = f"{low * 1e3:<{_WIDE // 2}.4g}{high * 1e3:>{_WIDE // 2}.4g} mm"
    return [f"{name:10} {line}" for name, line in rows] + [f"{'':10} {ends}"]


def show(found: Stops) -> None:
    """Print it, and the numbers as a table."""
    terminal.say("")
    for line in drawn(found):
        terminal.say(line)
    told = terminal.table(f"from {found.velocity * 1e3:g} mm/s", "mm", "s")
    told.add_row("stop", f"{found.way * 1e3:.3g}", f"{found.time:.3g}")
    told.add_row("quick stop", f"{found.quick_way * 1e3:.3g}", f"{found.quick_time:.3g}")
    if found.left is not None:
        told.add_row("rail left beyond the travel", f"{found.left * 1e3:.3g}", "")
    terminal.out.print(told)
