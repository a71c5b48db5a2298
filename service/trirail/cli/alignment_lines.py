"""Text output of alignments: calibrations, measurements, results, and the alignments in the report of a session."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from trirail_drivers.interface import NAMES

from trirail.cli import terminal

if TYPE_CHECKING:
    from trirail.alignment.alignment_request import LookReport
    from trirail.alignment.calibration_diff import ViewChange
    from trirail.alignment.camera_calibration import CameraCalibration
    from trirail.alignment.geometry_calibration import GeometryCalibration
    from trirail.alignment.procedure import Alignment, AlignmentRequest, Measurement, Observation
    from trirail.analysis.summary import AlignmentSummary

T = TypeVar("T")
ARCSECONDS = 3600.0 * 180.0 / math.pi
FRAME_DEVIATION = 1e-12
"""Standard deviation below which a parameter counts as fixed by the choice of the frame [m, rad]. The threshold is not
zero because of rounding."""
SUCCESSFUL_ENDS = ("reached", "calibrated", "checked")


def show_recorded(alignments: list[AlignmentSummary]) -> None:
    """Print each alignment with the remaining distances of its marks at every look."""
    terminal.out.print("\nalignments")
    for each in alignments:
        colour = "green" if each.end in SUCCESSFUL_ENDS else "yellow"
        made = f", {terminal.counted(each.corrections, 'correction')}" if each.purpose == "alignment" else ""
        looks = f"{terminal.counted(each.looks, 'look')}{made} in {each.seconds:.2f} s"
        who = terminal.plain(f"{each.id}  {each.purpose} of {each.user}")
        words = f": {terminal.plain(each.message)}" if each.message else ""
        terminal.out.print(f"  {each.began:9.3f} s  [{colour}]{each.end:11}[/]  {who}, {looks}{words}", soft_wrap=True)
        for name, ways in each.residuals.items():
            shown = " → ".join("–" if way is None else f"{way * 1e6:.2f}" for way in ways)
            terminal.out.print(f"               {terminal.plain(name)}  {shown} µm to its target", soft_wrap=True)


def show_calibration(result: CameraCalibration, file: Path) -> None:
    """Print the results of a calibration and the file in which it is saved."""
    for name, view in result.views.items():
        mirrored = ", mirrored" if view.mirrored else ""
        terminal.print_line(
            f"view {name}: {1e6 / view.scale:.3f} µm a pixel{mirrored}, residual {result.noise_of(name):.3f} pixel"
        )
    for name, mark in result.marks.items():
        (x, y), (dx, dy) = mark.place, mark.deviation
        terminal.print_line(f"mark {name}: x {x * 1e3:.3f} ± {dx * 1e3:.3f} mm, y {y * 1e3:.3f} ± {dy * 1e3:.3f} mm")
    terminal.print_line(f"kept in {file}")


def show_geometry(result: GeometryCalibration, labels: Sequence[str]) -> None:
    """Print the corrections to a geometry, the undetermined parameters, the outliers, and the residuals."""
    shown = {name: _labelled(name, labels) for name in result.parameters}
    for name, value in result.parameters.items():
        unit = "ppm" if name.endswith("scale") else "µrad" if name.endswith("angle") else "µm"
        deviation = result.deviations[name]
        if name in result.undetermined:
            known = "undetermined"
        elif deviation < FRAME_DEVIATION:
            known = "by the choice of the frame"
        else:
            known = f"± {deviation * 1e6:.1f}"
        terminal.print_line(f"{shown[name]:<32}{value * 1e6:>+10.1f} {unit:<5} {known}")
    if result.undetermined:
        names = ", ".join(shown[name] for name in result.undetermined)
        terminal.print_line(
            f"Undetermined, alone or in combination: {names}. The combinations stay as configured. More marks, "
            "a second camera or a larger field would determine more, unless two parameters have the same effect."
        )
    terminal.print_line(
        "The frame is that of the configuration, with the least corrections of the legs. Lengths are those of the mean "
        "of the three encoders, since pixels have no length of their own."
    )
    for each in result.outliers:
        swapped = f", at the place of {each.swapped_with}" if each.swapped_with else ""
        terminal.print_line(f"look {each.look}: {each.mark} is {each.distance:.1f} pixels off{swapped}; not used")
    held = result.residual
    if held.looks:
        terminal.print_line(
            f"{held.looks} looks held out of the fit: marks are off by {held.before_m * 1e6:.2f} µm ({held.before:.2f} "
            f"pixels) with the configured geometry, {held.after_m * 1e6:.2f} µm ({held.after:.2f} pixels) with this one"
            ", each with its own fit of the cameras"
        )
        if held.after >= held.before:
            terminal.print_line(
                "This geometry predicts them no better than the configured one: take more looks, or more marks."
            )
    systematic = "; larger than the noise: no geometry explains the rest" if result.is_systematic else ""
    terminal.print_line(f"residual {result.noise:.3f} pixel, pictures at rest {result.picture_noise:.3f}{systematic}")
    terminal.print_line(
        f"these corrections move the marks by {result.change * 1e6:.2f} ± {result.change_deviation * 1e6:.2f} µm over "
        "the travel"
    )
    if not result.is_significant:
        terminal.print_line(
            "The configured geometry is as good as can be measured: these corrections could make it worse. More looks, "
            "marks or pictures would be more certain."
        )


def _labelled(name: str, labels: Sequence[str]) -> str:
    """Return the name of a parameter with the label of its slider."""
    leg, _, parameter = name.partition(" ")
    return f"{labels[NAMES.index(leg)]} {parameter}"


def show_changes(changes: Iterable[ViewChange], missing: Iterable[str]) -> None:
    """Print how much each camera has moved since it was calibrated, and the views without marks."""
    for each in changes:
        (x, y), (dx, dy) = each.shift, each.shift_deviation
        verdict = "[red]was moved: calibrate again[/]" if each.is_changed else "as it was"
        terminal.out.print(
            f"view {terminal.plain(each.view)}: {verdict}; shifted by x {x * 1e6:.0f} ± {dx * 1e6:.0f} µm, "
            f"y {y * 1e6:.0f} ± {dy * 1e6:.0f} µm, turned by {each.turn * 1e3:.2f} ± "
            f"{each.deviation * 1e3:.2f} mrad, scale {each.scale * 1e6:+.0f} ± {each.scale_deviation * 1e6:.0f} ppm",
            soft_wrap=True,
        )
    for view in missing:
        terminal.out.print(
            f"view {terminal.plain(view)}: [red]none of its marks was found[/]; check light and part, or calibrate "
            "again if the camera was moved",
            soft_wrap=True,
        )


def print_looks(
    requests: Generator[AlignmentRequest, Observation, T], looks: int | None
) -> Generator[AlignmentRequest, Observation, T]:
    """Yield the same requests, and print each look when it arrives.

    `looks` is the total number of looks, or None if it is unknown.
    """
    from trirail.alignment.alignment_request import LookReport

    number = 0
    try:
        request = next(requests)
        while True:
            if isinstance(request, LookReport) and request.observation is not None:
                number += 1
                of = "" if looks is None else f" of {looks}"
                terminal.print_line(f"look {number}{of}: {_describe_look(request, request.observation)}")
            request = requests.send((yield request))
    except StopIteration as end:
        return end.value  # type: ignore[no-any-return]


def _describe_look(report: LookReport, seen: Observation) -> str:
    if report.measurement is None:
        return ", ".join(f"{name} ({u:.2f}, {v:.2f})" for name, (u, v) in seen.marks.items()) or "no marks"
    return format_measurement(report.measurement) + ("; corrects it" if report.correction is not None else "")


def format_measurement(alignment: Measurement) -> str:
    """Return a one-line description of the position of a part."""
    x, y = alignment.shift
    return (
        f"to go: x {x * 1e6:.2f} µm, y {y * 1e6:.2f} µm, φ {alignment.turn * ARCSECONDS:.2f} arcsec; "
        f"a mark {alignment.worst * 1e6:.2f} µm at most; distance {alignment.distance * 1e6:+.0f} ppm"
    )


def show_alignment(result: Alignment) -> None:
    """Print the result of an alignment."""
    reasons = {
        "reached": "the part lies right",
        "corrections": "no correction is left: raise --corrections or --tolerance, or look at backlash and noise",
        "growing": "the error grew: the cameras have moved since the calibration; calibrate again",
        "noise": "the pictures' noise is above the tolerance: raise --looks, --tolerance or --angle, or choose marks "
        "farther apart",
    }
    made = terminal.counted(len(result.corrections), "correction")
    terminal.print_line(f"{made} in {result.seconds:.2f} s: {reasons[result.why]}")
