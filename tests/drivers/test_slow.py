"""Drives that take their time are waited for, or refused with the time they were given; by a clock of the tests."""

from __future__ import annotations

import logging
import random
import re
import threading
from collections.abc import Callable

import pytest
from drivers.foreign import ENABLED, REACTION, Habits
from drivers.slow import Slowness, SlowWires, three_slow
from drivers.test_foreign import COUNTS, MAKES, PERIOD, Rig
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import Closing, alike
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Drives
from trirail_drivers.errors import DriveError, DriveTimeout
from trirail_drivers.interface import PowerState
from trirail_drivers.timing import BusTiming

GIVEN = re.compile(r"(?:within|after|for) ([\d.e-]+) s\b")
"""How long was waited, in a refusal."""


class SlowRig(Rig):
    """Three drives of a make, each as slow as `slow` says of its node."""

    wires: SlowWires

    def __init__(
        self,
        name: str,
        slow: Callable[[int], Slowness],
        habits: Habits | None = None,
        *,
        sdo_timeout: float = 0.5,
        stop_timeout: float = 1.0,
    ) -> None:
        make = MAKES[name]
        self.config = Drives(
            "cia402",
            *alike(**{"counts_per_metre": COUNTS, **make.keys}),
            quick_stop_deceleration=2.0,
            sdo_timeout=sdo_timeout,
            stop_timeout=stop_timeout,
        )
        self.wires, self.clock = three_slow(name, make.truth, slow, habits)
        self.drives = Cia402(self.wires, BusTiming(1_000_000), self.config, self.clock)
        self.warnings = []


def refusal(rig: SlowRig) -> str:
    """Why the set-up refuses; "" where it does not."""
    try:
        rig.drives.configure(PERIOD)
    except DriveError as error:
        return str(error)
    finally:
        rig.drives.close()
    return ""


def test_a_value_that_never_comes_is_told_with_the_time_that_it_was_given() -> None:
    rig = SlowRig("elmo_gold", lambda node: Slowness(effect=lambda: 2.0 * (node == 2)))
    said = refusal(rig)
    assert re.match(
        r"drive B: object 1006:00 \(Communication cycle period\): expected 2000, found \d+ after 0\.5\d* s$", said
    ), said


@pytest.mark.parametrize(("brake", "said"), [(0.1, ""), (0.9, ""), (5.0, "did not power off .* 1 s ")])
def test_a_brake_may_take_as_long_as_any_stop(brake: float, said: str) -> None:
    rig = SlowRig("elmo_gold", lambda _: Slowness(brake=brake))
    for node in rig.nodes:
        node.state = ENABLED
    assert re.search(said, refusal(rig))


@pytest.mark.parametrize(("takes", "said"), [(0.1, ""), (0.9, ""), (5.0, "did not power off .* 1 s ")])
def test_a_drive_that_reacts_to_a_fault_is_configured_when_it_has_stopped(takes: float, said: str) -> None:
    rig = SlowRig("elmo_gold", lambda _: Slowness())
    node = rig.wires.slow[1]
    node.state, node.servo.velocity = REACTION, 1.0
    node.servo.brake = lambda *_: None  # type: ignore[method-assign]
    node._later(takes, lambda: setattr(node.servo, "velocity", 0.0))
    before = rig.clock.now
    assert re.search(said, refusal(rig))
    assert rig.clock.now - before >= min(takes, 1.0)


def test_drives_that_boot_later_are_waited_for_and_that_is_told(
    closing: Closing, caplog: pytest.LogCaptureFixture
) -> None:
    rig = closing(SlowRig("elmo_gold", lambda node: Slowness(boots=(0.0, 0.3, 2.6)[node - 1])))
    with caplog.at_level(logging.WARNING, "trirail.drives"):
        rig.ready()
    assert rig.clock.now < 100.0 + 3.0
    said = [record.getMessage() for record in caplog.records]
    assert "waiting for drive C to boot" in said
    assert "waiting for drive B to boot" not in said, "its boot-up message came before it was missed"
    assert any(re.search(r"reading: A \d+ answers, done; .*; C booting$", line) for line in said)
    rig.drives.close()


def test_a_drive_that_never_boots_is_told_with_the_time_that_it_was_given(closing: Closing) -> None:
    rig = closing(SlowRig("elmo_gold", lambda node: Slowness(boots=60.0 * (node == 2))))
    with pytest.raises(DriveTimeout, match=r"^drive B: no answer for object 1000:00 \(Device type\) within 5 s; "):
        rig.drives.configure(PERIOD)
    rig.drives.close()


def test_a_drive_that_boots_again_and_again_is_told(closing: Closing) -> None:
    """It answers no request before it boots again."""
    rig = closing(SlowRig("elmo_gold", lambda node: Slowness(answer=lambda: 60.0 * (node == 2))))
    for number in range(1, 200):
        rig.wires.slow[1].boots_in(0.2 * number)
    said = r"^drive B: no answer for object 1000:00 \(Device type\), only boot-up messages, within 10\S* s; "
    with pytest.raises(DriveTimeout, match=said):
        rig.drives.configure(PERIOD)


def test_a_drive_that_restarts_while_it_is_set_up_is_told(closing: Closing) -> None:
    rig = closing(SlowRig("elmo_gold", lambda _: Slowness(answer=lambda: 0.01)))
    rig.wires.slow[2].boots_in(0.5)
    with pytest.raises(DriveError, match=r"^drive C: the drive restarted meanwhile"):
        rig.drives.configure(PERIOD)
    rig.drives.close()


def _settings(rig: SlowRig) -> dict[int, object]:
    """What the set-up has written into drive A and a restart loses."""
    return {index: each for index, each in rig.nodes[0].local.data_store.items() if 0x1005 <= index < 0x1C00}


@pytest.mark.generated(*range(24))
def test_a_drive_that_restarts_at_any_time_is_told_or_has_all_its_settings(closing: Closing, seed: int) -> None:
    """Also after its own set-up, while that of a slower one goes on, and just after that of all."""

    def slow(node: int) -> Slowness:
        return Slowness(answer=lambda: (0.001, 0.002, 0.003)[node - 1])

    whole = closing(SlowRig("elmo_gold", slow))
    whole.drives.configure(PERIOD)
    took = whole.clock.now - 100.0
    rig = closing(SlowRig("elmo_gold", slow))
    rig.wires.slow[0].boots_in(random.Random(seed).uniform(0.0, took + PERIOD))
    refused = ""
    try:
        rig.drives.configure(PERIOD)
    except DriveError as error:
        refused = str(error)
    if refused:
        assert refused == "drive A: the drive restarted meanwhile; check its power supply"
        return
    fault = [rig.cycle().fault for _ in range(3)][-1]
    assert _settings(rig) == _settings(whole) or (fault is not None and "has restarted" in str(fault)), fault


@settings(max_examples=16)
@given(
    name=st.sampled_from(["elmo_gold", "technosoft_ipos", "ros2_cia402_slave", "pilz_prbt"]),
    chance=st.integers(0, 2**32 - 1),
    answer=st.sampled_from([0.0, 0.01, 0.2, 2.0]),
    effect=st.sampled_from([0.0, 0.01, 0.4, 2.0]),
    brake=st.floats(0.0, 2.0),
    boots=st.floats(0.0, 2.0),
    timeout=st.sampled_from([0.1, 0.5, 2.1]),
)
def test_whatever_delay_is_waited_for_or_told_with_its_time(
    name: str, chance: int, answer: float, effect: float, brake: float, boots: float, timeout: float
) -> None:
    """Every answer and every effect comes up to 2 s later; within the time-outs the drives are set up."""
    drawn = random.Random(chance)

    def slow(_node: int) -> Slowness:
        return Slowness(lambda: drawn.uniform(0, answer), lambda: drawn.uniform(0, effect), brake, boots)

    rig = SlowRig(name, slow, sdo_timeout=timeout, stop_timeout=timeout)
    for node in rig.nodes:
        node.state = ENABLED
    said = refusal(rig)
    if max(answer, effect, brake) < timeout and boots < 10 * timeout:
        assert said == ""
    else:
        assert said == "" or all(
            GIVEN.search(each) or each.endswith(": the same") for each in said.split("; drive ")
        ), said


def test_three_drives_take_as_long_as_the_slowest_one(closing: Closing) -> None:
    """200 ms an answer; one after the other it would be three times that."""
    rig = closing(SlowRig("elmo_gold", lambda _: Slowness(answer=lambda: 0.2)))
    rig.drives.configure(PERIOD)
    requests = [sum(message.arbitration_id == 0x600 + node for message in rig.wires.sent) for node in (1, 2, 3)]
    took = rig.clock.now - 100.0
    assert took == pytest.approx(0.2 * max(requests), rel=0.01)
    assert took < 0.35 * 0.2 * sum(requests)
    rig.drives.close()


def test_no_thread_is_left_by_the_set_up(closing: Closing) -> None:
    before = threading.active_count()
    rig = closing(SlowRig("elmo_gold", lambda _: Slowness()))
    rig.ready()
    assert threading.active_count() <= before  # of other tests some may end meanwhile
    rig.drives.close()


@pytest.mark.parametrize(
    ("habits", "ignores"),
    [
        (Habits(without=frozenset({0x6502}), refuses={(0x6060, 0): lambda mode: mode == 8}), 0),
        (Habits(without=frozenset({0x6502})), 8),
    ],
    ids=["refused", "not taken up"],
)
@pytest.mark.parametrize("was", [0, 3])
def test_without_6502_the_other_mode_is_tried(closing: Closing, habits: Habits, ignores: int, was: int) -> None:
    rig = closing(SlowRig("technosoft_ipos", lambda _: Slowness(ignores=ignores), habits))
    for node in rig.nodes:
        node.mode = was
    rig.ready()
    assert [node.mode for node in rig.nodes] == [7, 7, 7]
    rig.enable()
    rig.go(0.05, 20)
    rig.drives.close()


def held(rig: SlowRig) -> list[float]:
    return [node.servo.position for node in rig.nodes]


@pytest.mark.parametrize("shown", [0, 6])
@pytest.mark.parametrize("name", ["elmo_gold", "pilz_prbt", "maxon_epos4_compact50_5"])
def test_a_mode_that_is_shown_only_with_power_is_waited_for_where_the_drive_stands(
    closing: Closing, name: str, shown: int
) -> None:
    """Without power, it shows none, or that of a homing that was broken off."""
    rig = closing(SlowRig(name, lambda _: Slowness(shows=shown, mode_takes=0.0 if shown else 0.3)))
    rig.ready()
    assert any("until it shows mode" in warning for warning in rig.warnings)
    began = held(rig)
    rig.drives.enable()
    a, b, c = rig.feedback.position
    ahead = a + 0.01, b + 0.01, c + 0.01  # what must not be followed yet
    for _ in range(300):
        feedback = rig.cycle(ahead, (0.1, 0.1, 0.1))
        assert feedback.fault is None, feedback.fault
        if set(feedback.state) == {PowerState.OPERATION_ENABLED}:
            break
        assert held(rig) == pytest.approx(began, abs=1e-4)
        assert PowerState.OPERATION_ENABLED not in feedback.state
    else:
        raise AssertionError("not enabled")
    rig.feedback, rig.target = feedback, feedback.position
    rig.go(0.1, 50)
    assert held(rig) != pytest.approx(began, abs=5e-3)
    rig.drives.close()


@pytest.mark.parametrize(
    ("shown", "said"), [(0, r"shows no mode \(object 6061\) 0\.5\d* s after"), (1, "shows mode 1")]
)
def test_a_mode_that_does_not_come_with_power_stops_all_three(closing: Closing, shown: int, said: str) -> None:
    rig = closing(SlowRig("elmo_gold", lambda _: Slowness(shows=0, mode_takes=1e9)))
    rig.ready()
    rig.drives.enable()
    for cycle in range(400):
        if cycle == 100:
            rig.wires.slow[1].slowness.shows = shown
        feedback = rig.cycle(rig.feedback.position)
        assert PowerState.OPERATION_ENABLED not in feedback.state
        if feedback.fault is not None:
            break
    assert feedback.fault is not None
    assert feedback.fault.cause == "state"
    assert re.search(said, feedback.fault.message), feedback.fault
    rig.drives.close()


def test_another_mode_than_none_is_refused_before_power() -> None:
    rig = SlowRig("elmo_gold", lambda node: Slowness(shows=3 if node == 2 else None))
    assert re.match(r"drive B: object 6061:00 \(.*\): expected 8, found 3 after 0\.5\d* s$", refusal(rig))
