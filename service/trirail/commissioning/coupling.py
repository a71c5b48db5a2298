"""Judgement of the coupling between drives and sliders: assignment, direction and scale. All functions are pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from trirail_drivers.config import Drive, Drives
from trirail_drivers.interface import NAMES

from trirail.commissioning.judgement import Changes, Judgement, format_mm
from trirail.naming import Labels, label

SCALE_TOLERANCE: Final = 0.02
"""Relative difference between drive and rule above which the scale counts as wrong, for a stroke by hand."""
MAX_RULE_UNCERTAINTY: Final = 0.5
"""Uncertainty of the rule, relative to the stroke, above which the rule cannot show the scale."""
PLAY_TOLERANCE: Final = 0.1
"""Relative difference between drive and rule above which the scale counts as wrong, for a stroke of 1 mm under power.

The tolerance is larger than SCALE_TOLERANCE, because play in the screw or belt is a larger share of a short stroke."""
MAX_BACKLASH_M: Final = 0.0004
"""Maximum loss of travel in both directions that backlash can explain [m].

Over a stroke of 1 mm, backlash has the same effect as a wrong scale."""
MIN_COUNTED_SHARE: Final = 0.2
"""Fraction of a stroke below which an encoder does not move, for a stroke under power."""
MIN_PUSHED_SHARE: Final = 0.02
"""Fraction of a stroke below which an encoder does not move, for a stroke by hand.

It is smaller than MIN_COUNTED_SHARE, because the scale may be very wrong."""
MIN_REVERSED_SHARE: Final = 0.05
"""Fraction of a stroke, counted in the wrong direction, above which an encoder counts against its motor."""
LOOSE_ENCODER_REMEDY: Final = "fasten the encoder of drive {} on its shaft, and check its cable; no power before that"


class MoveObservation(NamedTuple):
    """Measurements while a single powered drive moves out and back. Lengths are signed [m]."""

    drive: str
    commanded: float
    out: float
    """Distance on the way out, measured by the drive's encoder."""
    back: float
    """Distance on the way back, measured by the drive's encoder."""
    following: float
    """Maximum following error of the drive."""
    stopped: str
    """Reason why the drives were stopped during the motion; "" if they were not stopped."""
    slider: str | None
    """Slider that the person saw moving; None if no slider moved."""
    rule_out: float
    """Distance of the slider on the way out, measured by the rule."""
    rule_back: float
    """Reading of the rule after the way back, relative to the reading at the start."""
    rule_resolution: float
    encoder_resolution: float
    labels: Labels = NAMES


class PushObservation(NamedTuple):
    """Measurements while a person pushes a slider out and back by hand, without power. Lengths are signed [m]."""

    slider: str
    rule: float
    """Distance on the way out, measured by the rule."""
    counted: tuple[float, float, float]
    """Distances on the way out, measured by the encoders of the drives A, B, C."""
    rule_back: float
    """Distance on the way back, measured by the rule."""
    counted_back: tuple[float, float, float]
    """Distances on the way back, measured by the encoders of the drives A, B, C."""
    rule_resolution: float
    encoder_resolution: float
    labels: Labels = NAMES


class _Stroke(NamedTuple):
    """Distance of a motion in one direction, measured by the encoder and by the rule [m]."""

    counted: float
    rule: float

    @property
    def ratio(self) -> float:
        """Ratio of the distance that the encoder counted to the distance on the rule."""
        return abs(self.counted / self.rule)


def judge_move(seen: MoveObservation, drives: Drives) -> Judgement:
    """Judge if a powered drive moved its slider in the right direction and by the right distance."""
    name, slider = seen.drive, seen.slider
    by_encoder = (
        f"drive {name} counted {format_mm(seen.out)} of {format_mm(seen.commanded)}, "
        f"following error {seen.following * 1e3:.3f} mm"
    )
    if slider is None:
        words = (by_encoder, "no slider moved")
        if abs(seen.out) >= MIN_COUNTED_SHARE * abs(seen.commanded):
            return Judgement(
                "wrong",
                (*words, "the motor turns without the slider: the coupling between them is loose or broken"),
                f"fasten the coupling between motor {name} and its screw or belt, then repeat this step",
            )
        return Judgement(
            "wrong" if seen.stopped else "failed",
            (*words, seen.stopped or "the drive did nothing", "the motor does not turn, or is blocked"),
            f"check drive {name}: motor phases, brake (is it released?), current limit, jammed slider",
        )
    by_rule = f"slider {label(slider, seen.labels)} moved {format_mm(seen.rule_out)} by the rule"
    if seen.out / seen.commanded < -MIN_REVERSED_SHARE:
        return Judgement(
            "wrong",
            (by_encoder, by_rule, f"the encoder of drive {name} counts against its motor: with power it runs away"),
            f"in drive {name} itself: exchange two motor phases, or set the encoder's polarity with the manufacturer's "
            "tool, "
            "and run its commutation search again; `direction` in the configuration does not help here",
        )
    if abs(seen.out) < MIN_COUNTED_SHARE * min(abs(seen.commanded), abs(seen.rule_out)):
        return Judgement(
            "wrong",
            (by_encoder, by_rule, f"loose encoder: the slider moves and the encoder of drive {name} does not count it"),
            LOOSE_ENCODER_REMEDY.format(name),
        )
    if seen.stopped:
        return Judgement(
            "failed",
            (by_encoder, by_rule, seen.stopped),
            "if the slider moves freely, tune the drive's position loop with the manufacturer's tool, then repeat this "
            "step",
        )
    out, back = _Stroke(seen.out, seen.rule_out), _Stroke(seen.back, seen.rule_back - seen.rule_out)
    losses = [abs(stroke.counted) - abs(stroke.rule) for stroke in (out, back)]
    uncertainty = 2.0 * (seen.rule_resolution + seen.encoder_resolution)
    readable = uncertainty <= MAX_RULE_UNCERTAINTY * min(abs(out.rule), abs(back.rule))
    # A loss that is smaller than the uncertainty of the rule may be only an error of the reading.
    is_lossy = min(losses) > max(PLAY_TOLERANCE * abs(seen.out), uncertainty)
    if slider == name and readable and is_lossy and max(losses) <= MAX_BACKLASH_M:
        return Judgement(
            "wrong",
            (
                by_encoder,
                by_rule,
                f"it moved {format_mm(losses[0])} less than counted out and {format_mm(losses[1])} back: play",
            ),
            f"check the coupling, screw or belt of slider {label(name, seen.labels)} for play; if there is none, "
            "it is a wrong scale, which the step by hand finds over 10 mm",
        )
    return _judge_coupling(name, slider, out, back, seen, drives, (by_encoder, by_rule), PLAY_TOLERANCE)


def judge_push(seen: PushObservation, drives: Drives) -> Judgement:
    """Judge if the encoder on a pushed slider belongs to the right drive, with the right direction and scale."""
    at = NAMES.index(seen.slider)
    sizes = [max(abs(out), abs(back)) for out, back in zip(seen.counted, seen.counted_back, strict=True)]
    largest = sizes.index(max(sizes))
    counted = ", ".join(f"{name} {format_mm(out)}" for name, out in zip(NAMES, seen.counted, strict=True))
    slider = label(seen.slider, seen.labels)
    words = (f"slider {slider} was pushed {format_mm(seen.rule)} by the rule; the drives counted {counted}",)
    if min(abs(seen.rule), abs(seen.rule_back)) < 5.0 * seen.rule_resolution:
        return Judgement(
            "failed",
            (*words, "one direction is too short to be judged"),
            "push it further: 10 mm, or as far as it goes, and back",
        )
    if max(sizes) < MIN_PUSHED_SHARE * abs(seen.rule):
        return Judgement(
            "wrong",
            (*words, "loose encoder: the slider moves and no encoder counts it"),
            LOOSE_ENCODER_REMEDY.format(seen.slider),
        )
    drive = seen.slider if sizes[at] >= MIN_COUNTED_SHARE * sizes[largest] else NAMES[largest]
    index = NAMES.index(drive)
    out, back = _Stroke(seen.counted[index], seen.rule), _Stroke(seen.counted_back[index], seen.rule_back)
    return _judge_coupling(drive, seen.slider, out, back, seen, drives, words, SCALE_TOLERANCE)


def _judge_coupling(
    name: str,
    slider: str,
    out: _Stroke,
    back: _Stroke,
    seen: MoveObservation | PushObservation,
    drives: Drives,
    words: tuple[str, ...],
    tolerance: float,
) -> Judgement:
    """Judge the node, direction and scale of the drive `name` from two strokes of the slider that belongs to it.

    A wrong scale has the same effect in both directions, but slip and play do not. A scale is therefore judged only if
    the ratios of the two strokes agree within `tolerance`, or within the uncertainty of the rule.
    """
    drive, configured = _drive(drives, name), _drive(drives, slider)
    rule_resolution, encoder_resolution = seen.rule_resolution, seen.encoder_resolution
    named = f"slider {label(slider, seen.labels)}"
    reasons = [*words]
    # Direction and counts per metre follow the drive, also where the two strokes do not show them.
    as_configured = {"node": drive.node, "direction": drive.direction, "counts_per_metre": drive.counts_per_metre}
    if slider != name:
        reasons.append(f"swapped nodes: drive {name}, node {drive.node}, has {named}")
    if min(abs(out.rule), abs(back.rule)) <= 2.0 * rule_resolution:
        reasons.append(f"the rule, read to {rule_resolution * 1e3:g} mm, shows neither direction nor scale")
        if slider == name:
            return Judgement("failed", tuple(reasons), "read it more finely, or push the slider further")
        return _propose_changes(slider, configured, as_configured, reasons)
    uncertainties = [2.0 * (rule_resolution + encoder_resolution) / abs(stroke.rule) for stroke in (out, back)]
    ratios = out.ratio, back.ratio
    if abs(ratios[0] - ratios[1]) > max(ratios) * max(tolerance, sum(uncertainties)):
        reasons += [
            f"drive {name} counts {ratios[0]:.1%} of the slider's travel out and {ratios[1]:.1%} back",
            "slipping encoder or coupling: counts are lost on the way, or there is as much play",
        ]
        remedy = f"fasten encoder and coupling of drive {name} on their shafts, check for play, then repeat this step"
        return Judgement("wrong", tuple(reasons), remedy, _changes(slider, configured, as_configured))
    direction, counts = drive.direction, drive.counts_per_metre
    if out.counted * out.rule < 0.0:
        direction = -drive.direction
        reasons.append(f"wrong direction: drive {name} counts against the motion of {named}")
    uncertainty = max(uncertainties)
    if uncertainty > MAX_RULE_UNCERTAINTY:
        reasons.append(
            f"a rule read to {rule_resolution * 1e3:g} mm does not show the scale over so short a stroke; push further"
        )
    elif all(abs(ratio - 1.0) > max(tolerance, each) for ratio, each in zip(ratios, uncertainties, strict=True)):
        ratio = (abs(out.counted) + abs(back.counted)) / (abs(out.rule) + abs(back.rule))
        counts = _round_counts(drive.counts_per_metre * ratio, uncertainty)
        reasons.append(
            f"wrong scale: drive {name} counts {ratio:.3g} times the slider's travel, out and back, "
            f"read to {uncertainty:.1%}"
        )
    elif slider == name and direction == drive.direction:
        accuracy = max(tolerance, uncertainty)
        reasons.append(f"direction is right, and counts per metre within the accuracy of {accuracy:.1%}")
    values = as_configured | {"direction": direction, "counts_per_metre": counts}
    return _propose_changes(slider, configured, values, reasons)


def _propose_changes(
    slider: str, configured: Drive, values: Mapping[str, int | float], reasons: Sequence[str]
) -> Judgement:
    """Return a judgement that proposes those of the `values` that differ from the configured values."""
    changes = _changes(slider, configured, values)
    if not changes:
        return Judgement("ok", tuple(reasons))
    lines = (
        f"{path} = {value:.10g}, not {getattr(configured, path.rpartition('.')[2]):.10g}"
        for path, value in changes.items()
    )
    remedy = f"in the configuration {', '.join(lines)}; then start again with it"
    return Judgement("wrong", tuple(reasons), remedy, changes)


def _changes(slider: str, configured: Drive, values: Mapping[str, int | float]) -> Changes:
    return {f"drives.{slider}.{key}": value for key, value in values.items() if value != getattr(configured, key)}


def _drive(drives: Drives, name: str) -> Drive:
    return drives.each[NAMES.index(name)]


def _round_counts(counts: float, uncertainty: float) -> float:
    """Round to one digit more than a relative uncertainty justifies."""
    digits = 2
    while 10.0**-digits > uncertainty / 10.0 and digits < 8:
        digits += 1
    return float(f"{counts:.{digits}g}")
