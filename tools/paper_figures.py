"""Pictures of the paper's figures 3 to 11, with computed values as lines and values of the service as circles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from paper_motions import (
    DURATION,
    EXAMPLES,
    QUANTITIES,
    Curves,
    Example,
    Quantity,
    computed,
    figures,
    greatest_difference,
)
from trirail.errors import ServiceError
from trirail.kinematics.geometry import LEGS
from trirail.telemetry.palette import SLIDERS

STYLE: dict[Any, Any] = {
    "figure.facecolor": "white",
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "mathtext.fontset": "dejavusans",
    "axes.edgecolor": "#6b7280",
    "axes.labelcolor": "#1f2937",
    "axes.titlesize": 11.0,
    "axes.titlecolor": "#111827",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.formatter.limits": (-3, 4),
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.8,
    "xtick.color": "#4b5563",
    "ytick.color": "#4b5563",
    "legend.frameon": False,
    "legend.handlelength": 1.2,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 2.4,
    "lines.scale_dashes": False,
}
DASH = 9.0
"""Length of the dashes [pt]. Curves that coincide, as all three do in the rotation, are drawn as alternating dashes."""


CIRCLES: dict[str, Any] = {
    "linestyle": "",
    "marker": "o",
    "markersize": 5.0,
    "clip_on": False,
    "markerfacecolor": "white",
    "markeredgewidth": 1.4,
    "zorder": 3,
}
NOTE: dict[str, Any] = {"color": "#4b5563", "fontsize": 8.5}
DOT = 0.125
"""Time between two circles [s]."""


def plot(axes: Axes, quantity: Quantity, curves: Curves, service: Curves | None = None) -> None:
    """Draw a quantity of the three sliders: the computed values as lines, those of the service as circles.

    If the curves of several sliders coincide, their dashes and circles alternate.
    """
    sliders = curves.values_of(quantity).T
    visible = 1e-3 * float(np.ptp(sliders))
    for i, (slider, colour) in enumerate(zip(LEGS, SLIDERS, strict=True)):
        one = [j for j in range(3) if np.max(np.abs(sliders[j] - sliders[i])) <= visible]
        turns = (-DASH * one.index(i), (DASH, DASH * (len(one) - 1)))
        rgb = [part / 255 for part in colour[:3]]
        axes.plot(curves.t, sliders[i], color=rgb, linestyle=turns if len(one) > 1 else "-")
        axes.plot([], [], color=rgb, label=f"${quantity.symbol}^{slider}$")
        if service is not None:
            dots = np.searchsorted(service.t, np.arange(1, round(DURATION / DOT) + 1) * DOT - 1e-6)
            mine = dots[one.index(i) :: len(one)]
            axes.plot(service.t[mine], service.values_of(quantity)[mine, i], color=rgb, **CIRCLES)


def draw(axes: Axes, title: str, quantity: Quantity, curves: Curves, service: Curves | None, difference: float) -> None:
    """Draw one figure, and write the difference between the service and the computed values below it."""
    axes.axhline(0.0, color="#9ca3af", linewidth=1.0)
    plot(axes, quantity, curves, service)
    axes.set_title(title, loc="left", pad=12.0)
    axes.set_xlabel("$t$ [s]", loc="left" if service else "center")
    axes.set_ylabel(f"{quantity.name} [{quantity.unit}]")
    axes.set_xlim(0.0, DURATION)
    axes.margins(y=0.08)
    axes.legend(loc="lower right", bbox_to_anchor=(1.02, 0.985), ncols=3)
    if service is not None:
        axes.annotate(
            f"service − computed: {_power(difference)} {quantity.unit} at most",
            (1.0, 0.0),
            xycoords="axes fraction",
            xytext=(0.0, -27.0),
            textcoords="offset points",
            ha="right",
            va="center",
            **NOTE,
        )


def write(output: Path, curves: Mapping[Example, Curves], service: Mapping[str, Curves]) -> dict[str, Path]:
    """Write a picture of each figure and an overview; return the files by name. Raises ServiceError."""
    pictures = {}
    with matplotlib.rc_context(STYLE):
        overview = Figure(figsize=(15.0, 10.8))
        overview.set_layout_engine("constrained", h_pad=0.12)
        panels = overview.subplots(len(QUANTITIES), len(EXAMPLES))
        for number, example, quantity in figures():
            single = Figure(figsize=(5.6, 4.0), layout="constrained")
            title = f"Fig. {number}   {example.title}"
            done = service.get(example.name)
            difference = greatest_difference(done, computed(example, done.t), quantity) if done else 0.0
            for axes in (single.subplots(), panels[QUANTITIES.index(quantity), EXAMPLES.index(example)]):
                draw(axes, title, quantity, curves[example], done, difference)
            pictures[f"figure_{number:02}"] = single
        pictures["paper"] = overview
        try:
            output.mkdir(parents=True, exist_ok=True)
            for name, picture in pictures.items():
                if service:
                    _explain(picture)
                picture.savefig(output / f"{name}.png", dpi=130)
        except OSError as error:
            raise ServiceError(f"cannot write pictures to {output}: {error.strerror}") from error
    return {name: output / f"{name}.png" for name in pictures}


def _explain(picture: Figure) -> None:
    """Add a legend below a picture that explains lines and circles."""
    line = Line2D([], [], color=NOTE["color"])
    circle = Line2D([], [], color=NOTE["color"], **CIRCLES)
    words = ("computed by the recursion", f"setpoints of the running service, every {DOT * 1e3:g} ms")
    picture.legend([line, circle], words, loc="outside lower center", ncols=2, fontsize=9.5)


def _power(value: float) -> str:
    """Return a number as text with a power of ten."""
    if value == 0.0:
        return "0"
    digits, power = f"{value:.1e}".split("e")
    return rf"${digits}\cdot10^{{{int(power)}}}$"
