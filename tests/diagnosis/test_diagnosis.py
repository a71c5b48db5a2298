"""What a configuration is likely to mean otherwise: every number of every shipped file is spoilt."""

from __future__ import annotations

import copy
import math
import random
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomlkit
from control_rig import ControlRig
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trirail.cli import rail_drawing
from trirail.config import SIM, Config, everything, load, overlap
from trirail.config.explained import Place, leaves, repaired
from trirail.config.impossible import rules
from trirail.diagnosis import Check, diagnose, failed_checks, stops
from trirail.diagnosis.configured import CONFIG_CHECKS
from trirail.diagnosis.stopping import each_stops
from trirail.errors import TrirailError
from trirail.wire.goals import Goal, PoseGoal, SlidersGoal
from trirail.wire.packets import Accepted
from trirail.wire.vocabulary import Mode
from trirail_drivers.errors import MAX_MESSAGE_LENGTH

FILES = sorted(SIM.parent.rglob("*.toml"))
FACTORS = (1000, 0.001, -1)
HARMLESS = {
    # A cross slide square to its rail lies so either way; a better servo; a file of a recording that its size ends
    # first; more than disks hold is for the disk to say; which way a drive counts is seen on the robot alone.
    ("geometry.leg[0].edge_angle", -1),
    ("geometry.leg[1].edge_angle", -1),
    ("can.simulated.time_constant", 0.001),
    ("telemetry.rotate_minutes", 1000),
    ("telemetry.keep_mb", 1000),
    ("drives.A.direction", -1),
}
WITHIN = {(f"{name}.toml", "can.simulated.feed_forward_gain", 0.001) for name in ("vcan", "uvw", "xxy", "uvw-ppr")}
"""Their windows take the whole lag."""


def key_of(place: Place) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")


def spoilt(raw: dict[str, Any], place: Place, value: object) -> dict[str, Any]:
    tables = copy.deepcopy(raw)
    table: Any = tables
    for part in place[:-1]:
        table = table[part]
    table[place[-1]] = value
    return tables


def spoilt_text(document: tomlkit.TOMLDocument, place: Place, value: object) -> str:
    """Return the text of a file with another value at a place; the document stays as it is."""
    table: Any = document
    for part in place[:-1]:
        table = table[part]
    before, table[place[-1]] = table[place[-1]], value
    text = tomlkit.dumps(document)
    table[place[-1]] = before
    return text


def times(value: float, factor: float) -> float:
    """A number as people would write it: a whole one stays one."""
    product = value * factor
    return int(product) if isinstance(value, int) and float(product).is_integer() else product


def told_of(path: Path) -> list[Check]:
    """Each mistake of a file, and each check of it that can do without what is impossible."""
    found = everything(path)
    return failed_checks(path, found.mistakes) + diagnose(found.config, [mistake.key for mistake in found.mistakes])


def wrong(path: Path) -> list[Check]:
    """All that is told of a file, but what it lets drives lack on purpose."""
    return [check for check in told_of(path) if check.verdict != "ok" and not check.name.startswith("lacking")]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_nothing_false_is_said_of_what_is_shipped(path: Path) -> None:
    assert wrong(path) == []


@pytest.mark.long
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_number_that_is_spoilt_is_told(path: Path, tmp_path: Path) -> None:
    document = tomlkit.parse(path.read_text())
    file = tmp_path / path.name
    silent = []
    for place, value in leaves(document.unwrap()):
        if isinstance(value, bool) or not isinstance(value, int | float) or not value:
            continue
        for factor in FACTORS:
            key = key_of(place)
            file.write_text(spoilt_text(document, place, times(value, factor)))
            if not wrong(file) and (key, factor) not in HARMLESS and (path.name, key, factor) not in WITHIN:
                silent.append(f"{key} * {factor}")
    assert silent == []


PLANTED: dict[str, tuple[str, str, str]] = {
    # What is planted: what stood there, what stands there now, and what tells it.
    "beyond the rail": ("quick_stop_deceleration = 2.0 ", "quick_stop_deceleration = 0.15 ", "rail"),
    "a controlled stop beyond the rail": ("acceleration = 1.5\n", "acceleration = 0.1\n", "rail"),
    "never as fast": ("acceleration = 1.5\n", "acceleration = 0.02\n", "travel"),
    "power cut in motion": ("quick_stop_deceleration = 2.0 ", "quick_stop_deceleration = 0.05 ", "quick stop"),
    "offset in millimetres": ("offset = 0.0 ", "offset = 20.0 ", "offset"),
    "an EDS that is not there": ("[drives.B]\n", '[drives.B]\neds = "nowhere.eds"\n', "configuration"),
    "a map that is not there": ("[drives]\n", '[correction]\nmap = "nowhere.toml"\n[drives]\n', "configuration"),
    "too short to power up": ("enable_timeout = 5.0", "enable_timeout = 0.01", "times"),
    "an hour to power up": ("enable_timeout = 5.0", "enable_timeout = 600.0", "times"),
    "blind": ("heartbeat = 0.1 ", "missed_positions = 1000\nheartbeat = 0.1 ", "times"),
    "a drive of its own kind": (
        "[drives.B]\nnode = 2\ncounts_per_metre = 1e6", "[drives.B]\nnode = 2\ncounts_per_metre = 1e9", "drives alike",
    ),
    "millimetres a second": ("velocity = 0.1\n", "velocity = 100.0\n", "limits"),
    "unknown": ("[loop]\n", "[loop]\nrate = 1000\n", "configuration"),
    "reversed": ("x = [-0.1, 0.1] ", "x = [0.1, -0.1] ", "configuration"),
    "no such role": ("[telemetry]\n", '[zenoh.users]\nme = "boss"\n[telemetry]\n', "configuration"),
}  # fmt: skip
REAL = (SIM.parent / "socketcan.toml").read_text()
SOME = list(PLANTED)


def planted(names: list[str]) -> str:
    text = REAL
    for name in names:
        was, now, _ = PLANTED[name]
        assert was in text, name
        text = text.replace(was, now, 1)
    return text


@pytest.mark.parametrize("name", SOME)
def test_each_planted_mistake_is_told_with_its_key(name: str, tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text(planted([name]))
    found = wrong(tmp_path / "robot.toml")
    assert PLANTED[name][2] in {check.name for check in found}
    assert all(check.key for check in found)
    assert all("robot.toml" in check.found for check in found if check.name == "configuration")


def test_what_is_told_of_nonsense_is_short(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(REAL.replace("rate_hz", "k" * 100_000).replace("l0 = 0.3", f"l0 = {'1' * 400}"))
    found = wrong(file)
    assert {check.key.partition(".")[0] for check in found} >= {"loop", "geometry"}
    assert all(len(check.found) <= MAX_MESSAGE_LENGTH and len(check.key) <= MAX_MESSAGE_LENGTH for check in found)


NOT_TOGETHER = (
    {
        "beyond the rail",
        "power cut in motion",
        "millimetres a second",
        "a controlled stop beyond the rail",
        "never as fast",
    },
    {"too short to power up", "an hour to power up"},
)


@settings(max_examples=25)
@example(names={"unknown", "reversed", "no such role", "an EDS that is not there", "offset in millimetres", "blind"})
@given(names=st.sets(st.sampled_from(SOME), min_size=2))
def test_none_hides_another(names: set[str], tmp_path_factory: pytest.TempPathFactory) -> None:
    """What is told of each alone is told of all together, but of what depends on one that is impossible."""
    for group in NOT_TOGETHER:
        names -= set(sorted(group & names)[1:])
    folder = tmp_path_factory.mktemp("planted")
    file = folder / "robot.toml"

    def found_of(of: list[str]) -> set[tuple[str, str]]:
        file.write_text(planted(of))
        return {(check.key, check.found) for check in wrong(file)}

    together = found_of(sorted(names))
    impossible = [key for key, found in together if "robot.toml: " in found]
    for name in sorted(names):
        for key, found in found_of([name]):
            depends = "robot.toml: " not in found and any(
                overlap((key,), each.reads) and overlap(each.reads, impossible) for each in CONFIG_CHECKS
            )
            assert depends or (key, found) in together, name


def numbers(raw: dict[str, Any]) -> list[tuple[Place, float]]:
    found = leaves(raw)
    return [(place, v) for place, v in found if isinstance(v, int | float) and not isinstance(v, bool)]


RAW = {path.name: tomllib.loads(path.read_text()) for path in FILES}


@settings(max_examples=150)
@given(data=st.data(), name=st.sampled_from(sorted(RAW)), factor=st.sampled_from([1.01, 2, 0.5, 3, -1, 100, 0.01]))
def test_every_check_names_what_it_reads(data: st.DataObject, name: str, factor: float) -> None:
    """What stands at a key that a check does not name changes nothing of what it finds."""
    place, value = data.draw(st.sampled_from(numbers(RAW[name])))
    changed, mistakes = repaired(spoilt(RAW[name], place, times(value, factor)))
    if mistakes:
        return
    base, key = load(SIM.parent / ("" if (SIM.parent / name).exists() else "drives") / name), key_of(place)
    for check in CONFIG_CHECKS:
        if not overlap(check.reads, [key]):
            assert list(check.run(base)) == list(check.run(changed)), check

    def refused(config: Config) -> list[tuple[str, str]]:
        return [(rule.key, said(rule.check)) for rule in rules(config) if not overlap((rule.key, *rule.reads), [key])]

    assert refused(base) == refused(changed)


def said(check: Callable[[], object]) -> str:
    try:
        check()
    except TrirailError as error:
        return str(error)
    return ""


JUNK = st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
                 st.just([]), st.just({}), st.just([1, "x", 2.0]), st.just({"a": {"b": 1}}))  # fmt: skip


@settings(max_examples=100)
@given(data=st.data(), name=st.sampled_from(sorted(RAW)))
def test_whatever_stands_in_a_file_all_of_it_is_told(data: st.DataObject, name: str) -> None:
    """Of several keys with anything in them each that is refused alone is refused together; nothing raises."""
    places = [place for place, _ in leaves(RAW[name])]
    chosen = data.draw(st.lists(st.sampled_from(places), min_size=1, max_size=5, unique_by=lambda place: place[0]))
    together, alone = RAW[name], []
    for place in chosen:
        junk = data.draw(JUNK)
        if junk is None:
            continue
        together = spoilt(together, place, junk)
        alone += repaired(spoilt(RAW[name], place, junk))[1]
    found = repaired(together)[1]
    assert {each.key for each in alone} == {each.key for each in found}
    assert {each.text for each in alone} == {each.text for each in found}


@pytest.mark.parametrize("leg", range(3))
@pytest.mark.parametrize("name", ["uvw.toml", "uvw-ppr.toml"])
def test_of_three_limits_the_one_that_is_wrong_is_named(name: str, leg: int) -> None:
    config = load(SIM.with_name(name))
    slider, label = config.limits.slider, "UVW"[leg]

    def found(**own: object) -> list[tuple[str, str]]:
        three = {
            key: tuple(value if k == leg else getattr(slider, key) for k in range(3)) for key, value in own.items()
        }
        limits = msgspec.structs.replace(config.limits, slider=msgspec.structs.replace(slider, **three))
        checks = diagnose(msgspec.structs.replace(config, limits=limits))
        return [(each.key, each.found) for each in checks if each.name == "limits" and each.verdict == "warning"]

    assert found() == []
    for quantity, factor in (("velocity", 1e-3), ("acceleration", 1e3), ("jerk", 1e-3)):
        warnings = found(**{quantity: getattr(slider, quantity) * factor})
        assert f"limits.slider.{quantity}[{leg}]" in {key for key, _ in warnings}
        assert any(said.startswith(f"limits.slider {label}: ") for _, said in warnings)
    ((key, said),) = found(position=(-0.01, 10.0))
    assert (key, said.partition(":")[0]) == (f"limits.slider.position[{leg}]", f"{key} = [-0.01, 10]")


FAST = {"position": (-0.1, 0.3), "velocity": 0.9, "acceleration": 100.0, "jerk": 1e5}


@pytest.mark.parametrize("leg", range(3))
@pytest.mark.parametrize(
    ("spoilt", "name", "verdict"),
    [
        ({"position": (-0.1, 0.4)}, "rail", "failure"),
        (FAST, "rail", "warning"),
        (FAST, "quick stop", "failure"),
    ],
)
def test_stops_of_every_slider_are_checked(leg: int, spoilt: dict[str, Any], name: str, verdict: str) -> None:
    """Whichever slider needs the largest part of its travel for a stop."""
    config = load(SIM.with_name("vcan.toml"))
    config = msgspec.structs.replace(config, can=msgspec.structs.replace(config.can, channel="can0"))
    slow = {"position": (-0.001, 0.001), "velocity": 0.01, "acceleration": 0.1, "jerk": 100.0}
    three = {
        key: tuple((spoilt.get(key, value), value, value)[k - leg] for k in range(3)) for key, value in slow.items()
    }
    slider = msgspec.structs.replace(config.limits.slider, **three)
    drives = msgspec.structs.replace(config.drives, quick_stop_deceleration=1.0, stop_timeout=0.5)
    config = msgspec.structs.replace(
        config, limits=msgspec.structs.replace(config.limits, slider=slider), drives=drives
    )
    assert (name, verdict) in {(each.name, each.verdict) for each in diagnose(config)}


def test_a_zero_is_compared_with_the_travel_of_its_own_slider() -> None:
    """Measured legs do not tell where rails end."""
    config = load(SIM.with_name("uvw.toml"))
    slider, first = config.limits.slider, config.drives.A
    assert config.geometry.l0 is None
    three = ((0.5, 0.6), slider.positions[1], slider.positions[2])
    limits = msgspec.structs.replace(config.limits, slider=msgspec.structs.replace(slider, position=three))

    def found(offset: float) -> set[str]:
        drives = msgspec.structs.replace(config.drives, A=msgspec.structs.replace(first, offset=offset))
        checks = diagnose(msgspec.structs.replace(config, limits=limits, drives=drives))
        return {each.key for each in checks if each.name == "offset"}

    assert found(0.55) == set()
    assert found(0.0) == {"drives.A.offset"}


@pytest.mark.generated(*range(16))
def test_a_stop_of_the_control_is_no_longer_than_stated(seed: int) -> None:
    """At constant velocity on a line, by any limits, and at any override."""
    chance = random.Random(seed)
    config = load(SIM.with_name(chance.choice(("sim.toml", "socketcan.toml", "uvw.toml", "xxy.toml"))))

    def spread(limits: Sequence[float], share: float = 1.0) -> tuple[float, ...]:
        return tuple(share * limit * math.exp(chance.uniform(-1.2, 1.2)) for limit in limits)

    change = msgspec.structs.replace
    slider, platform = config.limits.slider, config.limits.platform
    slider = change(
        slider,
        velocity=spread(slider.velocities, 0.3),
        acceleration=spread(slider.accelerations),
        jerk=spread(slider.jerks),
    )
    rates = {key: spread(getattr(platform, key)) for key in ("velocity", "acceleration", "jerk")}
    limits = change(config.limits, slider=slider, platform=change(platform, **rates))
    backlash = chance.choice(((0.0, 0.0, 0.0), (2e-6, 1e-6, 3e-6)))
    correction = change(config.correction, backlash=backlash)
    simulated = change(config.can, interface="simulated")
    config = change(config, limits=limits, correction=correction, can=simulated)
    every = each_stops(config)
    rig = ControlRig(config)
    rig.enable()
    for number in range(12):
        rig.command("override", chance.choice((0.5, 1.0, 2.0)))
        x, y, phi = (chance.uniform(*ends) for ends in (platform.x, platform.y, platform.phi))
        a, b, c = (chance.uniform(*ends) for ends in slider.positions)
        goals: tuple[Goal, ...] = PoseGoal(x, y, phi, speed=chance.choice((0.5, 1.0))), SlidersGoal((a, b, c))
        answer = rig.send(f"g{number}", chance.choice(goals), within=40_000)
        if not isinstance(answer, Accepted):
            continue
        while rig.mode is Mode.MOVING and not _is_constant(rig, every[0].time):
            rig.cycle()
        if rig.mode is Mode.MOVING:
            (run,) = rig.control.schedule.runs
            rate = run.law_state.rate
            rig.order("stop")
            while run.law_state.rate == rate:
                rig.cycle()
            begun = len(rig.rows) - 2
            rig.until(rig.holds, 40_000)
            ways = np.abs(np.ptp(rig.setpoints()[begun:, 0], axis=0))
            assert all(way <= stop.way + max(backlash) for way, stop in zip(ways, every, strict=True)), (ways, every)
            assert (len(rig.rows) - begun - 4) * config.period <= every[0].time
        rig.until(rig.holds, 40_000)


def _is_constant(rig: ControlRig, duration: float) -> bool:
    """Return whether the motion under way keeps its velocity for a stop of this duration [s]."""
    runs = rig.control.schedule.runs
    if len(runs) != 1 or runs[0].law_state.change != 0.0:
        return False
    path, (s, rate, _) = runs[0].path, runs[0].law_state
    piece = int(np.searchsorted(path.knots, s, side="right")) - 1
    ends = 0 <= piece < len(path.pieces) and float(path.knots[piece + 1]) - s
    return bool(ends > rate * (duration / 2.0 + 10.0 * rig.config.period) and not path.pieces[piece, :, 2:].any())


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_rail_is_drawn(path: Path) -> None:
    found = stops(load(path))
    lines = rail_drawing.draw_lines(found)
    assert max(map(len, lines)) < 100
    rows = [line.split("  ")[0] for line in lines[:-1]]
    if load(path).geometry.l0 is None:  # measured legs do not tell where rails end
        assert (rows, found.rail) == (["travel", "stop", "quick stop"], None)
        return
    assert rows == ["rail", "travel", "stop", "quick stop"]
    assert found.rail == pytest.approx((-0.1732, 0.3464), abs=1e-4)


@pytest.mark.parametrize("rate", [1, 2, 5, 8, 10, 20, 100, 1000])
@pytest.mark.parametrize("key", ["drives.missed_positions", "watchdogs.max_overruns"])
def test_a_remedy_is_a_value_that_removes_the_warning(rate: int, key: str) -> None:
    section, name = key.split(".")
    change = msgspec.structs.replace
    config = change(load(SIM), loop=change(load(SIM).loop, rate_hz=rate))

    def found(number: int) -> list[Check]:
        tables = change(getattr(config, section), **{name: number})
        return [each for each in diagnose(change(config, **{section: tables})) if each.key == key]

    for check in found(10_000):
        number = re.fullmatch(r"set at most (\d+)|set a higher loop\.rate_hz: .*", check.remedy)
        assert number is not None, check.remedy
        if number[1] is None:
            assert found(1)
        else:
            assert int(number[1]) >= 1
            assert found(int(number[1])) == []
            assert found(int(number[1]) + 1)


def in_position(config: Config, **fields: float) -> Config:
    """Return a configuration with other fields of [limits.in_position]."""
    settling = msgspec.structs.replace(config.limits.in_position, **fields)
    return msgspec.structs.replace(config, limits=msgspec.structs.replace(config.limits, in_position=settling))


@pytest.mark.parametrize("backlash", [0.0, 5e-6, 5e-5])
@pytest.mark.parametrize("rate", [10, 1000])
def test_a_time_out_without_a_warning_lets_goals_be_done(backlash: float, rate: int) -> None:
    """The take-up of a reversal, the dwell and the age of a position fit into it, on perfect drives."""
    change = msgspec.structs.replace
    config = load(SIM)
    slow = change(config.limits.slider, acceleration=0.05, jerk=1.0, velocity=0.05)
    config = change(
        config,
        loop=change(config.loop, rate_hz=rate),
        limits=change(config.limits, slider=slow),
        correction=change(config.correction, backlash=(backlash,) * 3),
    )

    def told(timeout: float) -> list[Check]:
        checks = diagnose(in_position(config, dwell=0.01, timeout=timeout))
        return [each for each in checks if each.key == "limits.in_position.timeout"]

    assert told(10.0) == []
    (check,) = told(0.0101)
    assert "limits.in_position.timeout" in check.found
    assert ("correction.backlash" in check.found) == (backlash > 0.0)
    stated = re.search(r"at least ([\d.]+)", check.remedy)
    assert stated is not None
    assert told(float(stated[1])) == []
    outcomes = []
    for timeout in (float(stated[1]), 0.0101):
        rig = ControlRig(in_position(config, dwell=0.01, timeout=timeout))
        rig.enable()
        for number, x in enumerate((2e-5, 1e-5, 2e-5)):
            assert isinstance(rig.goal(f"g{number}", x, 0.0, 0.0), Accepted)
            rig.until(rig.holds)
        outcomes.append({outcome for _, outcome in rig.outcomes()})
    assert outcomes[0] == {"done"}
    assert backlash == 0.0 or "unsettled" in outcomes[1]
