"""From what was measured to a verdict in words, the remedy, and what the configuration should say: pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from trirail_drivers.config import Drive, Drives
from trirail_drivers.interface import NAMES

Verdict = Literal["ok", "wrong", "failed", "skipped"]
"""As it should be; a defect was found; the step could not be carried out; it was left out."""
Changes = Mapping[str, int | float]
"""Keys of a configuration, by their whole path as `drives.A.node`, and what they should have."""

SCALE: Final = 0.02
"""Share of a way by which drive and rule may differ where the rule could be read better than that."""
COARSE: Final = 0.5
"""Share of a way that a rule leaves open beyond which it tells nothing of the scale."""
PLAY: Final = 0.1
"""Share of a way that a slider may come back short by: play in its screw or belt."""
FOLLOWS: Final = 0.2
"""Share of a way that an encoder has to count for it to have moved at all."""
NOTHING: Final = 0.02
"""Share of a way by hand that an encoder has to count for it to be on that slider, however wrong its scale."""
AGAINST: Final = 0.05
"""Share of a way that an encoder has to count backwards for it to count against its motor."""

LOOSE: Final = "fasten the encoder of drive {} on its shaft, and look at its cable; no power before that"


class Judged(NamedTuple):
    """What is to be thought of a step."""

    verdict: Verdict
    words: tuple[str, ...]
    remedy: str = ""
    changes: Changes = MappingProxyType({})


class MoveSeen(NamedTuple):
    """One drive alone was to move its slider there and back. Ways are signed [m]."""

    drive: str
    asked: float
    out: float
    """By its encoder."""
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


class PushSeen(NamedTuple):
    """A slider was pushed by hand, nothing had power. Ways are signed [m]."""

    slider: str
    rule: float
    ways: tuple[float, float, float]
    """By the encoders of drives A, B, C."""
    read_to: float
    step: float


def judge_move(seen: MoveSeen, drives: Drives) -> Judged:
    """Judge which slider moved, which way, how far, and whether its encoder goes with it."""
    name, slider = seen.drive, seen.slider
    by_encoder = (
        f"drive {name} counted {_mm(seen.out)} of {_mm(seen.asked)}, following error {seen.following * 1e3:.3f} mm"
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
    by_rule = f"slider {slider} moved {_mm(seen.rule_out)} by the rule"
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
    if abs(seen.rule_back) > max(2.0 * seen.read_to, PLAY * abs(seen.rule_out)):
        return Judged(
            "wrong",
            (
                by_encoder,
                by_rule,
                f"back where drive {name} began by its own counts, the rule shows {_mm(seen.rule_back)}",
                "slipping encoder or coupling: counts are lost on the way, or there is as much play",
            ),
            f"fasten encoder and coupling of drive {name} on their shafts, look for play, then repeat this step",
        )
    return _coupled(name, slider, seen.out, seen.rule_out, seen.read_to, seen.step, drives, (by_encoder, by_rule))


def judge_push(seen: PushSeen, drives: Drives) -> Judged:
    """Judge which drive's encoder is on the slider that was pushed, which way and how finely it counts."""
    at = NAMES.index(seen.slider)
    sizes = [abs(way) for way in seen.ways]
    most = sizes.index(max(sizes))
    counted = ", ".join(f"{name} {_mm(way)}" for name, way in zip(NAMES, seen.ways, strict=True))
    words = (f"slider {seen.slider} was pushed {_mm(seen.rule)} by the rule; the drives counted {counted}",)
    if abs(seen.rule) < 5.0 * seen.read_to:
        return Judged(
            "failed", (*words, "that is too little to be judged"), "push it further: 10 mm, or as far as it goes"
        )
    if max(sizes) < NOTHING * abs(seen.rule):
        return Judged(
            "wrong",
            (*words, "loose encoder: the slider moves and no encoder counts it"),
            LOOSE.format(seen.slider),
        )
    drive = seen.slider if sizes[at] >= FOLLOWS * sizes[most] else NAMES[most]
    way = seen.ways[NAMES.index(drive)]
    return _coupled(drive, seen.slider, way, seen.rule, seen.read_to, seen.step, drives, words)


def _coupled(
    name: str,
    slider: str,
    way: float,
    rule: float,
    read_to: float,
    step: float,
    drives: Drives,
    words: tuple[str, ...],
) -> Judged:
    """Judge a drive, whose encoder has counted a `way`, by the slider that went with it, and the rule beside that."""
    drive, configured = _of(drives, name), _of(drives, slider)
    found = [*words]
    if slider != name:
        found.append(f"swapped nodes: drive {name}, node {drive.node}, has slider {slider}")
    if abs(rule) <= 2.0 * read_to:
        found.append(f"the rule, read to {read_to * 1e3:g} mm, shows neither direction nor scale")
        if slider == name:
            return Judged("failed", tuple(found), "read it more finely, or push the slider further")
        return _changed(slider, configured, {"node": drive.node}, found)
    direction, counts = drive.direction, drive.counts_per_metre
    if way * rule < 0.0:
        direction = -drive.direction
        found.append(f"wrong direction: by the counts of drive {name} slider {slider} goes the other way")
    unread = 2.0 * (read_to + step) / abs(rule)
    ratio = abs(way / rule)
    if unread > COARSE:
        found.append(
            f"a rule read to {read_to * 1e3:g} mm does not tell the scale over so short a way; push it further"
        )
    elif abs(ratio - 1.0) > max(SCALE, unread):
        counts = _rounded(drive.counts_per_metre * ratio, unread)
        found.append(
            f"wrong scale: drive {name} counts {ratio:.3g} times as far as the slider goes, read to {unread:.1%}"
        )
    elif slider == name and direction == drive.direction:
        found.append(f"direction is right, and counts per metre as far as can be read: to {unread:.1%}")
    return _changed(slider, configured, {"node": drive.node, "direction": direction, "counts_per_metre": counts}, found)


def _changed(slider: str, configured: Drive, wanted: Mapping[str, int | float], found: Sequence[str]) -> Judged:
    """Say what of a slider's drive should be configured otherwise."""
    different = {key: value for key, value in wanted.items() if value != getattr(configured, key)}
    if not different:
        return Judged("ok", tuple(found))
    told = (f"drives.{slider}.{key} = {value:g}, not {getattr(configured, key):g}" for key, value in different.items())
    remedy = f"in the configuration {', '.join(told)}; then begin again with it"
    return Judged("wrong", tuple(found), remedy, {f"drives.{slider}.{key}": value for key, value in different.items()})


def judge_power(drive: str, drift: float, seconds: float, stopped: str) -> Judged:
    """Judge a drive that had power alone, held its slider for so long [s], and drifted [m]."""
    if stopped:
        return Judged(
            "failed",
            (stopped,),
            f"look at drive {drive}: supply, safe torque off, brake, tuning; then repeat this step",
        )
    return Judged(
        "ok", (f"drive {drive} held for {seconds:g} s, within {drift * 1e3:.4f} mm; the others had no power",)
    )


def judge_homing(drive: str, way: float, position: float, seen: bool, stopped: str) -> Judged:
    """Judge a drive that has found home: how far it went [m], where it says that it is [m], whether that was seen."""
    if stopped:
        return Judged(
            "failed",
            (stopped,),
            f"look at slider {drive}'s home switch, its wiring, and drives.{drive}.homing: method, speeds, timeout",
        )
    words = (f"drive {drive} says that it is home; slider {drive} went {_mm(way)} and is at {_mm(position)} now",)
    if seen:
        return Judged("ok", words)
    return Judged(
        "wrong",
        (*words, "and it was seen not to be there"),
        f"drives.{drive}.homing.method is for another switch or side: its directions are those of the drive's counts",
    )


def judge_watchdog(drive: str, seconds: float | None, by: str, said: str, heartbeat: float) -> Judged:
    """Judge what a powered drive did that heard neither SYNC nor heartbeat, which is for 3 `heartbeat` [s] at most."""
    if seconds is not None:
        words = (f"drive {drive} let go {seconds * 1e3:.0f} ms after the last SYNC: {said}",)
        if seconds < 2.5 * heartbeat:
            return Judged("ok", words)
        return Judged("ok", (*words, "that was its watch on heartbeats: it has none on SYNC, or a slower one"))
    if by and by != drive:
        return Judged("failed", (f"another drive spoke first: {said}",), "repeat this step")
    return Judged(
        "wrong",
        (f"drive {drive} kept its power without SYNC and heartbeat: {said or 'it said nothing'}",),
        f"do not use drive {drive} like that: it would go on if this computer died. See which of 1006h, 1016h, "
        "1029h and 6007h it has (trirail drives), or its own watchdog",
    )


def judge_square(deviation: float, following: Sequence[float], seen: bool, stopped: str) -> Judged:
    """Judge a square of the platform: how far the measured pose was from the commanded one [m], and what was seen."""
    if stopped:
        return Judged("failed", (stopped,), "repeat the step of the slider that is named")
    errors = ", ".join(f"{name} {error * 1e3:.3f}" for name, error in zip(NAMES, following, strict=True))
    words = (f"the platform stayed within {deviation * 1e3:.3f} mm of its square; following errors {errors} mm",)
    if seen:
        return Judged("ok", words)
    return Judged(
        "wrong",
        (*words, "the sliders did as they were told, and the platform did not go along x, along y, and back"),
        "compare [geometry] with the robot: which rail is A, B, C, which way its slider counts, l0 or the three legs",
    )


def merged(found: Sequence[Changes], drives: Drives) -> tuple[dict[str, int | float], str]:
    """Put together what the steps would change; why the nodes cannot be exchanged, "" where they can.

    A node that moves to another slider leaves its own without one: the two are exchanged where nothing else was seen.
    """
    changes = {key: value for each in found for key, value in each.items()}
    nodes = {name: _of(drives, name).node for name in NAMES}
    moved = {name: int(changes[f"drives.{name}.node"]) for name in NAMES if f"drives.{name}.node" in changes}
    after = {**nodes, **moved}
    left = [node for node in nodes.values() if node not in after.values()]
    for name in NAMES:
        doubled = name not in moved and after[name] in moved.values()
        if doubled and left:
            after[name] = left.pop(0)
    if len(set(after.values())) < len(NAMES):
        kept = {key: value for key, value in changes.items() if not key.endswith(".node")}
        return kept, "two drives were seen to move one slider: look at the cables, and repeat those steps"
    for name, node in after.items():
        changes.pop(f"drives.{name}.node", None)
        if node != nodes[name]:
            changes[f"drives.{name}.node"] = node
    return dict(sorted(changes.items())), ""


def _of(drives: Drives, name: str) -> Drive:
    return drives.each[NAMES.index(name)]


def _mm(way: float) -> str:
    return f"{way * 1e3 + 0.0:+.3f} mm"


def _rounded(counts: float, open_share: float) -> float:
    """Leave out digits that the rule does not tell, but one."""
    digits = 2
    while 10.0**-digits > open_share / 10.0 and digits < 8:
        digits += 1
    return float(f"{counts:.{digits}g}")
