"""Judgement of a step's measurements, with a verdict, reasons and a remedy. All functions are pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

from trirail_drivers.interface import NAMES

from trirail.naming import Labels, label

Verdict = Literal["ok", "wrong", "failed", "skipped"]
"""Verdict on a step: "ok", "wrong" if it found a defect, "failed" if it could not be carried out, or "skipped"."""
Changes = Mapping[str, int | float]
"""New values of configuration keys, by the full path of each key, as `drives.A.node`."""


SWITCHES: Final = {1: "negative limit switch", 2: "positive limit switch", 4: "home switch"}
"""Names of the switches by their bits in the digital inputs 60FDh (CiA 402-2)."""
LIMIT_BITS: Final = (1, 2)
MAX_HOME_DEVIATION: Final = 0.001
"""Distance from home beyond which the position after homing is pointed out [m]."""
HEARTBEAT_MISSING: Final = 0x8130
"""EMCY error code for a life guard or heartbeat error (CiA 301, emergency error codes)."""


class Judgement(NamedTuple):
    """Verdict on a step, with reasons, a remedy and proposed changes of the configuration."""

    verdict: Verdict
    words: tuple[str, ...]
    remedy: str = ""
    changes: Changes = MappingProxyType({})


def judge_power(drive: str, drift: float, seconds: float, stopped: str) -> Judgement:
    """Judge the power test, in which a single enabled drive held its slider for `seconds` [s].

    `drift` is the maximum following error [m]. `stopped` is the reason why the drives were stopped, or "".
    """
    if stopped:
        return Judgement(
            "failed",
            (stopped,),
            f"check drive {drive}: supply, safe torque off, brake, motor phases, tuning; then repeat this step",
        )
    return Judgement(
        "ok", (f"drive {drive} held for {seconds:g} s, within {drift * 1e3:.4f} mm; the others had no power",)
    )


def judge_switches(name: str, rest: int, changed: int, confirmed: bool, labels: Labels = NAMES) -> Judgement:
    """Judge the test of a slider's switches.

    Parameters
    ----------
    rest
        Bits of 60FDh while no switch is pressed.
    changed
        Bits that changed while the person pressed the switches.
    confirmed
        True if the person confirmed that these are all switches of the slider.
    """
    states = [f"{switch} {'changed' if changed & bit else 'never changed'}" for bit, switch in SWITCHES.items()]
    words = (f"drive {name} reported: {', '.join(states)}",)
    pressed = [switch for bit, switch in SWITCHES.items() if rest & bit and bit in LIMIT_BITS]
    if pressed:
        return Judgement(
            "wrong",
            (*words, f"at rest it reports its {' and its '.join(pressed)} as pressed"),
            f"if slider {label(name, labels)} is not on the switch: invert the input's polarity in the drive (a "
            "normally closed contact?), or look for a broken wire",
        )
    if not confirmed:
        return Judgement(
            "wrong",
            (*words, f"slider {label(name, labels)} has other switches than these"),
            f"check their wiring, and the functions of the inputs of drive {name} (with the manufacturer's tool)",
        )
    return Judgement("ok", words)


def judge_homing(
    drive: str,
    travel: float | None,
    position: float,
    offset: float,
    confirmed: bool,
    stopped: str,
    labels: Labels = NAMES,
) -> Judgement:
    """Judge a homing that ended at `position` [m] after `travel` [m], which is None if nothing measured it.

    `offset` is the configured position of home [m]. `confirmed` is True if the person confirmed that the slider is at
    its home switch. `stopped` is the reason why the drives were stopped, or "".
    """
    slider = f"slider {label(drive, labels)}"
    if stopped:
        return Judgement(
            "failed",
            (stopped,),
            f"check {slider}'s home switch, its wiring, and drives.{drive}.homing: method, speeds, timeout",
        )
    moved = "" if travel is None else f"moved {format_mm(travel)} and "
    words: tuple[str, ...] = (f"drive {drive} reports home; {slider} {moved}is at {format_mm(position)}",)
    if abs(position - offset) > MAX_HOME_DEVIATION:
        words = (
            *words,
            f"but drives.{drive}.offset is {format_mm(offset)}: check home, unless it stopped beyond its switch",
        )
    if confirmed:
        return Judgement("ok", words)
    return Judgement(
        "wrong",
        (*words, "but the slider is not at its home switch"),
        f"drives.{drive}.homing.method is for another switch or side: its directions are those of the drive's counts",
    )


def judge_watchdog(drive: str, seconds: float | None, message: str, code: int) -> Judgement:
    """Judge the reaction of a powered drive to missing SYNCs and heartbeats.

    The other parameters are the fields of trirail.commissioning.bench.WatchdogReaction.
    """
    if seconds is not None:
        words = (f"drive {drive} switched its power off {seconds * 1e3:.0f} ms after the last SYNC: {message}",)
        if code == HEARTBEAT_MISSING:
            return Judgement(
                "ok", (*words, "by monitoring heartbeats: it does not monitor SYNC, or does so more slowly")
            )
        return Judgement("ok", words)
    return Judgement(
        "wrong",
        (f"drive {drive} kept its power without SYNC and heartbeat: {message}",),
        f"do not use drive {drive} in this state: it would keep moving if this computer died. Check which of 1006h, "
        "1016h, 1029h and 6007h it has (trirail drives), or enable its own watchdog",
    )


def judge_square(
    deviation: float, following: Sequence[float], confirmed: bool, stopped: str, labels: Labels = NAMES
) -> Judgement:
    """Judge the motion of the platform around a square.

    Parameters
    ----------
    deviation
        Maximum distance of the measured positions of the platform from the square [m].
    following
        Maximum following error of each slider [m].
    confirmed
        True if the person saw the platform move around the square.
    stopped
        Reason why the drives were stopped; "" if they were not stopped.
    """
    if stopped:
        return Judgement("failed", (stopped,), "repeat the steps of the slider that is named")
    errors = ", ".join(f"{name} {error * 1e3:.3f}" for name, error in zip(labels, following, strict=True))
    words = (f"the platform stayed within {deviation * 1e3:.3f} mm of its square; following errors {errors} mm",)
    if confirmed:
        return Judgement("ok", words)
    return Judgement(
        "wrong",
        (*words, "the sliders followed their setpoints, but the platform did not move along x, along y, and back"),
        "compare [geometry] with the robot: "
        f"which rail is {', '.join(labels)}, which way its slider counts, l0 or the three legs",
    )


def format_mm(length: float) -> str:
    """Return a signed length [m] in millimetres."""
    return f"{length * 1e3 + 0.0:+.3f} mm"
