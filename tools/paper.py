"""Figures 3 to 11 of the paper by three methods: computed, from tables with 50 digits, and from the running service.

python tools/paper.py --output DIR  (needs trirail[analysis])

The tool computes the motion of the sliders in the paper's examples by equation (5) and the recursion, and draws it. It
starts its own service on simulated drives, which follows the same three motions, and draws the setpoints of its
recording over the curves. Finally it prints the differences between the three methods. With --offline it starts no
service.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from paper_figures import write
from paper_motions import (
    DURATION,
    EXAMPLES,
    QUANTITIES,
    computed,
    figures,
    greatest_difference,
    tabulated,
)
from paper_service import Driven, drive
from trirail.config import SIM, load
from trirail.errors import ServiceError, TrirailError


class Comparison(NamedTuple):
    """Maximum value of a figure, and maximum differences over all sliders and times, in the unit of the figure."""

    figure: int
    example: str
    quantity: str
    unit: str
    greatest: float
    difference: float
    """Difference between the computed values and the table, at the times of the table."""
    service: float | None
    """Difference between the service's setpoints and the computed values, in every cycle; None without a service."""
    measured: float | None
    """Difference between measured and computed slider positions; None for velocities and accelerations."""
    picture: str


def compare(pictures: Mapping[str, Path], service: Mapping[str, Driven]) -> list[Comparison]:
    """Compare the computed values with the tables and, if the service ran, with the service. Raises TrirailError."""
    comparisons = []
    for number, example, quantity in figures():
        exact = tabulated(example)
        here = computed(example, exact.t)
        setpoints = measured = None
        if example.name in service:
            commanded, positions = service[example.name]
            expected = computed(example, commanded.t)
            setpoints = greatest_difference(commanded, expected, quantity)
            if quantity is QUANTITIES[0]:
                measured = float(np.max(np.abs(positions - expected.position)))
        comparisons.append(
            Comparison(
                figure=number,
                example=example.name,
                quantity=quantity.name,
                unit=quantity.unit,
                greatest=float(np.max(np.abs(exact.values_of(quantity)))),
                difference=greatest_difference(here, exact, quantity),
                service=setpoints,
                measured=measured,
                picture=str(pictures[f"figure_{number:02}"]),
            )
        )
    return comparisons


def over_all(comparisons: Sequence[Comparison], of: str) -> dict[str, float]:
    """Return the maximum of the difference `of` over all examples, for each quantity in its unit."""
    greatest: dict[str, float] = {}
    for row in comparisons:
        value = getattr(row, of)
        if value is not None:
            greatest[row.quantity] = max(value, greatest.get(row.quantity, 0.0))
    return greatest


def first_jerk() -> float:
    """Return the maximum jerk of a slider in the cycle that begins or ends a motion [m/s³]."""
    ends = np.array([0.0, DURATION])
    step = max(float(np.max(np.abs(computed(example, ends).acceleration))) for example in EXAMPLES)
    return step / load(SIM).period


def show(comparisons: Sequence[Comparison]) -> None:
    """Print the comparisons as text."""
    with_service = any(row.service is not None for row in comparisons)
    heads = ("computed − table", *(("service − computed", "measured − computed") if with_service else ()))
    print(f"{'figure':<8}{'motion':<16}{'quantity':<14}{'greatest':>10}" + "".join(f"{head:>21}" for head in heads))
    ofs = ("difference", "service", "measured")[: len(heads)]
    for row in comparisons:
        print(
            f"{row.figure:<8}{row.example:<16}{row.quantity:<14}{row.greatest:>10.6f}"
            + "".join(_cell(getattr(row, of)) for of in ofs)
            + f"  {row.unit}"
        )
    worst = [over_all(comparisons, of) for of in ofs]
    for quantity in QUANTITIES:
        print(
            f"{'3-11':<8}{'all':<16}{quantity.name:<14}{'':>10}"
            + "".join(_cell(each.get(quantity.name)) for each in worst)
            + f"  {quantity.unit}"
        )
    if with_service:
        limit = min(load(SIM).limits.slider.jerks)
        print(
            f"\nservice: its setpoints in every cycle, t = 1 period to {DURATION:g} s, read from its recording;\n"
            "measured: the simulated drives' positions at the SYNC at which they were to reach these.\n"
            "Equation (5) begins and ends with an acceleration at standstill: for one cycle that is a jerk of\n"
            f"{math.ceil(first_jerk())} m/s³, which the sliders' limit of {SIM.name}, {limit:g} m/s³, allows."
        )


def _cell(value: float | None) -> str:
    return f"{'' if value is None else format(value, '.1e'):>21}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the figures and compare the methods; return the exit code."""
    parser = argparse.ArgumentParser(
        description="Draws the paper's figures 3 to 11, as computed and as a service of its own on simulated drives "
        "runs them, and tells how far these are from each other and from tables of 50 digits."
    )
    parser.add_argument("--output", type=Path, default=Path("figures"), help="folder for the pictures (%(default)s)")
    parser.add_argument("--offline", action="store_true", help="compute only, without a service")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of words")
    options = parser.parse_args(arguments)
    recording = None if options.offline else options.output / "paper.rrd"
    try:
        service = _driven(recording, quiet=options.json) if recording else {}
        curves = {example: computed(example, np.linspace(0.0, DURATION, 601)) for example in EXAMPLES}
        pictures = write(options.output, curves, {name: done.commanded for name, done in service.items()})
        comparisons = compare(pictures, service)
    except TrirailError as error:
        print(f"paper: {error}", file=sys.stderr)
        return 1
    if options.json:
        print(
            json.dumps(
                {
                    "figures": [row._asdict() for row in comparisons],
                    "differences": over_all(comparisons, "difference"),
                    "service": over_all(comparisons, "service"),
                    "measured": over_all(comparisons, "measured"),
                    "paper": str(pictures["paper"]),
                    "recording": str(recording) if recording else None,
                }
            )
        )
    else:
        show(comparisons)
        print(f"\npictures: {pictures['paper']}, and one for each figure beside it")
        if recording:
            print(f"recording: {recording}")
    return 0


def _driven(recording: Path, quiet: bool) -> dict[str, Driven]:
    """Let a service follow the motions, and print its progress unless `quiet`; return the motions by name."""
    try:
        recording.parent.mkdir(parents=True, exist_ok=True)
        recording.unlink(missing_ok=True)  # it is replaced, as the pictures are
    except OSError as error:
        raise ServiceError(f"cannot write pictures to {recording.parent}: {error.strerror}") from error
    say = (lambda _: None) if quiet else (lambda words: print(words, file=sys.stderr))
    return {example.name: done for example, done in drive(recording, say).items()}


if __name__ == "__main__":
    sys.exit(main())
