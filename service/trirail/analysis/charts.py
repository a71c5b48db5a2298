"""Charts of a session: modes, goals, pose, sliders, following error and loop timing. This module needs matplotlib."""

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

from trirail.analysis.summary import ENABLED_MODES, GoalSummary, Incident, Summary
from trirail.config import Limits
from trirail.errors import ConfigError
from trirail.naming import Labels, label
from trirail.telemetry import palette, provenance
from trirail.telemetry.recording import RecordedAlignment, Recording
from trirail.wire.records import slider_positions
from trirail.wire.vocabulary import MODES, Mode

__all__ = ["draw"]

INK, GREY, PALE, RED = "#1f2933", "#7b8794", "#d3d9e0", "#c0392b"
SLIDERS = ("#d1495b", "#2e8b57", "#2f6fb3")
CENTRE, PHI = ("#0e7c86", "#7a4fc0"), "#b7791f"
DASHES = (0, (4, 3))
MODE_COLOURS = {mode: palette.code(palette.pale(colour)) for mode, colour in palette.MODES.items()}
OUTCOME_COLOURS = {outcome: palette.code(colour) for outcome, colour in palette.OUTCOMES.items()}
CURVE_BINS = 1500
"""Number of bins into which a long curve is divided. Only the minimum and the maximum of each bin are drawn."""
PANELS = {
    "goals": 1.1,
    "x, y [mm]": 1.3,
    "φ [°]": 1.0,
    "λ [mm]": 1.3,
    "velocity [mm/s]": 1.3,
    "error [µm]": 1.3,
    "loop [µs]": 1.3,
}
"""Heights of the panels, from top to bottom [inch]."""
FIGURE_WIDTH_IN = 13.0
DRAWN_LIMIT_SHARE = 0.7
"""Fraction of a limit that a curve must reach before the limit is drawn. A distant limit would flatten the curve."""
MAX_LISTED_FAULTS = 8
"""Maximum number of faults listed below the curves."""
LETTER_WIDTH_PT = 4.0
"""Width of one letter in a goal's name [pt]."""
RESIDUAL_PANEL = "to go [µm]"
"""Name of the panel that shows the residuals."""
MARK_COLOURS = ("#0e7c86", "#7a4fc0", "#b7791f", "#d1495b", "#2e8b57", "#2f6fb3")
"""Colours of marks, in the order of their names."""
MIN_RESIDUAL_UM = 1e-3
"""Lowest value drawn on the logarithmic scale [µm]. Smaller residuals, including zero, are drawn at this value."""


def draw(file: Path, recording: Recording, summary: Summary) -> None:
    """Draw the charts of a session and write them to a file, in the format of the file's suffix.

    Raises
    ------
    ValueError
        Matplotlib cannot write the format.
    OSError
        The file cannot be written.
    """
    fault_lines = _fault_lines(summary.faults)
    heights = PANELS | ({RESIDUAL_PANEL: 1.3} if any(each.residuals for each in summary.alignments) else {})
    height = sum(heights.values()) + 1.2 + 0.17 * len(fault_lines)
    figure = Figure(figsize=(FIGURE_WIDTH_IN, height), dpi=150, layout="constrained")
    figure.suptitle(_title(summary), x=0.008, ha="left", color=INK, fontsize=14, fontweight="bold", parse_math=False)
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=[*heights.values()])
    panels: dict[str, Axes] = dict(zip(heights, axes, strict=True))
    for name, panel in panels.items():
        panel.set_ylabel(name, color=GREY, fontsize=9)
    records, t = recording.records, recording.t
    axes[-1].set_xlim(t[0], max(t[-1], t[0] + 1e-3))
    _draw_modes(panels["goals"], records, t, summary)
    _draw_motion(panels, records, t, _recorded_limits(recording), summary.labels)
    _draw_timing(panels["loop [µs]"], records, t, 1e6 / summary.rate_hz)
    if RESIDUAL_PANEL in panels:
        colours = _draw_residuals(panels[RESIDUAL_PANEL], recording.alignments)
        _label_curves(panels[RESIDUAL_PANEL], list(colours), list(colours.values()))
    worst = [
        f"{label(each.slider, summary.labels)}  max {each.max * 1e6:.0f}, rms {each.rms * 1e6:.1f} µm"
        for each in summary.tracking
    ]
    _label_curves(panels["error [µm]"], worst, SLIDERS)
    for panel in axes:
        _style_axes(panel)
        for incident in summary.faults:
            panel.axvline(incident.t, color=RED, linewidth=1.0, zorder=9)
    for number, incident in enumerate(summary.faults[:MAX_LISTED_FAULTS], start=1):
        mark = {"color": "white", "fontsize": 7, "ha": "center", "va": "center", "zorder": 10}
        box = {"boxstyle": "circle,pad=0.25", "facecolor": RED, "linewidth": 0}
        axes[0].text(incident.t, 1.0, str(number), transform=axes[0].get_xaxis_transform(), bbox=box, **mark)
    axes[-1].set_xlabel("\n".join(["nominal time since the loop's start [s]", *fault_lines]), color=GREY, fontsize=9)
    if fault_lines:
        axes[-1].xaxis.label.set(horizontalalignment="left", x=0.0, parse_math=False)
    figure.savefig(file)


def _draw_residuals(panel: Axes, alignments: Sequence[RecordedAlignment]) -> dict[str, str]:
    """Draw the residuals of each mark as a line with one dot per look, and label the end of each alignment.

    Return the colour of each mark.
    """
    panel.set_yscale("log")
    names = sorted({name for each in alignments for name in each.marks})
    colours = {name: MARK_COLOURS[n % len(MARK_COLOURS)] for n, name in enumerate(names)}
    for each in alignments:
        t, residuals = np.array(each.t), each.residuals * 1e6
        if np.isnan(residuals).all():
            continue
        for name, row in zip(each.marks, residuals, strict=True):
            known = ~np.isnan(row)
            distances = np.maximum(row[known], MIN_RESIDUAL_UM)
            panel.plot(t[known], distances, "o-", color=colours[name], markersize=3, linewidth=1.0)
        panel.annotate(each.end, (t[-1], 1.0), xycoords=("data", "axes fraction"), fontsize=7, ha="center", va="bottom")
    return colours


def _fault_lines(faults: list[Incident]) -> list[str]:
    """Return a numbered line for each of the first MAX_LISTED_FAULTS faults. A last line counts the other faults."""
    lines = [f"{n}   {each.t:.3f} s   {each.message}" for n, each in enumerate(faults[:MAX_LISTED_FAULTS], start=1)]
    return lines + ([f"and {len(faults) - MAX_LISTED_FAULTS} more"] if len(faults) > MAX_LISTED_FAULTS else [])


def _recorded_limits(recording: Recording) -> Limits | None:
    """Return the configured limits, or None if the recording has no configuration that this version can read."""
    try:
        config = provenance.configuration(recording.texts)
    except ConfigError:
        return None
    return config.limits if config else None


def _draw_motion(
    panels: dict[str, Axes],
    records: NDArray[np.void],
    t: NDArray[np.float64],
    limits: Limits | None,
    labels: Labels,
) -> None:
    """Draw the motion of platform and sliders in millimetres and degrees, and the limits that are nearly reached."""
    # While the drives are disabled, the sliders move freely. Their distance from the setpoints is then meaningless.
    enabled = np.isin(records["mode"], ENABLED_MODES)[:, np.newaxis]
    error = np.where(enabled, records["following_error"], np.nan)
    # The position of a slider that is not homed, and a pose that depends on it, are relative to an unknown place.
    pose = np.where(np.all(records["homed"], axis=1, keepdims=True), records["pose"], np.nan)
    sliders = np.where(records["homed"], slider_positions(records), np.nan)
    _draw_curves(panels["x, y [mm]"], t, pose[:, :2] * 1e3, CENTRE)
    _draw_curves(panels["φ [°]"], t, np.degrees(pose[:, 2:]), (PHI,))
    _draw_curves(panels["λ [mm]"], t, sliders * 1e3, SLIDERS)
    _draw_curves(panels["velocity [mm/s]"], t, records["commanded_velocity"] * 1e3, SLIDERS)
    _draw_curves(panels["error [µm]"], t, error * 1e6, SLIDERS)
    _label_curves(panels["x, y [mm]"], "xy", CENTRE)
    _label_curves(panels["λ [mm]"], labels, SLIDERS)
    if limits is None:
        return
    slider, platform = limits.slider, limits.platform
    for x_or_y, values in zip((platform.x, platform.y), pose[:, :2].T, strict=True):
        _draw_bounds(panels["x, y [mm]"], values * 1e3, x_or_y[0] * 1e3, x_or_y[1] * 1e3)
    for low, high in dict.fromkeys(slider.positions):
        _draw_bounds(panels["λ [mm]"], sliders * 1e3, low * 1e3, high * 1e3)
    for velocity in dict.fromkeys(slider.velocities):
        _draw_bounds(panels["velocity [mm/s]"], records["commanded_velocity"] * 1e3, -velocity * 1e3, velocity * 1e3)
    allowed = slider.following_error * 1e6
    _draw_bounds(panels["error [µm]"], error * 1e6, -allowed, allowed)


def _draw_bounds(panel: Axes, values: NDArray[np.float64], low: float, high: float) -> None:
    """Draw the limits `low` and `high`, each only if the values come close to it."""
    for limit in (low, high):
        greatest = np.nanmax(values * np.sign(limit), initial=0.0)
        if limit and greatest >= DRAWN_LIMIT_SHARE * abs(limit):
            panel.axhline(limit, color=RED, linewidth=0.9, linestyle=DASHES)


def _title(summary: Summary) -> str:
    outcomes = [goal.outcome for goal in summary.goals]
    counts = ", ".join(f"{outcomes.count(outcome)} {outcome}" for outcome in dict.fromkeys(outcomes))
    return f"{summary.name}   –   {summary.duration:.1f} s,  goals: {counts or 'none'}"


def _draw_modes(panel: Axes, records: NDArray[np.void], t: NDArray[np.float64], summary: Summary) -> None:
    """Draw the modes as a coloured band, and the goals as bars above the band."""
    gaps = _gaps(t)
    starts = np.concatenate([[0], np.union1d(np.flatnonzero(np.diff(records["mode"])) + 1, gaps)])
    ends = np.append(t[starts[1:] - np.isin(starts[1:], gaps)], t[-1])
    bands = [Rectangle((t[start], 0.0), end - t[start], 0.9) for start, end in zip(starts, ends, strict=True)]
    colours = [MODE_COLOURS[MODES[mode]] for mode in records["mode"][starts]]
    panel.add_collection(PatchCollection(bands, facecolors=colours, linewidths=0))
    for number, goal in enumerate(summary.goals):
        _draw_goal(panel, goal, 1.1 + 0.75 * (number % 2), float(t[0]), float(t[-1]))
    panel.set(ylim=(-0.1, 2.75), yticks=[0.45, 1.8], yticklabels=["mode", "goals"], ylabel="")
    shown = [Patch(color=MODE_COLOURS[Mode(name)], label=name) for name in summary.modes]
    outcome_colours = {goal.outcome: OUTCOME_COLOURS[goal.outcome] for goal in summary.goals}
    shown += [Patch(color=colour, label=f"goal {outcome}") for outcome, colour in outcome_colours.items()]
    panel.legend(
        handles=shown, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=12, frameon=False, fontsize=8, labelcolor=INK
    )


def _draw_goal(panel: Axes, goal: GoalSummary, y: float, begin: float, end: float) -> None:
    """Draw a goal as a bar labelled with the goal's name. A name longer than the bar is truncated or omitted."""
    start = begin if goal.given is None else goal.given
    ended = end if goal.ended is None else goal.ended
    colour = OUTCOME_COLOURS[goal.outcome]
    panel.add_patch(Rectangle((start, y), ended - start, 0.65, facecolor=colour, linewidth=0))
    if goal.outcome in ("rejected", "expired"):
        panel.plot([start], [y + 0.32], "x", color=colour, markersize=6, markeredgewidth=2)
    letters = int((ended - start) / max(end - begin, 1e-9) * 68.0 * FIGURE_WIDTH_IN / LETTER_WIDTH_PT) - 1
    name = goal.id if len(goal.id) <= letters else f"{goal.id[: letters - 1]}…"
    if letters >= min(4, len(goal.id)):
        anchor, offset = (start, y + 0.3), (3.0, 0.0)
        panel.annotate(
            name, anchor, offset, textcoords="offset points", color="white", fontsize=7, va="center", parse_math=False
        )


def _draw_curves(panel: Axes, t: NDArray[np.float64], values: NDArray[np.float64], colours: Sequence[str]) -> None:
    """Draw each column of `values`, (N, k), as a curve in which even the shortest excursion is visible."""
    for column, colour in zip(values.T, colours, strict=True):
        panel.plot(*_decimate(t, column), color=colour, linewidth=1.0)


def _label_curves(panel: Axes, names: Sequence[str], colours: Sequence[str]) -> None:
    """Add a legend that names each curve in the colour of the curve."""
    pairs = zip(names, colours, strict=True)
    _draw_legend(panel, [Line2D([], [], color=colour, label=name) for name, colour in pairs])


def _draw_timing(panel: Axes, records: NDArray[np.void], t: NDArray[np.float64], budget: float) -> None:
    lateness, cycle = records["lateness_ns"] / 1e3, records["parts_ns"].sum(axis=1) / 1e3
    panel.plot(*_decimate(t, lateness), color="#8c6bb1", linewidth=0.7)
    panel.plot(*_decimate(t, cycle), color="#2f6fb3", linewidth=0.7)
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
    _draw_legend(panel, handles)


def _gaps(t: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices of the records before which cycles are missing."""
    steps = np.diff(t)
    return np.flatnonzero(steps > 1.5 * steps.min(initial=np.inf)) + 1


def _decimate(t: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reduce a long curve to the minimum and the maximum of each bin, in order of time, with NaN in each gap."""
    gaps, size = _gaps(t), len(values) // CURVE_BINS
    pieces = [_thin(*piece, size) for piece in zip(np.split(t, gaps), np.split(values, gaps), strict=True)]
    times = np.concatenate([np.append(times, times[-1]) for times, _ in pieces])
    return times, np.concatenate([np.append(thin, np.nan) for _, thin in pieces])


def _thin(
    t: NDArray[np.float64], values: NDArray[np.float64], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reduce a curve without gaps to the minimum and the maximum of each bin of `size` values."""
    if size < 3:
        return t, values
    # The last bin is filled up with its last value. A bin is drawn as a gap only if it contains nothing but NaN.
    t, values = (np.pad(column, (0, -len(column) % size), mode="edge").reshape(-1, size) for column in (t, values))
    empty = np.isnan(values)
    lowest, highest = (np.where(empty, end, values) for end in (np.inf, -np.inf))
    at = np.sort(np.stack([lowest.argmin(axis=1), highest.argmax(axis=1)], axis=1), axis=1)
    times, thin = (np.take_along_axis(column, at, axis=1) for column in (t, values))
    return times.ravel(), thin.ravel()


def _draw_legend(panel: Axes, handles: list[Line2D]) -> None:
    legend = panel.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        ncols=len(handles),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
    )
    for text in legend.get_texts():  # names of marks and sliders
        text.set_parse_math(False)


def _style_axes(axes: Axes) -> None:
    """Draw frame, ticks and grid in pale colours."""
    axes.tick_params(colors=GREY, labelsize=8, length=2)
    axes.grid(axis="x", color=PALE, linewidth=0.5)
    for spine in axes.spines.values():
        spine.set_color(PALE)
