"""A session drawn: modes, goals, pose, sliders, following error and the loop's timing over time. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from trirail.analysis.residual_chart import RESIDUALS, draw_residuals
from trirail.analysis.summary import ENABLED_MODES, GoalSummary, Incident, Summary
from trirail.config import Limits
from trirail.errors import ConfigError
from trirail.naming import Labels, label
from trirail.telemetry import palette, provenance
from trirail.telemetry.reading import Recording
from trirail.wire.vocabulary import MODES, Mode

__all__ = ["draw"]

INK, GREY, PALE, RED = "#1f2933", "#7b8794", "#d3d9e0", "#c0392b"
SLIDERS = ("#d1495b", "#2e8b57", "#2f6fb3")
CENTRE, PHI = ("#0e7c86", "#7a4fc0"), "#b7791f"
DASHES = (0, (4, 3))
MODE_COLOURS = {mode: palette.code(palette.pale(colour)) for mode, colour in palette.MODES.items()}
OUTCOME_COLOURS = {outcome: palette.code(colour) for outcome, colour in palette.OUTCOMES.items()}
BINS = 1500
"""So many points of a curve are drawn: of each bin the least and the greatest value."""
PANELS = {
    "goals": 1.1,
    "x, y [mm]": 1.3,
    "φ [°]": 1.0,
    "λ [mm]": 1.3,
    "velocity [mm/s]": 1.3,
    "error [µm]": 1.3,
    "loop [µs]": 1.3,
}
"""From top to bottom, with their heights [inch]: centre and angle of the platform, then the sliders and the loop."""
WIDTH = 13.0
NEAR = 0.7
"""A limit is drawn where a curve reaches this share of it: else it would flatten the curve."""
LISTED = 8
"""So many faults are listed below the curves."""
LETTER = 4.0
"""The width of a letter of a goal's name [point]."""


def draw(file: Path, recording: Recording, summed: Summary) -> None:
    """Draw a session. The file's suffix chooses the format.

    ValueError for one that matplotlib does not write, OSError if the file cannot be written.
    """
    listed = _listed(summed.faults)
    heights = PANELS | ({RESIDUALS: 1.3} if any(each.residuals for each in summed.alignments) else {})
    figure = Figure(figsize=(WIDTH, sum(heights.values()) + 1.2 + 0.17 * len(listed)), dpi=150, layout="constrained")
    figure.suptitle(_title(summed), x=0.008, ha="left", color=INK, fontsize=14, fontweight="bold")
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=[*heights.values()])
    panels: dict[str, Axes] = dict(zip(heights, axes, strict=True))
    for name, panel in panels.items():
        panel.set_ylabel(name, color=GREY, fontsize=9)
    records, t = recording.records, recording.t
    axes[-1].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    _modes(panels["goals"], records, t, summed)
    _motion(panels, records, t, _limits(recording), summed.labels)
    _timing(panels["loop [µs]"], records, t, 1e6 / summed.rate_hz)
    if RESIDUALS in panels:
        colours = draw_residuals(panels[RESIDUALS], recording.alignments)
        _names(panels[RESIDUALS], list(colours), list(colours.values()))
    worst = [
        f"{label(each.slider, summed.labels)}  max {each.max * 1e6:.0f}, rms {each.rms * 1e6:.1f} µm"
        for each in summed.tracking
    ]
    _names(panels["error [µm]"], worst, SLIDERS)
    for panel in axes:
        _quiet(panel)
        for incident in summed.faults:
            panel.axvline(incident.t, color=RED, linewidth=1.0, zorder=9)
    for number, incident in enumerate(summed.faults[:LISTED], start=1):
        mark = {"color": "white", "fontsize": 7, "ha": "center", "va": "center", "zorder": 10}
        box = {"boxstyle": "circle,pad=0.25", "facecolor": RED, "linewidth": 0}
        axes[0].text(incident.t, 1.0, str(number), transform=axes[0].get_xaxis_transform(), bbox=box, **mark)
    axes[-1].set_xlabel("\n".join(["nominal time since the loop's start [s]", *listed]), color=GREY, fontsize=9)
    if listed:
        axes[-1].xaxis.label.set(horizontalalignment="left", x=0.0, parse_math=False)
    figure.savefig(file)


def _listed(faults: list[Incident]) -> list[str]:
    """Return a numbered line for each fault, those at the end counted together."""
    lines = [f"{n}   {each.t:.3f} s   {each.message}" for n, each in enumerate(faults[:LISTED], start=1)]
    return lines + ([f"and {len(faults) - LISTED} more"] if len(faults) > LISTED else [])


def _limits(recording: Recording) -> Limits | None:
    """Return the limits in force, None where the recording does not say them in a way that is known here."""
    try:
        config = provenance.configuration(recording.texts)
    except ConfigError:
        return None
    return config.limits if config else None


def _motion(
    panels: dict[str, Axes],
    records: NDArray[np.void],
    t: NDArray[np.float64],
    limits: Limits | None,
    labels: Labels,
) -> None:
    """Draw the platform and the sliders, in millimetres and degrees, each with the limits that it comes near."""
    enabled = np.isin(records["mode"], ENABLED_MODES)[:, np.newaxis]
    error = np.where(enabled, records["following_error"], np.nan)
    _curves(panels["x, y [mm]"], t, records["pose"][:, :2] * 1e3, CENTRE)
    _curves(panels["φ [°]"], t, np.degrees(records["pose"][:, 2:]), (PHI,))
    _curves(panels["λ [mm]"], t, records["position"] * 1e3, SLIDERS)
    _curves(panels["velocity [mm/s]"], t, records["commanded_velocity"] * 1e3, SLIDERS)
    _curves(panels["error [µm]"], t, error * 1e6, SLIDERS)
    _names(panels["x, y [mm]"], "xy", CENTRE)
    _names(panels["λ [mm]"], labels, SLIDERS)
    if limits is None:
        return
    slider, platform = limits.slider, limits.platform
    for x_or_y, values in zip((platform.x, platform.y), records["pose"][:, :2].T, strict=True):
        _bounds(panels["x, y [mm]"], values * 1e3, x_or_y[0] * 1e3, x_or_y[1] * 1e3)
    for low, high in dict.fromkeys(slider.positions):
        _bounds(panels["λ [mm]"], records["position"] * 1e3, low * 1e3, high * 1e3)
    for velocity in dict.fromkeys(slider.velocities):
        _bounds(panels["velocity [mm/s]"], records["commanded_velocity"] * 1e3, -velocity * 1e3, velocity * 1e3)
    allowed = slider.following_error * 1e6
    _bounds(panels["error [µm]"], error * 1e6, -allowed, allowed)


def _bounds(panel: Axes, values: NDArray[np.float64], low: float, high: float) -> None:
    """Draw those of two limits that the values come near."""
    for limit in (low, high):
        reached = np.nanmax(values * np.sign(limit), initial=0.0)
        if limit and reached >= NEAR * abs(limit):
            panel.axhline(limit, color=RED, linewidth=0.9, linestyle=DASHES)


def _title(summed: Summary) -> str:
    outcomes = [goal.outcome for goal in summed.goals]
    counts = ", ".join(f"{outcomes.count(outcome)} {outcome}" for outcome in dict.fromkeys(outcomes))
    return f"{summed.name}   –   {summed.duration:.1f} s,  goals: {counts or 'none'}"


def _modes(panel: Axes, records: NDArray[np.void], t: NDArray[np.float64], summed: Summary) -> None:
    """Draw the modes as a band, and the goals as bars above it."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(records["mode"])) + 1])
    ends = np.append(t[starts[1:]], t[-1])
    bands = [Rectangle((t[start], 0.0), end - t[start], 0.9) for start, end in zip(starts, ends, strict=True)]
    colours = [MODE_COLOURS[MODES[mode]] for mode in records["mode"][starts]]
    panel.add_collection(PatchCollection(bands, facecolors=colours, linewidths=0))
    for number, goal in enumerate(summed.goals):
        _goal(panel, goal, 1.1 + 0.75 * (number % 2), float(t[0]), float(t[-1]))
    panel.set(ylim=(-0.1, 2.75), yticks=[0.45, 1.8], yticklabels=["mode", "goals"], ylabel="")
    shown = [Patch(color=MODE_COLOURS[Mode(name)], label=name) for name in summed.modes]
    kinds = {goal.outcome: OUTCOME_COLOURS[goal.outcome] for goal in summed.goals}
    shown += [Patch(color=colour, label=f"goal {outcome}") for outcome, colour in kinds.items()]
    panel.legend(
        handles=shown, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=12, frameon=False, fontsize=8, labelcolor=INK
    )


def _goal(panel: Axes, goal: GoalSummary, y: float, begin: float, end: float) -> None:
    """Draw a goal as a bar with its name, as much of that as there is room for."""
    ended = end if goal.ended is None else goal.ended
    colour = OUTCOME_COLOURS[goal.outcome]
    panel.add_patch(Rectangle((goal.given, y), ended - goal.given, 0.65, facecolor=colour, linewidth=0))
    if goal.outcome in ("rejected", "expired"):
        panel.plot([goal.given], [y + 0.32], "x", color=colour, markersize=6, markeredgewidth=2)
    room = int((ended - goal.given) / max(end - begin, 1e-9) * 68.0 * WIDTH / LETTER) - 1
    name = goal.id if len(goal.id) <= room else f"{goal.id[: room - 1]}…"
    if room >= min(4, len(goal.id)):
        where, right = (goal.given, y + 0.3), (3.0, 0.0)
        panel.annotate(
            name, where, right, textcoords="offset points", color="white", fontsize=7, va="center", parse_math=False
        )


def _curves(panel: Axes, t: NDArray[np.float64], values: NDArray[np.float64], colours: Sequence[str]) -> None:
    """Draw the columns of (N, k) values: every excursion shows, however short."""
    for column, colour in zip(values.T, colours, strict=True):
        panel.plot(*_thinned(t, column), color=colour, linewidth=1.0)


def _names(panel: Axes, names: Sequence[str], colours: Sequence[str]) -> None:
    """Say which curve is which."""
    pairs = zip(names, colours, strict=True)
    _legend(panel, [Line2D([], [], color=colour, label=name) for name, colour in pairs])


def _timing(panel: Axes, records: NDArray[np.void], t: NDArray[np.float64], budget: float) -> None:
    lateness, cycle = records["lateness_ns"] / 1e3, records["parts_ns"].sum(axis=1) / 1e3
    panel.plot(*_thinned(t, lateness), color="#8c6bb1", linewidth=0.7)
    panel.plot(*_thinned(t, cycle), color="#2f6fb3", linewidth=0.7)
    panel.axhline(budget, color=RED, linewidth=0.9, linestyle=DASHES)
    missed = t[1:][np.diff(records["overruns"]) > 0]
    panel.plot(missed, np.full(len(missed), budget), "|", color=RED, markersize=7)
    panel.set_ylim(0.0, 1.15 * budget)
    handles = [
        Line2D([], [], color="#8c6bb1", label="lateness"),
        Line2D([], [], color="#2f6fb3", label="cycle time"),
        Line2D([], [], color=RED, linestyle=DASHES, label="period"),
    ]
    if len(missed):
        handles.append(Line2D([], [], color=RED, marker="|", linestyle="", label=f"missed ticks, {len(missed)} times"))
    _legend(panel, handles)


def _thinned(t: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the least and the greatest value of each bin, in the order in which they came."""
    size = len(values) // BINS
    if size < 3:
        return t, values
    whole = len(values) // size * size
    rows = values[:whole].reshape(-1, size)
    empty = np.isnan(rows).any(axis=1)
    filled = np.where(np.isnan(rows), 0.0, rows)
    at = np.sort(np.stack([filled.argmin(axis=1), filled.argmax(axis=1)], axis=1), axis=1)
    thin = np.take_along_axis(rows, at, axis=1)
    thin[empty] = np.nan
    times = np.take_along_axis(t[:whole].reshape(-1, size), at, axis=1)
    return times.ravel(), thin.ravel()


def _legend(panel: Axes, handles: list[Line2D]) -> None:
    panel.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
    )


def _quiet(axes: Axes) -> None:
    """Leave the word to the data."""
    axes.tick_params(colors=GREY, labelsize=8, length=2)
    axes.grid(axis="x", color=PALE, linewidth=0.5)
    for spine in axes.spines.values():
        spine.set_color(PALE)
