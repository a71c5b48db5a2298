"""A session drawn: modes, goals, sliders, following error and the loop's timing over time. Needs matplotlib."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray

from trirail.analysis.summary import ENABLED_MODES, GoalSummary, Summary
from trirail.telemetry import palette
from trirail.telemetry.reading import Recording
from trirail.wire.vocabulary import MODES, Mode

__all__ = ["draw"]

INK, GREY, PALE, RED = "#1f2933", "#7b8794", "#d3d9e0", "#c0392b"
SLIDERS = ("#d1495b", "#2e8b57", "#2f6fb3")
MODE_COLOURS = {mode: palette.code(palette.pale(colour)) for mode, colour in palette.MODES.items()}
OUTCOME_COLOURS = {outcome: palette.code(colour) for outcome, colour in palette.OUTCOMES.items()}
BINS = 1500
"""So many points of a curve are drawn: of each bin the least and the greatest value."""
HEIGHTS = (0.9, 2.2, 1.6, 1.6, 1.6)
WIDTH = 13.0


def draw(file: Path, recording: Recording, summed: Summary) -> None:
    """Draw a session. The file's suffix chooses the format.

    ValueError for one that matplotlib does not write, OSError if the file cannot be written.
    """
    figure = Figure(figsize=(WIDTH, sum(HEIGHTS) + 1.2), dpi=150, layout="constrained")
    figure.suptitle(_title(summed), x=0.008, ha="left", color=INK, fontsize=14, fontweight="bold")
    panels = figure.subplots(len(HEIGHTS), 1, sharex=True, height_ratios=HEIGHTS)
    modes, position, velocity, error, timing = panels
    records, t = recording.records, recording.t
    _modes(modes, records, t, summed)
    _bands(position, t, records["position"] * 1e3, "position [mm]")
    _bands(velocity, t, records["commanded_velocity"] * 1e3, "velocity [mm/s]")
    enabled = np.isin(records["mode"], ENABLED_MODES)[:, np.newaxis]
    _bands(error, t, np.where(enabled, records["following_error"], np.nan) * 1e6, "following error [µm]")
    _timing(timing, records, t, 1e6 / summed.rate_hz)
    worst = [f"{each.slider}  max {each.max * 1e6:.0f}, rms {each.rms * 1e6:.1f} µm" for each in summed.tracking]
    handles = [Line2D([], [], color=colour, label=text) for colour, text in zip(SLIDERS, worst, strict=True)]
    _legend(error, handles)
    _legend(position, [Line2D([], [], color=colour, label=name) for colour, name in zip(SLIDERS, "ABC", strict=True)])
    for panel in panels:
        _quiet(panel)
        for incident in summed.faults:
            panel.axvline(incident.t, color=RED, linewidth=1.0, zorder=9)
    for incident in summed.faults:
        side = "left" if incident.t < (t[0] + t[-1]) / 2.0 else "right"  # where there is room
        style = {"color": RED, "fontsize": 8, "va": "top", "ha": side, "zorder": 10}
        position.text(incident.t, 0.97, f" {incident.message} ", transform=position.get_xaxis_transform(), **style)
    panels[-1].set_xlabel("nominal time since the loop's start [s]", color=GREY, fontsize=9)
    panels[-1].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    figure.savefig(file)


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
        _goal(panel, goal, 1.1 + 0.5 * (number % 2), float(t[-1]))
    panel.set(ylim=(-0.1, 2.2), yticks=[0.45, 1.55], yticklabels=["mode", "goals"])
    shown = [Patch(color=MODE_COLOURS[Mode(name)], label=name) for name in summed.modes]
    kinds = {goal.outcome: OUTCOME_COLOURS[goal.outcome] for goal in summed.goals}
    shown += [Patch(color=colour, label=f"goal {outcome}") for outcome, colour in kinds.items()]
    panel.legend(
        handles=shown, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=12, frameon=False, fontsize=8, labelcolor=INK
    )


def _goal(panel: Axes, goal: GoalSummary, y: float, end: float) -> None:
    ended = end if goal.ended is None else goal.ended
    colour = OUTCOME_COLOURS[goal.outcome]
    panel.add_patch(Rectangle((goal.given, y), ended - goal.given, 0.4, facecolor=colour, linewidth=0))
    if goal.outcome in ("rejected", "expired"):
        panel.plot([goal.given], [y + 0.2], "x", color=colour, markersize=6, markeredgewidth=2)


def _bands(panel: Axes, t: NDArray[np.float64], values: NDArray[np.float64], name: str) -> None:
    """Draw (N, 3) values of the sliders: every excursion shows, however short."""
    for column, colour in zip(values.T, SLIDERS, strict=True):
        panel.plot(*_thinned(t, column), color=colour, linewidth=1.0)
    panel.set_ylabel(name, color=GREY, fontsize=9)


def _timing(panel: Axes, records: NDArray[np.void], t: NDArray[np.float64], budget: float) -> None:
    lateness, cycle = records["lateness_ns"] / 1e3, records["parts_ns"].sum(axis=1) / 1e3
    panel.plot(*_thinned(t, lateness), color="#8c6bb1", linewidth=0.7)
    panel.plot(*_thinned(t, cycle), color="#2f6fb3", linewidth=0.7)
    panel.axhline(budget, color=RED, linewidth=0.9, linestyle=(0, (4, 3)))
    missed = t[1:][np.diff(records["overruns"]) > 0]
    panel.plot(missed, np.full(len(missed), budget), "|", color=RED, markersize=7)
    panel.set_ylabel("loop [µs]", color=GREY, fontsize=9)
    panel.set_ylim(0.0, 1.15 * budget)
    handles = [
        Line2D([], [], color="#8c6bb1", label="lateness"),
        Line2D([], [], color="#2f6fb3", label="cycle time"),
        Line2D([], [], color=RED, linestyle=(0, (4, 3)), label="period"),
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
