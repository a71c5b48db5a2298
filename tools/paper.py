"""The paper's figures 3 to 11: motion of the three sliders in its examples, drawn and held against the tables.

python tools/paper.py --output DIR  (needs trirail[analysis])
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from service.algebra import Array
from service.errors import ServiceError, TrirailError
from service.geometry import LEGS, Geometry
from service.kinematics import inverse
from service.palette import SLIDERS

L0 = 0.3
DURATION = 3.0
TABLES = Path(__file__).resolve().parents[1] / "tests" / "data"
"""The solution of the loop equations (11) for the three examples, to 50 digits."""


class Example(NamedTuple):
    """A motion of the platform by equation (5), from the central configuration to twice `amplitude`."""

    name: str
    title: str
    amplitude: tuple[float, float, float]  # x* [m], y* [m], phi* [rad]


class Quantity(NamedTuple):
    """What a figure shows of the sliders."""

    name: str
    column: str  # in the tables, and with a slider's name
    symbol: str
    unit: str


class Curves(NamedTuple):
    """The three sliders over time, wherever they come from: t (N,) [s], the others (N, 3) in m, m/s, m/s²."""

    t: Array
    position: Array  # lambda_10
    velocity: Array  # v_10
    acceleration: Array  # gamma_10

    def of(self, quantity: Quantity) -> Array:
        """Return what the figures of a quantity show, (N, 3)."""
        return self[1 + QUANTITIES.index(quantity)]


class Comparison(NamedTuple):
    """A figure against its table: the greatest value, and the greatest difference over sliders and times."""

    figure: int
    example: str
    quantity: str
    unit: str
    greatest: float
    difference: float
    picture: str


EXAMPLES = (
    Example("rotation", "Rotation", (0.0, 0.0, math.pi / 12)),
    Example("translation_x", "Motion along x", (0.025, 0.0, 0.0)),
    Example("translation_y", "Motion along y", (0.0, 0.025, 0.0)),
)
QUANTITIES = (  # in the order of the fields of Curves
    Quantity("displacement", "lambda10", r"\lambda_{10}", "m"),
    Quantity("velocity", "v10", "v_{10}", "m/s"),
    Quantity("acceleration", "gamma10", r"\gamma_{10}", "m/s²"),
)

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
"""Length of the dashes in which curves that coincide, as all three do in the rotation, take turns [pt]."""


def computed(example: Example, t: Array) -> Curves:
    """Return the motion of the sliders at times t (N,) [s], by (5) and the inverse kinematics."""
    w = math.pi / 3.0
    motion = inverse(
        Geometry.symmetric(L0),
        np.outer(1.0 - np.cos(w * t), example.amplitude),
        np.outer(w * np.sin(w * t), example.amplitude),
        np.outer(w * w * np.cos(w * t), example.amplitude),
    )
    return Curves(t, motion.position, motion.velocity, motion.acceleration)


def tabulated(example: Example) -> Curves:
    """Return the exact motion of the sliders. Raises ServiceError if its table cannot be read."""
    path = TABLES / f"paper_{example.name}.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise ServiceError(f"{path}: {error.strerror}") from error
    columns = [[f"{quantity.column}_{leg}" for leg in LEGS] for quantity in QUANTITIES]
    position, velocity, acceleration = (
        np.array([[float(row[key]) for key in keys] for row in rows]) for keys in columns
    )
    return Curves(np.array([float(row["t"]) for row in rows]), position, velocity, acceleration)


def figures() -> Iterator[tuple[int, Example, Quantity]]:
    """Yield the paper's figures with their numbers."""
    pairs = ((example, quantity) for example in EXAMPLES for quantity in QUANTITIES)
    for number, (example, quantity) in enumerate(pairs, start=3):
        yield number, example, quantity


def greatest_difference(curves: Curves, reference: Curves, quantity: Quantity) -> float:
    """Return the greatest difference of a quantity in its unit, over the sliders and the same times."""
    return float(np.max(np.abs(curves.of(quantity) - reference.of(quantity))))


def plot(axes: Axes, quantity: Quantity, curves: Curves) -> None:
    """Draw a quantity of the three sliders; where the curves of several are one, they share it in dashes."""
    sliders = curves.of(quantity).T
    visible = 1e-3 * float(np.ptp(sliders))
    for i, (slider, colour) in enumerate(zip(LEGS, SLIDERS, strict=True)):
        one = [j for j in range(3) if np.max(np.abs(sliders[j] - sliders[i])) <= visible]
        turns = (-DASH * one.index(i), (DASH, DASH * (len(one) - 1)))
        rgb = [part / 255 for part in colour[:3]]
        axes.plot(curves.t, sliders[i], color=rgb, linestyle=turns if len(one) > 1 else "-")
        axes.plot([], [], color=rgb, label=f"${quantity.symbol}^{slider}$")


def draw(axes: Axes, title: str, quantity: Quantity, curves: Curves) -> None:
    """Draw one whole figure."""
    axes.axhline(0.0, color="#9ca3af", linewidth=1.0)
    plot(axes, quantity, curves)
    axes.set_title(title, loc="left", pad=12.0)
    axes.set_xlabel("$t$ [s]")
    axes.set_ylabel(f"{quantity.name} [{quantity.unit}]")
    axes.set_xlim(0.0, DURATION)
    axes.margins(y=0.08)
    axes.legend(loc="lower right", bbox_to_anchor=(1.02, 0.985), ncols=3)


def write(output: Path, curves: Mapping[Example, Curves]) -> dict[str, Path]:
    """Write a picture of each figure, and an overview of all. Raises ServiceError."""
    pictures = {}
    with matplotlib.rc_context(STYLE):
        overview = Figure(figsize=(15.0, 10.0), layout="constrained")
        panels = overview.subplots(len(QUANTITIES), len(EXAMPLES))
        for number, example, quantity in figures():
            single = Figure(figsize=(5.6, 3.8), layout="constrained")
            title = f"Fig. {number}   {example.title}"
            for axes in (single.subplots(), panels[QUANTITIES.index(quantity), EXAMPLES.index(example)]):
                draw(axes, title, quantity, curves[example])
            pictures[f"figure_{number:02}"] = single
        pictures["paper"] = overview
        try:
            output.mkdir(parents=True, exist_ok=True)
            for name, picture in pictures.items():
                picture.savefig(output / f"{name}.png", dpi=130)
        except OSError as error:
            raise ServiceError(f"cannot write pictures to {output}: {error.strerror}") from error
    return {name: output / f"{name}.png" for name in pictures}


def compare(pictures: Mapping[str, Path]) -> list[Comparison]:
    """Hold what each figure shows against its table. Raises TrirailError."""
    found = []
    for number, example, quantity in figures():
        exact = tabulated(example)
        here = computed(example, exact.t)
        found.append(
            Comparison(
                figure=number,
                example=example.name,
                quantity=quantity.name,
                unit=quantity.unit,
                greatest=float(np.max(np.abs(exact.of(quantity)))),
                difference=greatest_difference(here, exact, quantity),
                picture=str(pictures[f"figure_{number:02}"]),
            )
        )
    return found


def over_all(comparisons: Sequence[Comparison]) -> dict[str, float]:
    """Return the greatest difference of each quantity in its unit, over the examples."""
    return {
        quantity.name: max(row.difference for row in comparisons if row.quantity == quantity.name)
        for quantity in QUANTITIES
    }


def show(comparisons: Sequence[Comparison]) -> None:
    """Print the comparisons for people."""
    print(f"{'figure':<8}{'motion':<16}{'quantity':<14}{'greatest':>11}{'difference from the table':>28}")
    for row in comparisons:
        print(
            f"{row.figure:<8}{row.example:<16}{row.quantity:<14}{row.greatest:>11.6f}{row.difference:>28.1e} {row.unit}"
        )
    worst = over_all(comparisons)
    for quantity in QUANTITIES:
        print(f"{'3-11':<8}{'all':<16}{quantity.name:<14}{'':>11}{worst[quantity.name]:>28.1e} {quantity.unit}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw and compare; return the exit code."""
    parser = argparse.ArgumentParser(
        description="Draws the paper's figures 3 to 11 and checks them against its tables."
    )
    parser.add_argument("--output", type=Path, default=Path("figures"), help="folder for the pictures (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")
    options = parser.parse_args(arguments)
    try:
        curves = {example: computed(example, np.linspace(0.0, DURATION, 601)) for example in EXAMPLES}
        pictures = write(options.output, curves)
        comparisons = compare(pictures)
    except TrirailError as error:
        print(f"paper: {error}", file=sys.stderr)
        return 1
    if options.json:
        rows = [row._asdict() for row in comparisons]
        print(json.dumps({"figures": rows, "differences": over_all(comparisons), "paper": str(pictures["paper"])}))
    else:
        show(comparisons)
        print(f"pictures: {pictures['paper']}, and one for each figure beside it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
