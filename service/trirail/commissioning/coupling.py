"""Which slider goes with which drive, which way and how far: from what was seen to what should be configured; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from trirail_drivers.config import Drive, Drives
from trirail_drivers.interface import NAMES

from trirail.commissioning.judgement import Changes, Judged, in_mm
from trirail.naming import Labels, label

SCALE: Final = 0.02
"""Share of a way by which drive and rule may differ where the rule could be read better than that."""
COARSE: Final = 0.5
"""Share of a way that a rule leaves open beyond which it tells nothing of the scale."""
PLAY: Final = 0.1
"""Share of 1 mm by which slider and drive may differ for play in screw or belt: less is no wrong scale there."""
BACKLASH: Final = 0.0004
"""So much less than counted [m] a slider may go both ways for play: over 1 mm that looks like a wrong scale."""
FOLLOWS: Final = 0.2
"""Share of a way that an encoder has to count for it to have moved at all."""
NOTHING: Final = 0.02
"""Share of a way by hand that an encoder has to count for it to be on that slider, however wrong its scale."""
AGAINST: Final = 0.05
"""Share of a way that an encoder has to count backwards for it to count against its motor."""
LOOSE: Final = "fasten the encoder of drive {} on its shaft, and look at its cable; no power before that"


class MoveSeen(NamedTuple):
    """One drive alone was to move its slider there and back. Ways are signed [m]."""

    drive: str
    asked: float
    out: float
    """By its encoder."""
    back: float
    """By its encoder, on the way back."""
    following: float
    """Its greatest following error [m]."""
    stopped: str
    """Why it was stopped on the way; "" where it was not."""
    slider: str | None
    """Which slider was seen to move; None for none of them."""
    rule_out: float
    """By the rule beside that slider."""
    rule_back: float
    """What of that was left when it had come back."""
    read_to: float
    """How finely the rule can be read [m]."""
    step: float
    """How fine the encoder's counts are [m]."""
    labels: Labels = NAMES
    """What people call the sliders."""


class _Stroke(NamedTuple):
    """A way in one direction [m]."""

    counted: float
    rule: float

    @property
    def ratio(self) -> float:
        """How many times as far the encoder counts as the slider goes."""
        return abs(self.counted / self.rule)


class PushSeen(NamedTuple):
    """A slider was pushed there and back by hand, nothing had power. Ways are signed [m]."""

    slider: str
    rule: float
    ways: tuple[float, float, float]
    """By the encoders of drives A, B, C."""
    rule_back: float
    """When it was pushed back, to about where it was."""
    ways_back: tuple[float, float, float]
    read_to: float
    step: float
    labels: Labels = NAMES


def judge_move(seen: MoveSeen, drives: Drives) -> Judged:
    """Judge which slider moved, which way, how far, and whether its encoder goes with it."""
    name, slider = seen.drive, seen.slider
    by_encoder = (
        f"drive {name} counted {in_mm(seen.out)} of {in_mm(seen.asked)}, following error {seen.following * 1e3:.3f} mm"
    )
    if slider is None:
        words = (by_encoder, "no slider moved")
        if abs(seen.out) >= FOLLOWS * abs(seen.asked):
            return Judged(
                "wrong",
                (*words, "the motor turns, but nothing goes with it: its coupling to the slider is loose or broken"),
                f"fasten the coupling between motor {name} and its screw or belt, then repeat this step",
            )
        return Judged(
            "wrong" if seen.stopped else "failed",
            (*words, seen.stopped or "the drive did nothing", "the motor does not turn, or cannot"),
            f"look at drive {name}: motor phases, brake (is it released?), current limit, jammed slider",
        )
    by_rule = f"slider {label(slider, seen.labels)} moved {in_mm(seen.rule_out)} by the rule"
    if seen.out / seen.asked < -AGAINST:
        return Judged(
            "wrong",
            (by_encoder, by_rule, f"the encoder of drive {name} counts against its motor: with power it runs away"),
            f"in drive {name} itself: exchange two motor phases, or set the encoder's polarity with its maker's tool, "
            "and let it find its commutation again; `direction` in the configuration does not help here",
        )
    if abs(seen.out) < FOLLOWS * min(abs(seen.asked), abs(seen.rule_out)):
        return Judged(
            "wrong",
            (by_encoder, by_rule, f"loose encoder: the slider moves and the encoder of drive {name} does not count it"),
            LOOSE.format(name),
        )
    if seen.stopped:
        return Judged(
            "failed",
            (by_encoder, by_rule, seen.stopped),
            "if the slider moves freely, tune the drive's position loop with its maker's tool, then repeat this step",
        )
    out, back = _Stroke(seen.out, seen.rule_out), _Stroke(seen.back, seen.rule_back - seen.rule_out)
    lost = [abs(stroke.counted) - abs(stroke.rule) for stroke in (out, back)]
    readable = 2.0 * (seen.read_to + seen.step) <= COARSE * min(abs(out.rule), abs(back.rule))
    if slider == name and readable and PLAY * abs(seen.out) < min(lost) and max(lost) <= BACKLASH:
        return Judged(
            "wrong",
            (by_encoder, by_rule, f"it went {in_mm(lost[0])} less than counted there and {in_mm(lost[1])} back: play"),
            f"look for play in the coupling, screw or belt of slider {label(name, seen.labels)}; where there is none, "
            "it is a wrong scale, which the step by hand finds over 10 mm",
        )
    return _coupled(name, slider, out, back, seen, drives, (by_encoder, by_rule), PLAY)


def judge_push(seen: PushSeen, drives: Drives) -> Judged:
    """Judge which drive's encoder is on the slider that was pushed, which way and how finely it counts."""
    at = NAMES.index(seen.slider)
    sizes = [max(abs(way), abs(back)) for way, back in zip(seen.ways, seen.ways_back, strict=True)]
    most = sizes.index(max(sizes))
    counted = ", ".join(f"{name} {in_mm(way)}" for name, way in zip(NAMES, seen.ways, strict=True))
    slider = label(seen.slider, seen.labels)
    words = (f"slider {slider} was pushed {in_mm(seen.rule)} by the rule; the drives counted {counted}",)
    if min(abs(seen.rule), abs(seen.rule_back)) < 5.0 * seen.read_to:
        return Judged(
            "failed",
            (*words, "there or back is too little to be judged"),
            "push it further: 10 mm, or as far as it goes, and back",
        )
    if max(sizes) < NOTHING * abs(seen.rule):
        return Judged(
            "wrong",
            (*words, "loose encoder: the slider moves and no encoder counts it"),
            LOOSE.format(seen.slider),
        )
    drive = seen.slider if sizes[at] >= FOLLOWS * sizes[most] else NAMES[most]
    index = NAMES.index(drive)
    out, back = _Stroke(seen.ways[index], seen.rule), _Stroke(seen.ways_back[index], seen.rule_back)
    return _coupled(drive, seen.slider, out, back, seen, drives, words, SCALE)


def _coupled(
    name: str,
    slider: str,
    out: _Stroke,
    back: _Stroke,
    seen: MoveSeen | PushSeen,
    drives: Drives,
    words: tuple[str, ...],
    tolerance: float,
) -> Judged:
    """Judge a drive, whose encoder has counted two strokes, by the slider that went with it, and the rule beside that.

    A wrong scale is the same factor both ways, a slip or play is not: strokes are to differ by less than `tolerance`,
    or by what the rule leaves open.
    """
    drive, configured, read_to, step = _of(drives, name), _of(drives, slider), seen.read_to, seen.step
    named = f"slider {label(slider, seen.labels)}"
    found = [*words]
    if slider != name:
        found.append(f"swapped nodes: drive {name}, node {drive.node}, has {named}")
    if min(abs(out.rule), abs(back.rule)) <= 2.0 * read_to:
        found.append(f"the rule, read to {read_to * 1e3:g} mm, shows neither direction nor scale")
        if slider == name:
            return Judged("failed", tuple(found), "read it more finely, or push the slider further")
        return _changed(slider, configured, {"node": drive.node}, found)
    unread = [2.0 * (read_to + step) / abs(stroke.rule) for stroke in (out, back)]
    ratios = out.ratio, back.ratio
    if abs(ratios[0] - ratios[1]) > max(ratios) * max(tolerance, sum(unread)):
        found += [
            f"of the slider's way drive {name} counts {ratios[0]:.1%} there and {ratios[1]:.1%} back",
            "slipping encoder or coupling: counts are lost on the way, or there is as much play",
        ]
        remedy = f"fasten encoder and coupling of drive {name} on their shafts, look for play, then repeat this step"
        return Judged("wrong", tuple(found), remedy, _node(slider, configured, drive))
    direction, counts = drive.direction, drive.counts_per_metre
    if out.counted * out.rule < 0.0:
        direction = -drive.direction
        found.append(f"wrong direction: by the counts of drive {name} {named} goes the other way")
    open_share = max(unread)
    if open_share > COARSE:
        found.append(
            f"a rule read to {read_to * 1e3:g} mm does not tell the scale over so short a way; push it further"
        )
    elif all(abs(ratio - 1.0) > max(tolerance, left) for ratio, left in zip(ratios, unread, strict=True)):
        ratio = (abs(out.counted) + abs(back.counted)) / (abs(out.rule) + abs(back.rule))
        counts = _rounded(drive.counts_per_metre * ratio, open_share)
        found.append(
            f"wrong scale: drive {name} counts {ratio:.3g} times as far as the slider goes, there and back, "
            f"read to {open_share:.1%}"
        )
    elif slider == name and direction == drive.direction:
        readable = max(tolerance, open_share)
        found.append(f"direction is right, and counts per metre as far as can be told: to {readable:.1%}")
    return _changed(slider, configured, {"node": drive.node, "direction": direction, "counts_per_metre": counts}, found)


def _node(slider: str, configured: Drive, drive: Drive) -> Changes:
    return {} if drive.node == configured.node else {f"drives.{slider}.node": drive.node}


def _changed(slider: str, configured: Drive, wanted: Mapping[str, int | float], found: Sequence[str]) -> Judged:
    """Say what of a slider's drive should be configured otherwise."""
    different = {key: value for key, value in wanted.items() if value != getattr(configured, key)}
    if not different:
        return Judged("ok", tuple(found))
    told = (f"drives.{slider}.{key} = {value:g}, not {getattr(configured, key):g}" for key, value in different.items())
    remedy = f"in the configuration {', '.join(told)}; then begin again with it"
    return Judged("wrong", tuple(found), remedy, {f"drives.{slider}.{key}": value for key, value in different.items()})


def _of(drives: Drives, name: str) -> Drive:
    return drives.each[NAMES.index(name)]


def _rounded(counts: float, open_share: float) -> float:
    """Leave out digits that the rule does not tell, but one."""
    digits = 2
    while 10.0**-digits > open_share / 10.0 and digits < 8:
        digits += 1
    return float(f"{counts:.{digits}g}")
