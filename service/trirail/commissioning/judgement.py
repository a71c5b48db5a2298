"""From what was measured of a step to a verdict in words and the remedy: pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from trirail_drivers.interface import NAMES

from trirail.naming import Labels, label

Verdict = Literal["ok", "wrong", "failed", "skipped"]
"""As it should be; a defect was found; the step could not be carried out; it was left out."""
Changes = Mapping[str, int | float]
"""Keys of a configuration, by their whole path as `drives.A.node`, and what they should have."""


SWITCHES: Final = {1: "negative limit switch", 2: "positive limit switch", 4: "home switch"}
"""Bits of the digital inputs 60FDh (CiA 402-2)."""
LIMITS: Final = (1, 2)
HEARTBEAT_MISSING: Final = 0x8130
"""What the EMCY of a drive says that does not hear its master (CiA 301, emergency error codes)."""


class Judged(NamedTuple):
    """What is to be thought of a step."""

    verdict: Verdict
    words: tuple[str, ...]
    remedy: str = ""
    changes: Changes = MappingProxyType({})


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


def judge_switches(name: str, rest: int, changed: int, seen: bool, labels: Labels = NAMES) -> Judged:
    """Judge a slider's switches: bits of 60FDh at rest and those that changed; whether these are all that there are."""
    told = [f"{switch} {'changed' if changed & bit else 'never changed'}" for bit, switch in SWITCHES.items()]
    words = (f"drive {name} told: {', '.join(told)}",)
    pressed = [switch for bit, switch in SWITCHES.items() if rest & bit and bit in LIMITS]
    if pressed:
        return Judged(
            "wrong",
            (*words, f"at rest it takes its {' and its '.join(pressed)} for pressed"),
            f"if slider {label(name, labels)} does not stand on it: turn the input's polarity in the drive (a normally "
            "closed contact?), or look for a broken wire",
        )
    if not seen:
        return Judged(
            "wrong",
            (*words, f"slider {label(name, labels)} has other switches than these"),
            f"look at their wiring, and at which input drive {name} takes for which (its maker's tool)",
        )
    return Judged("ok", words)


def judge_homing(drive: str, way: float, position: float, seen: bool, stopped: str, labels: Labels = NAMES) -> Judged:
    """Judge a drive that has found home: how far it went [m], where it says that it is [m], whether that was seen."""
    slider = f"slider {label(drive, labels)}"
    if stopped:
        return Judged(
            "failed",
            (stopped,),
            f"look at {slider}'s home switch, its wiring, and drives.{drive}.homing: method, speeds, timeout",
        )
    words = (f"drive {drive} says that it is home; {slider} went {in_mm(way)} and is at {in_mm(position)} now",)
    if seen:
        return Judged("ok", words)
    return Judged(
        "wrong",
        (*words, "and it was seen not to be there"),
        f"drives.{drive}.homing.method is for another switch or side: its directions are those of the drive's counts",
    )


def judge_watchdog(drive: str, seconds: float | None, by: str, said: str, code: int) -> Judged:
    """Judge what a powered drive did that heard neither SYNC nor heartbeat, `code` is that of its EMCY."""
    if seconds is not None:
        words = (f"drive {drive} let go {seconds * 1e3:.0f} ms after the last SYNC: {said}",)
        if code == HEARTBEAT_MISSING:
            return Judged("ok", (*words, "that was its watch on heartbeats: it has none on SYNC, or a slower one"))
        return Judged("ok", words)
    if by and by != drive:
        return Judged("failed", (f"another drive spoke first: {said}",), "repeat this step")
    return Judged(
        "wrong",
        (f"drive {drive} kept its power without SYNC and heartbeat: {said or 'it said nothing'}",),
        f"do not use drive {drive} like that: it would go on if this computer died. See which of 1006h, 1016h, "
        "1029h and 6007h it has (trirail drives), or its own watchdog",
    )


def judge_square(
    deviation: float, following: Sequence[float], seen: bool, stopped: str, labels: Labels = NAMES
) -> Judged:
    """Judge a square of the platform: how far the measured pose was from the commanded one [m], and what was seen."""
    if stopped:
        return Judged("failed", (stopped,), "repeat the step of the slider that is named")
    errors = ", ".join(f"{name} {error * 1e3:.3f}" for name, error in zip(labels, following, strict=True))
    words = (f"the platform stayed within {deviation * 1e3:.3f} mm of its square; following errors {errors} mm",)
    if seen:
        return Judged("ok", words)
    return Judged(
        "wrong",
        (*words, "the sliders did as they were told, and the platform did not go along x, along y, and back"),
        "compare [geometry] with the robot: "
        f"which rail is {', '.join(labels)}, which way its slider counts, l0 or the three legs",
    )


def in_mm(way: float) -> str:
    """Say a signed length [m] in millimetres."""
    return f"{way * 1e3 + 0.0:+.3f} mm"
