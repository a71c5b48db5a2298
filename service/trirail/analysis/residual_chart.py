"""What marks had to go at each look of the alignments of a session, over time. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from trirail.telemetry.alignments import RecordedAlignment

RESIDUALS = "to go [µm]"
"""The panel's name."""
COLOURS = ("#0e7c86", "#7a4fc0", "#b7791f", "#d1495b", "#2e8b57", "#2f6fb3")
"""Of marks, in the order of their names."""
LEAST = 1e-3
"""The scale's lowest value [µm]: a residual of zero has a place too."""


def draw_residuals(panel: Axes, alignments: Sequence[RecordedAlignment]) -> dict[str, str]:
    """Draw a dot for each mark and look, those of one alignment joined, and how it ended; return the marks' colours."""
    panel.set_yscale("log")
    names = sorted({name for each in alignments for name in each.marks})
    colours = {name: COLOURS[n % len(COLOURS)] for n, name in enumerate(names)}
    for each in alignments:
        t, residuals = np.array(each.t), each.residuals * 1e6
        if np.isnan(residuals).all():
            continue
        for name, row in zip(each.marks, residuals, strict=True):
            known = ~np.isnan(row)
            panel.plot(t[known], np.maximum(row[known], LEAST), "o-", color=colours[name], markersize=3, linewidth=1.0)
        panel.annotate(each.end, (t[-1], 1.0), xycoords=("data", "axes fraction"), fontsize=7, ha="center", va="bottom")
    return colours
