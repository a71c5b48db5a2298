"""What the CiA 402 driver and the ODrive driver have in common: the same runs, each on its own simulated drives."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from rigs import ENABLED, OFF, STANDSTILL, START, STEP, DriverRig
from trirail_drivers.errors import BusError, DriveError, DriveTimeout
from trirail_drivers.timing import BusTiming

from drivers import test_cia402, test_odrive

AnyRig = DriverRig[Any, Any]


@pytest.fixture(params=[test_cia402.Rig, test_odrive.Rig], ids=["cia402", "odrive"])
def new(request: pytest.FixtureRequest) -> Iterator[AnyRig]:
    """Drives that were just switched on."""
    rig = request.param()
    yield rig
    rig.drives.close()


# ---------------------------------------------------------------------- set-up


def test_a_bus_that_takes_no_frame_is_one_on_which_no_drive_answers(new: AnyRig) -> None:
    """Its queue is full, for nobody acknowledges while all drives are off."""
    new.bus.broken = True
    with pytest.raises(DriveError, match=r"no answer .* check that the drive is powered and on this bus"):
        new.drives.configure(STEP)


def test_a_bus_that_is_lost_during_the_set_up_is_no_missing_drive(new: AnyRig) -> None:
    new.bus.inject(0x020, bytes(8), is_error_frame=True)
    new.bus.inject(0x040, bytes(8), is_error_frame=True)
    with pytest.raises(BusError, match=r"cannot use .*: bus-off"):
        new.drives.configure(STEP)


def test_a_missing_drive_is_named(new: AnyRig) -> None:
    new.devices[1].silent = True
    with pytest.raises(DriveTimeout, match=new.first_asked) as caught:
        new.drives.configure(STEP)
    assert caught.value.drive == "B"


@pytest.mark.parametrize("bitrate", [500_000, 1_000])
def test_full_bus_is_refused_with_the_rate_that_fits(new: AnyRig, bitrate: int) -> None:
    with pytest.raises(BusError, match=r"1000 Hz takes .*%.* the highest rate that fits is \d+ Hz"):
        type(new.drives)(new.bus, BusTiming(bitrate), new.config, new.clock).configure(STEP)


def test_a_drive_in_fault_is_set_up_all_the_same(new: AnyRig) -> None:
    new.devices[1].fail(0x3210)
    new.drives.configure(STEP)
    assert new.found("fault", within=1)[:3] == ("B", "fault", 0x3210)
    new.drives.reset()
    assert new.cycles(300).fault is None


def test_first_feedback_is_true_before_any_cycle(ready: AnyRig) -> None:
    feedback = ready.drives.read()
    assert feedback.position == pytest.approx(START, abs=1e-6)
    assert (feedback.state, feedback.fault, feedback.homing) == (OFF, None, False)


def test_the_time_between_set_up_and_first_cycle_is_no_loss(ready: AnyRig) -> None:
    ready.clock.now += 30.0
    assert ready.cycles(3).fault is None


# ---------------------------------------------------------------------- power


def test_nothing_moves_on_enabling(ready: AnyRig) -> None:
    ready.enable()
    feedback = ready.cycles(50)
    assert feedback.position == pytest.approx(START, abs=1e-6)
    assert feedback.fault is None


def test_reset_of_drives_that_follow_setpoints_changes_nothing(enabled: AnyRig) -> None:
    enabled.drives.reset()
    assert enabled.cycles(3).state == ENABLED
    feedback = enabled.cycles(1500)
    assert (feedback.fault, feedback.state) == (None, ENABLED)
    assert enabled.commands() == [[], [], []]


def test_drives_that_lose_their_power_as_told_are_no_fault_and_can_have_it_again(enabled: AnyRig) -> None:
    enabled.drives.disable()
    assert enabled.commands() == [[enabled.off]] * 3
    for stop in (enabled.drives.disable, enabled.drives.quick_stop):
        stop()
        feedback = enabled.cycles(1500)
        assert (feedback.state, feedback.fault) == (OFF, None)
        enabled.enable()
        assert enabled.cycles(1500).fault is None


@pytest.mark.parametrize("stop", ["disable", "quick_stop"])
@pytest.mark.parametrize("later", [200, 400])
def test_drives_that_are_enabled_again_in_time_keep_their_power(enabled: AnyRig, stop: str, later: int) -> None:
    getattr(enabled.drives, stop)()
    enabled.cycles(later)
    enabled.enable()
    feedback = enabled.cycles(1500)
    assert (feedback.fault, feedback.state) == (None, ENABLED)


@pytest.mark.parametrize("after", ["quick stop", "disable", "reset"])
def test_a_drive_that_keeps_its_power_is_named_with_its_state(enabled: AnyRig, after: str) -> None:
    enabled.keep_power(1)
    if after == "reset":
        enabled.drives.disable()
        enabled.found("timeout", within=1010)
    getattr(enabled.drives, after.replace(" ", "_"))()
    assert enabled.cycles(round(enabled.config.stop_timeout / STEP) - 1).fault is None
    said = f"drive B: {enabled.keeps_power.format(after)}"
    assert enabled.found("timeout", within=3) == ("B", "timeout", 0, said)


@pytest.mark.parametrize("before", ["set-up", "disable"])
@pytest.mark.long
def test_a_drive_that_gets_power_by_itself_is_named_with_its_state(ready: AnyRig, before: str) -> None:
    if before == "disable":
        ready.enable()
        ready.drives.disable()
    ready.cycles(1500)
    ready.keep_power(1)
    ready.get_power(1)
    said = f"drive B: {ready.keeps_power.format('it got power by itself')}"
    assert ready.found("timeout", within=1150) == ("B", "timeout", 0, said)
    again = ready.cycles(2500).fault
    assert again is not None
    assert again.message == said


def test_a_drive_that_is_left_out_and_gets_power_stops_the_one_that_is_enabled(ready: AnyRig) -> None:
    ready.drives.enable("A")
    ready.cycles(300)
    ready.keep_power(1)
    ready.get_power(1)
    said = f"drive B: {ready.keeps_power.format('it got power by itself')}"
    assert ready.found("timeout", within=1150) == ("B", "timeout", 0, said)
    assert ready.cycles(500).state[0] == OFF[0]


def test_a_drive_that_kept_its_power_and_is_then_left_out_is_named_with_the_command_that_it_ignored(
    enabled: AnyRig,
) -> None:
    enabled.keep_power(1)
    enabled.drives.disable()
    enabled.cycles(20)
    enabled.drives.enable("A")
    said = f"drive B: {enabled.keeps_power.format('disable')}"
    assert enabled.found("timeout", within=1010) == ("B", "timeout", 0, said)


def test_a_drive_that_is_left_out_and_has_power_for_a_moment_stops_no_other(ready: AnyRig) -> None:
    ready.drives.enable("A")
    ready.cycles(300)
    ready.get_power(1)  # it obeys, and loses its power again
    feedback = ready.cycles(2500)
    assert feedback.fault is None
    assert feedback.state == (ENABLED[0], *OFF[1:])


@pytest.mark.parametrize("every", [1, 40, 100, 150])
@pytest.mark.long
def test_resets_in_quick_succession_hide_no_fault_and_end_it_with_its_cause(enabled: AnyRig, every: int) -> None:
    end = enabled.keep_fault(1)
    enabled.devices[1].fail(0x3210)
    enabled.cycles(100)

    def faults(cycles: int) -> set[str | None]:
        found = set()
        for number in range(cycles):
            if number % every == 0:
                enabled.drives.reset()
            fault = enabled.cycle().fault
            found.add(fault and fault.cause)
        return found

    assert "fault" in faults(1200)
    end()
    faults(2400)  # the last reset before the end has its time
    assert faults(300) == {None}
    assert enabled.drives.read().state == OFF


def test_resets_in_quick_succession_do_not_hide_a_drive_that_keeps_its_power(enabled: AnyRig) -> None:
    enabled.keep_power(1)
    enabled.drives.disable()
    for _ in range(10):
        enabled.drives.reset()
        fault = enabled.cycles(101).fault
    assert fault == ("B", "timeout", 0, f"drive B: {enabled.keeps_power.format('disable')}")


def test_nothing_is_enabled_while_a_fault_is_latched(enabled: AnyRig) -> None:
    enabled.bus.faults.add("A fault 200")
    assert enabled.cycles(240).fault is not None
    enabled.bus.sent.clear()
    enabled.drives.enable()
    assert enabled.cycles(200).state[1:] == OFF[1:]
    assert enabled.commands() == [[], [], []]


# ---------------------------------------------------------------------- the bus


def test_bus_off_is_a_fault(enabled: AnyRig) -> None:
    enabled.bus.inject(0x040, bytes(8), is_error_frame=True)
    assert "bus-off" in enabled.found("bus", within=1).message


def test_a_bus_that_takes_no_frame_is_a_warning_and_at_the_third_cycle_a_fault(enabled: AnyRig) -> None:
    enabled.bus.broken = True
    assert "transmit queue is full" in enabled.cycle().warnings[0]
    enabled.bus.broken = False
    feedback = enabled.cycles(20)
    assert feedback.fault is None
    assert [counts.setpoints_lost for counts in enabled.drives.counts] == [1, 1, 1]
    enabled.bus.broken = True
    for _ in range(2):
        feedback = enabled.cycle()
        assert (feedback.fault, feedback.warnings) == (None, ())
    fault = enabled.found("bus", within=1)
    assert fault.drive == ""
    assert "Transmit buffer full" in fault.message


def test_a_controller_near_its_end_is_told_of_once_and_no_fault(enabled: AnyRig) -> None:
    enabled.bus.faults.add("error-passive")
    (told,) = [text for _ in range(5) for text in enabled.cycle().warnings]
    assert "error-passive: 128 transmit errors" in told
    assert enabled.cycle().fault is None


def test_setpoints_after_the_next_tick_are_counted_as_late(ready: AnyRig) -> None:
    ready.drives.sync()
    position = ready.drives.read().position
    ready.clock.now += 1.5 * STEP
    ready.drives.write(position, STANDSTILL)
    ready.cycle()
    assert [count.setpoints_late for count in ready.drives.counts] == [1, 1, 1]


def test_age_is_told_and_positions_that_come_late_or_never_are_counted(ready: AnyRig) -> None:
    ready.cycles(3)
    for frames, ages, late_and_lost in (
        (f"delay 0.0005 {ready.positions} for 1 frame", [(0, 1, 0), (0, 0, 0)], (1, 0)),
        (f"drop {ready.positions} for 2 frames", [(0, 1, 0), (0, 2, 0), (0, 0, 0)], (1, 2)),
    ):
        ready.bus.faults.add(f"B {frames}")
        assert [ready.cycle().age for _ in ages] == ages
        feedback = ready.cycle()
        assert feedback.fault is None
        assert [counts[:2] for counts in ready.drives.counts] == [(0, 0), late_and_lost, (0, 0)]


def test_silence_is_a_fault_at_the_third_sync_and_comes_back_while_it_lasts(ready: AnyRig) -> None:
    ready.cycle()
    ready.devices[1].silent = True
    assert ready.cycles(2).fault is None
    assert ready.found("silent", within=1)[:3] == ("B", "silent", 0)
    ready.drives.reset()
    ready.found("silent", within=3)
    ready.devices[1].silent = False
    ready.drives.reset()
    assert ready.cycles(300).fault is None


# ---------------------------------------------------------------------- the end


def test_closed_twice_is_closed_once(enabled: AnyRig) -> None:
    enabled.drives.close()
    enabled.bus.sent.clear()
    enabled.drives.close()
    assert enabled.bus.sent == []
    assert enabled.bus.shutdowns == 1


def test_closing_on_a_dead_bus_shuts_it_down(enabled: AnyRig) -> None:
    enabled.bus.broken = True
    enabled.drives.close()
    assert enabled.bus.shutdowns == 1
