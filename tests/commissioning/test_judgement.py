"""Verdicts, for ways and rules of any size: what is right passes, each defect is named, and its cure is right."""

from __future__ import annotations

import itertools

import msgspec
import pytest
from control_rig import CONFIG
from hypothesis import assume, example, given
from hypothesis import strategies as st
from trirail.commissioning.coupling import (
    MAX_RULE_UNCERTAINTY,
    SCALE_TOLERANCE,
    MoveObservation,
    PushObservation,
    judge_move,
    judge_push,
)
from trirail.commissioning.guide import merge_changes
from trirail.commissioning.judgement import Judgement, judge_homing, judge_square, judge_switches, judge_watchdog
from trirail.commissioning.moves import TEST_DISTANCE_M
from trirail.commissioning.report import CommissioningReport, format_lines
from trirail_drivers.config import Drives
from trirail_drivers.interface import NAMES

sliders = st.sampled_from(NAMES)
signs = st.sampled_from((1.0, -1.0))
ways = st.floats(0.002, 0.1)


def drives(direction: int = 1, counts: float = 1e6) -> Drives:
    found = CONFIG.drives
    for name in NAMES:
        drive = msgspec.structs.replace(getattr(found, name), direction=direction, counts_per_metre=counts)
        found = msgspec.structs.replace(found, **{name: drive})
    return found


def moved(name: str = "A", **keys: object) -> MoveObservation:
    usual = MoveObservation(
        name, TEST_DISTANCE_M, TEST_DISTANCE_M, -TEST_DISTANCE_M, 1e-5, "", name, TEST_DISTANCE_M, 0.0, 1e-5, 1e-7
    )
    seen = usual._replace(**keys)  # type: ignore[arg-type]
    return seen if "back" in keys else seen._replace(back=-seen.out)


def said(judged: Judgement) -> str:
    return " ".join(judged.words)


@example(name="A", sign=-1.0, share=0.75, read_to=0.00017498, direction=1)  # play was named that the rule does not show
@given(
    name=sliders,
    sign=signs,
    share=st.floats(-0.9, 0.9),
    read_to=st.floats(1e-6, 2e-4),
    direction=st.sampled_from((1, -1)),
)
def test_what_a_rule_cannot_tell_apart_is_right(
    name: str, sign: float, share: float, read_to: float, direction: int
) -> None:
    asked = sign * TEST_DISTANCE_M
    rule = asked + share * 1.9 * read_to
    assume(abs(rule) > 2.0 * read_to)
    seen = moved(name, commanded=asked, out=asked, rule_out=rule, rule_back=share * read_to, rule_resolution=read_to)
    judged = judge_move(seen, drives(direction))
    assert (judged.verdict, judged.changes, judged.remedy) == ("ok", {}, "")


@given(
    slider=sliders,
    drive=sliders,
    rule=ways,
    sign=signs,
    ratio=st.floats(0.05, 20.0),
    turned=signs,
    direction=st.sampled_from((1, -1)),
)
def test_the_configuration_that_comes_of_it_measures_what_the_rule_reads(
    slider: str, drive: str, rule: float, sign: float, ratio: float, turned: float, direction: int
) -> None:
    """Whatever is swapped, turned and scaled: with the changes the same counts are the rule's way."""
    before = drives(direction)
    way = turned * ratio * sign * rule
    counted = [0.0, 0.0, 0.0]
    counted[NAMES.index(drive)] = way
    a, b, c = counted
    judged = judge_push(PushObservation(slider, sign * rule, (a, b, c), -sign * rule, (-a, -b, -c), 1e-5, 1e-6), before)
    after = getattr(before, slider)
    for key, value in judged.changes.items():
        _, name, field = key.split(".")
        assert name == slider
        after = msgspec.structs.replace(after, **{field: value})
    old = getattr(before, drive)
    counts = way * old.direction * old.counts_per_metre
    measured = counts / (after.direction * after.counts_per_metre)
    assert measured == pytest.approx(sign * rule, rel=max(SCALE_TOLERANCE, 2.0 * 1.1e-5 / rule) * 1.1)
    assert after.node == old.node
    right = drive == slider and turned > 0 and abs(ratio - 1.0) <= SCALE_TOLERANCE
    assert judged.verdict == ("ok" if right else judged.verdict)
    assert ("swapped nodes" in said(judged)) is (drive != slider)
    assert ("wrong direction" in said(judged)) is (turned < 0)
    assert bool(judged.remedy) is (judged.verdict == "wrong")


@given(name=sliders, rule=st.floats(2e-4, 0.01), sign=signs, counted=st.floats(-0.01, 0.19))
def test_an_encoder_that_does_not_go_along_is_loose(name: str, rule: float, sign: float, counted: float) -> None:
    asked = sign * TEST_DISTANCE_M
    out = counted * sign * min(rule, TEST_DISTANCE_M)
    seen = moved(name, commanded=asked, out=out, rule_out=sign * rule, stopped="slider A: following error")
    judged = judge_move(seen, drives())
    assert judged.verdict == "wrong"
    assert "loose encoder" in said(judged)
    assert judged.changes == {}


@given(name=sliders, lost=st.floats(0.11, 0.9), sign=signs)
def test_one_that_comes_back_elsewhere_slips(name: str, lost: float, sign: float) -> None:
    rule = sign * TEST_DISTANCE_M / (1.0 - lost)
    seen = moved(
        name,
        commanded=sign * TEST_DISTANCE_M,
        out=sign * TEST_DISTANCE_M,
        rule_out=rule,
        rule_back=rule - sign * TEST_DISTANCE_M,
    )
    judged = judge_move(seen, drives())
    assert (judged.verdict, judged.changes) == ("wrong", {})
    assert "slip" in said(judged)


readings = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)


@given(
    name=sliders,
    way=st.floats(5e-4, 0.02),
    sign=signs,
    share=st.floats(0.0, 1.0),
    noise=readings,
    read_to=st.sampled_from((1e-6, 1e-5, 1e-4, 5e-4)),
    power=st.booleans(),
)
def test_a_slip_is_never_told_as_a_scale(
    name: str, way: float, sign: float, share: float, noise: list[float], read_to: float, power: bool
) -> None:
    """Whatever share is lost, there or back, however long the way and however badly the rule is read."""
    there, back = (1.0 - share, 1.0) if sign > 0.0 else (1.0, 1.0 - share)
    rules = [place + read_to * error for place, error in zip((0.0, sign * way, 0.0), noise, strict=True)]
    rule, rule_back = rules[1] - rules[0], rules[2] - rules[1]
    counted, counted_back = there * sign * way, -back * sign * way
    if power:
        seen = moved(name, commanded=counted, out=counted, back=counted_back, rule_out=rule, rule_back=rule + rule_back)
        assume(counted)
        judged = judge_move(seen._replace(rule_resolution=read_to), drives())
    else:
        judged = judge_push(pushed(name, rule, counted, rule_back, counted_back, read_to), drives())
    assert not [key for key in judged.changes if key.endswith("counts_per_metre")]
    unread = 4.0 * (read_to + 1e-7) / min(abs(rule), abs(rule_back))
    told = "slipping" in said(judged) or "loose" in said(judged)
    if judged.verdict != "failed" and share > 0.1 + 2.0 * unread:
        assert told, judged
    if share == 0.0:
        assert not told


@given(name=sliders, way=st.floats(5e-3, 0.02), sign=signs, ratio=st.floats(0.05, 20.0), noise=readings)
def test_a_scale_is_never_told_as_a_slip(name: str, way: float, sign: float, ratio: float, noise: list[float]) -> None:
    read_to = 1e-5
    rules = [place + read_to * error for place, error in zip((0.0, sign * way, 0.0), noise, strict=True)]
    rule, rule_back = rules[1] - rules[0], rules[2] - rules[1]
    seen = pushed(name, rule, ratio * sign * way, rule_back, -ratio * sign * way, read_to)
    judged = judge_push(seen, drives())
    assert "slip" not in said(judged)
    if abs(ratio - 1.0) > 1.5 * SCALE_TOLERANCE:
        assert judged.changes[f"drives.{name}.counts_per_metre"] == pytest.approx(1e6 * ratio, rel=0.01)


def pushed(name: str, rule: float, way: float, rule_back: float, way_back: float, read_to: float) -> PushObservation:
    """Slider and drive of one name; the others stood still."""
    ways, ways_back = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    ways[NAMES.index(name)], ways_back[NAMES.index(name)] = way, way_back
    (a, b, c), (d, e, f) = ways, ways_back
    return PushObservation(name, rule, (a, b, c), rule_back, (d, e, f), read_to, 1e-7)


@given(name=sliders, away=st.floats(0.06, 5.0), sign=signs)
def test_one_that_counts_backwards_runs_away(name: str, away: float, sign: float) -> None:
    asked = sign * TEST_DISTANCE_M
    seen = moved(name, commanded=asked, out=-away * asked, rule_out=away * asked, stopped="following error")
    judged = judge_move(seen, drives())
    assert judged.verdict == "wrong"
    assert "against its motor" in said(judged)
    assert judged.changes == {}  # `direction` would only hide it


@given(read_to=st.floats(1e-5, 5e-3), ratio=st.floats(0.3, 3.0))
def test_no_scale_is_changed_by_what_a_rule_cannot_tell(read_to: float, ratio: float) -> None:
    rule = TEST_DISTANCE_M / ratio
    judged = judge_move(moved(rule_out=rule, rule_resolution=read_to), drives())
    unread = 2.0 * (read_to + 1e-7) / rule
    if unread > MAX_RULE_UNCERTAINTY:
        assert "drives.A.counts_per_metre" not in judged.changes


@given(moves=st.permutations(NAMES))
def test_nodes_go_where_their_sliders_are(moves: list[str]) -> None:
    before = drives()
    changes = [
        judge_move(moved(name, slider=slider), before).changes for name, slider in zip(NAMES, moves, strict=True)
    ]
    together, conflict = merge_changes(changes, before)
    assert conflict == ""
    after = {name: together.get(f"drives.{name}.node", getattr(before, name).node) for name in NAMES}
    assert after == {slider: getattr(before, name).node for name, slider in zip(NAMES, moves, strict=True)}


@given(number=st.integers(1, 2), moves=st.permutations(NAMES))
def test_nodes_stay_different_where_only_some_were_looked_at(number: int, moves: list[str]) -> None:
    before = drives()
    seen = [
        judge_move(moved(name, slider=slider), before)
        for name, slider in zip(NAMES[:number], moves[:number], strict=True)
    ]
    together, _ = merge_changes([judged.changes for judged in seen], before)
    nodes = [together.get(f"drives.{name}.node", getattr(before, name).node) for name in NAMES]
    assert sorted(nodes) == sorted(drive.node for drive in before.each)


@given(
    order=st.permutations(range(3)),
    directions=st.tuples(*[st.sampled_from((1, -1))] * 3),
    counts=st.tuples(*[st.sampled_from((1e6, 2e6, 5e6))] * 3),
    pushed=st.sets(sliders, min_size=1),
    slip=st.sampled_from((1.0, 0.8)),
    resolution=st.sampled_from((1e-5, 2e-3)),
)
def test_direction_and_counts_follow_a_drive_to_its_slider(
    order: list[int],
    directions: tuple[int, ...],
    counts: tuple[float, ...],
    pushed: set[str],
    slip: float,
    resolution: float,
) -> None:
    """The slider with index s belongs to the drive with index order[s], for which the configuration is right."""
    before = CONFIG.drives
    for name, direction, each in zip(NAMES, directions, counts, strict=True):
        drive = msgspec.structs.replace(getattr(before, name), direction=direction, counts_per_metre=each)
        before = msgspec.structs.replace(before, **{name: drive})
    proposals = []
    for name in sorted(pushed):
        drive = order[NAMES.index(name)]
        out, back = (
            (length * (drive == 0), length * (drive == 1), length * (drive == 2)) for length in (0.01, -0.01 * slip)
        )
        seen = PushObservation(name, 0.01, out, -0.01, back, resolution, 1e-7)
        proposals.append(judge_push(seen, before).changes)
    together, _ = merge_changes(proposals, before)
    of = {drive.node: drive for drive in before.each}
    for name, drive in zip(NAMES, before.each, strict=True):
        belonging = of[int(together.get(f"drives.{name}.node", drive.node))]
        for key in ("direction", "counts_per_metre"):
            assert together.get(f"drives.{name}.{key}", getattr(drive, key)) == getattr(belonging, key)


def test_two_drives_on_one_slider_are_no_exchange() -> None:
    before = drives()
    seen = [judge_move(moved(name, slider="C"), before).changes for name in ("A", "B")]
    together, conflict = merge_changes([*seen, {"drives.A.direction": -1}], before)
    nodes = [together.get(f"drives.{name}.node", getattr(before, name).node) for name in NAMES]
    assert len(set(nodes)) == 3
    assert together["drives.A.direction"] == -1
    assert conflict == "" or "one slider" in conflict


@given(
    seconds=st.one_of(st.none(), st.floats(0.001, 2.0)),
    code=st.sampled_from((0, 0x8130, 0x8700)),
)
def test_a_drive_that_keeps_its_power_never_passes(seconds: float | None, code: int) -> None:
    judged = judge_watchdog("B", seconds, "said", code)
    assert (judged.verdict == "ok") is (seconds is not None)
    assert bool(judged.remedy) is (judged.verdict != "ok")


@given(rest=st.integers(0, 7), changed=st.integers(0, 0xFFFF), seen=st.booleans())
def test_switches_pass_where_all_were_seen_and_no_limit_is_pressed(rest: int, changed: int, seen: bool) -> None:
    judged = judge_switches("A", rest, changed, seen)
    assert (judged.verdict == "ok") is (seen and not rest & 3)
    assert bool(judged.remedy) is (judged.verdict == "wrong")
    assert said(judged).count("never changed") == 3 - (changed & 7).bit_count()


def test_a_square_that_nobody_saw_is_wrong() -> None:
    verdicts = [
        judge_square(1e-5, (0.0, 0.0, 0.0), seen, stopped).verdict
        for seen, stopped in itertools.product((True, False), ("", "slider A: following error"))
    ]
    assert verdicts == ["ok", "failed", "wrong", "failed"]


@given(st.integers(1_000_000, 100_000_000))
def test_the_values_of_another_drive_are_told_to_the_last_digit(counts: int) -> None:
    """Who types what is read has the scale that was meant."""
    given = drives()
    given = msgspec.structs.replace(given, B=msgspec.structs.replace(given.B, counts_per_metre=float(counts)))
    judged = judge_move(moved("B", slider="A"), given)
    report = CommissioningReport("demo", "robot.toml", "now", False, "tests", changes=dict(judged.changes))
    if counts != given.A.counts_per_metre:
        assert f"drives.A.counts_per_metre = {counts}, not 1000000" in judged.remedy
        assert f"drives.A.counts_per_metre should be {counts}" in format_lines(report)


@given(slider=sliders, offset=st.floats(-0.5, 0.5), beyond=st.floats(-0.1, 0.1), confirmed=st.booleans())
def test_a_position_away_from_the_configured_home_is_pointed_out(
    slider: str, offset: float, beyond: float, confirmed: bool
) -> None:
    assume(abs(abs(beyond) - 0.001) > 1e-9)
    judgement = judge_homing(slider, None, offset + beyond, offset, confirmed, "")
    assert judgement.verdict == ("ok" if confirmed else "wrong")
    assert any(f"drives.{slider}.offset" in words for words in judgement.words) == (abs(beyond) > 0.001)


@given(moves=st.permutations((0, 1, 2)), makes=st.tuples(*3 * [st.sampled_from((None, "elmo.eds", "maxon.eds"))]))
def test_node_ids_move_only_between_drives_of_one_make(
    moves: list[int], makes: tuple[str | None, str | None, str | None]
) -> None:
    """A drive takes its dictionary, its units and its own objects with it, which no step writes."""
    found = drives()
    for name, eds in zip(NAMES, makes, strict=True):
        found = msgspec.structs.replace(found, **{name: msgspec.structs.replace(getattr(found, name), eds=eds)})
    nodes = [drive.node for drive in found.each]
    proposed = {f"drives.{name}.node": nodes[at] for name, at in zip(NAMES, moves, strict=True)}
    changes, conflict = merge_changes([proposed, {"drives.A.direction": -1}], found)
    if all(makes[at] == makes[moves[at]] for at in range(3)):
        assert conflict == ""
        assert changes["drives.A.direction"] == -1
    else:  # the direction is that of the drive that A does not get
        assert changes == ({"drives.A.direction": -1} if moves[0] == 0 else {})
        assert "is that of another make" in conflict
        assert "eds" in conflict
