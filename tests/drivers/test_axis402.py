"""One CiA 402 drive as its frames tell of it: when it counts as silent, in fault, restarted or out of operation."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.cia402.axis import REGISTER_TIME, Cia402Axis
from trirail_drivers.cia402.one_drive import HAS_POWER
from trirail_drivers.cia402.process_data import ACTUAL_POSITION, STATUSWORD, FeedbackPdo
from trirail_drivers.config import Drive, Drives
from trirail_drivers.driver.row_updates import count_sync, end_reading
from trirail_drivers.driver.scaling import Scale
from trirail_drivers.interface import DriveFault, PowerState

P = PowerState
ENABLED, READY, FAULT = b"\x37\x02", b"\x31\x02", b"\x18\x02"
ERROR = bytes.fromhex("1043 08 0000000000")
OVER = bytes(8)
OPERATIONAL, PRE_OPERATIONAL, BOOT_UP = b"\x05", b"\x7f", b"\0"
WANTED: canopen_frames.TargetState = P.OPERATION_ENABLED
OFF: canopen_frames.TargetState = P.SWITCH_ON_DISABLED
T = 50.0
EACH = Drive(1, 1e6)
UNHURRIED = Drives("cia402", EACH, EACH, EACH, heartbeat=100.0)
COOL = "let it cool down; check load and airflow"


def made() -> Cia402Axis:
    """A drive that is heard and follows setpoints."""
    axis = Cia402Axis("B", 2, Scale(-1e6, 0.1), UNHURRIED)
    axis.on_heartbeat(OPERATIONAL, T)
    axis.on_status(ENABLED, T)
    axis.on_position(canopen_frames.POSITION.pack(1000), T)
    assert axis.find_fault(T, WANTED) is None
    return axis


def state_of(axis: Cia402Axis) -> PowerState:
    return axis.state


def test_statuswords_may_be_missing_for_three_of_their_periods() -> None:
    axis = made()
    assert axis.find_fault(T + 0.299, WANTED) is None
    fault = axis.find_fault(T + 0.301, WANTED)
    assert fault == ("B", "silent", 0, "drive B: no statusword for 0.301 s")


def test_a_fault_reset_has_the_time_of_two_statuswords() -> None:
    axis = made()
    axis.on_status(FAULT, T)
    assert axis.find_fault(T, WANTED) == ("B", "fault", 0, "drive B: fault")
    axis.clear_faults(T)
    assert axis.find_fault(T + 0.199, WANTED) is None
    assert axis.find_fault(T + 0.201, WANTED) == ("B", "fault", 0, "drive B: fault, still 0.2 s after a fault reset")
    axis.on_status(READY, T + 0.25)
    axis.on_status(FAULT, T + 0.26)  # a new one has no time
    assert axis.find_fault(T + 0.26, OFF) == ("B", "fault", 0, "drive B: fault")


def test_a_reset_under_way_gets_no_more_time_and_the_next_one_has_an_edge() -> None:
    """CiA 402-2, transition 15: a rising edge of bit 7 resets a fault."""
    axis = made()
    axis.on_status(FAULT, T)
    for at in (T, T + 0.1, T + 0.199):
        axis.clear_faults(at)
        axis.controlword = axis.word(at, OFF)
        assert axis.controlword == canopen_frames.FAULT_RESET
    axis.clear_faults(T + 0.201)  # bit 7 has not fallen yet
    assert axis.find_fault(T + 0.201, OFF) is not None
    axis.controlword = axis.word(T + 0.201, OFF)
    assert not axis.controlword & canopen_frames.FAULT_RESET
    axis.clear_faults(T + 0.202)
    assert axis.word(T + 0.202, OFF) == canopen_frames.FAULT_RESET


def test_requests_for_the_error_register_in_quick_succession_hide_no_error() -> None:
    axis = made()
    axis.on_emergency(ERROR, T)
    axis.clear_faults(T)
    axis.clear_faults(T + REGISTER_TIME - 0.01)
    axis.on_status(ENABLED, T + REGISTER_TIME)
    assert axis.find_fault(T + REGISTER_TIME, OFF) is not None


SWITCHED_ON = b"\x33\x02"
frames_of_a_statusword = st.lists(st.sampled_from(["changes", "PDO", "request", "answer"]), max_size=30)


@given(frames_of_a_statusword)
@example(["request", "changes", "PDO", "answer"])
def test_an_older_statusword_by_sdo_replaces_no_newer_one_by_pdo(events: list[str]) -> None:
    """The drive samples its statusword when it gets a request, and when it sends a PDO, which overtakes the answer."""
    axis, words = made(), (ENABLED, SWITCHED_ON)
    newest = number = 0
    sampled: list[int] = []
    for event in events:
        if event == "changes":
            number += 1
        elif event == "PDO":
            axis.on_status(words[number % 2], T)
            newest = number
        elif event == "request" and not sampled:
            axis.note_request(T, canopen_frames.STATUSWORD_UPLOAD)
            sampled = [number]
        elif event == "answer" and sampled:
            newest = max(newest, sampled[0])
            axis.on_sdo(canopen_frames.STATUSWORD_UPLOADED + words[sampled.pop() % 2] + bytes(2), T)
        (expected,) = canopen_frames.STATUSWORD.unpack(words[newest % 2])
        assert axis.statusword == expected


@pytest.mark.parametrize("sign", [1, -1])
def test_a_quick_stop_ends_without_power_once_the_slider_has_stood_for_a_tenth_of_a_second(sign: int) -> None:
    """It stands where it stays within 20 µm; while it moves by more the drive keeps its power, and brakes."""
    axis = made()
    axis.on_status(b"\x07\0", T)
    stopping = axis.word(T, P.QUICK_STOP_ACTIVE)
    moved = T + 0.05
    for time, counts in ((T, 1000), (moved, 1000 + sign * 21), (moved + 0.05, 1000 + sign * 2)):
        axis.on_position(canopen_frames.POSITION.pack(counts), time)
        assert axis.word(time, P.QUICK_STOP_ACTIVE) == stopping
    axis.on_position(canopen_frames.POSITION.pack(1000 + sign * 45), moved + 0.06)
    stands = moved + 0.06
    for after, word in ((0.0999, stopping), (0.1001, canopen_frames.DISABLE_VOLTAGE)):
        axis.on_position(canopen_frames.POSITION.pack(1000 + sign * 64), stands + after)
        assert axis.word(stands + after, P.QUICK_STOP_ACTIVE) == word
    assert stopping != canopen_frames.DISABLE_VOLTAGE


@pytest.mark.parametrize("wanted", [OFF, WANTED, P.QUICK_STOP_ACTIVE])
def test_a_fault_from_before_the_start_is_told_and_left_alone_until_it_is_to_be_reset(
    wanted: canopen_frames.TargetState,
) -> None:
    axis = Cia402Axis("B", 2, Scale(1e6, 0.0), UNHURRIED)
    axis.on_heartbeat(OPERATIONAL, T)
    axis.on_status(FAULT, T)
    assert axis.find_fault(T, wanted) == ("B", "fault", 0, "drive B: fault")
    assert not axis.word(T, wanted) & canopen_frames.FAULT_RESET
    axis.clear_faults(T)
    assert axis.word(T, wanted) == canopen_frames.FAULT_RESET


def test_a_fault_has_the_code_of_its_emergency_until_it_is_over() -> None:
    axis = made()
    axis.on_emergency(ERROR, T)
    assert axis.find_fault(T, WANTED) == (
        "B",
        "emcy",
        0x4310,
        f"drive B: emergency 0x4310 (drive too hot), error register 0x08; {COOL}",
    )
    axis.clear_faults(T)  # its error register is asked for, and does not answer
    assert axis.register_wanted
    axis.on_status(ENABLED, T + REGISTER_TIME)
    axis.heard = T + REGISTER_TIME
    assert axis.find_fault(T + REGISTER_TIME - 0.01, OFF) is None
    said = ("B", "emcy", 0x4310, f"drive B: emergency 0x4310 (drive too hot) is still in force; {COOL}")
    assert axis.find_fault(T + REGISTER_TIME, OFF) == said
    axis.on_emergency(OVER, T)
    assert axis.find_fault(T, WANTED) is None


@pytest.mark.parametrize("register", [0x01, 0x08, 0x80])
def test_an_error_persists_while_the_error_register_shows_one(register: int) -> None:
    """CiA 301: an emergency with code 00xxh may report that one error of several has ended."""
    axis = made()
    axis.on_emergency(ERROR, T)
    axis.event = None
    axis.on_emergency(canopen_frames.EMERGENCY.pack(0, register, bytes(5)), T)
    assert axis.find_fault(T, WANTED) is not None
    axis.on_emergency(OVER, T)
    assert axis.find_fault(T, WANTED) is None


@pytest.mark.parametrize("homes", [True, False])
@pytest.mark.parametrize(("code", "lost"), [(0x7300, True), (0x7305, True), (0x73FF, True), (0x7400, False)])
def test_an_incremental_encoder_that_has_failed_must_be_homed_again(homes: bool, code: int, lost: bool) -> None:
    axis = made()
    axis.homes = axis.homed = True
    axis.homes = homes
    axis.on_emergency(canopen_frames.EMERGENCY.pack(code, 0x20, bytes(5)), T)
    axis.on_emergency(OVER, T)
    axis.clear_faults(T)
    assert axis.homed == (not (homes and lost))


def test_a_drive_that_has_left_its_fault_has_no_code_of_it() -> None:
    axis = made()
    axis.on_status(FAULT, T)
    axis.on_emergency(ERROR, T)
    axis.clear_faults(T)
    assert axis.find_fault(T + 1.0, WANTED) == (
        "B", "fault", 0x4310, f"drive B: fault, error 0x4310 (drive too hot), still 0.2 s after a fault reset; {COOL}",
    )  # fmt: skip
    axis.on_status(READY, T + 1.0)
    assert axis.error_code == 0
    assert axis.find_fault(T + 1.0, OFF) is None


@pytest.mark.parametrize("told_by", ["heartbeat", "position"])
def test_a_drive_that_was_operational_and_is_no_more_has_left_it(told_by: str) -> None:
    axis = Cia402Axis("B", 2, Scale(1e6, 0.0), UNHURRIED)
    axis.on_status(ENABLED, T)
    axis.on_heartbeat(PRE_OPERATIONAL, T)  # from before it was started
    assert axis.find_fault(T, WANTED) is None
    assert state_of(axis) is P.OPERATION_ENABLED
    if told_by == "heartbeat":
        axis.on_heartbeat(OPERATIONAL, T)
    else:
        axis.on_position(canopen_frames.POSITION.pack(0), T)
    assert not axis.status_wanted
    axis.on_heartbeat(PRE_OPERATIONAL, T)
    assert axis.find_fault(T, WANTED) == ("B", "state", 0, "drive B: has left NMT operational and is pre-operational")
    assert state_of(axis) is P.SWITCHED_ON  # as far as is known, it still has power
    assert axis.status_wanted
    assert axis.left_operational
    axis.on_heartbeat(OPERATIONAL, T)
    assert not axis.status_wanted  # somebody else has started it: its statuswords come by themselves
    axis.clear_faults(T + 5.0)
    assert axis.find_fault(T + 5.0, OFF) is not None  # until its set-up has been checked: it may have restarted
    axis.rejoin(axis.exchange, axis.units, T + 5.0, homed=True)
    axis.clear_faults(T + 5.0)
    axis.on_heartbeat(PRE_OPERATIONAL, T + 5.0)  # sent before it was started
    assert axis.configured
    assert not axis.status_wanted
    assert axis.find_fault(T + 5.299, OFF) is None  # its statuswords have time anew
    axis.on_heartbeat(OPERATIONAL, T + 5.0)
    assert not axis.status_wanted


@pytest.mark.parametrize("state", P)
@pytest.mark.parametrize("lost", ["silent", "left operational"])
def test_a_drive_that_must_be_configured_again_shows_whether_it_has_power(state: P, lost: str) -> None:
    axis = made()
    axis.state = state
    if lost == "silent":
        axis.silent = True
    else:
        axis.leave_operational()
    assert not axis.configured
    assert (axis.shown_state in HAS_POWER) is (state in HAS_POWER)


def test_a_restart_stays_until_the_drive_is_configured_again() -> None:
    axis = made()
    axis.on_emergency(ERROR, T)
    axis.on_heartbeat(BOOT_UP, T)
    said = (
        "B",
        "state",
        0,
        "drive B: has restarted and lost its set-up: wait until the drive is configured again, then send reset",
    )
    assert axis.find_fault(T, WANTED) == said
    assert state_of(axis) is P.NOT_READY_TO_SWITCH_ON
    axis.clear_faults(T)
    assert axis.find_fault(T, WANTED) == said
    axis.rejoin(axis.exchange, axis.units, T, homed=True)
    assert axis.find_fault(T, WANTED) == said
    axis.clear_faults(T)
    assert axis.find_fault(T, WANTED) != said


def test_only_the_answer_about_the_statusword_is_one() -> None:
    axis = made()
    axis.sdo_asked = b"\x40\x60"
    axis.on_sdo(b"\x4b\x41\x60\0" + READY + b"\0\0", T + 1.0)
    assert (axis.state, axis.status_heard) == (P.READY_TO_SWITCH_ON, T + 1.0)
    axis.on_sdo(b"\x4b\x40\x60\0" + ENABLED + b"\0\0", T + 2.0)
    axis.on_sdo(b"\x4b\x41\x60\0" + ENABLED, T + 2.0)  # too short for an SDO
    assert (axis.state, axis.status_heard) == (P.READY_TO_SWITCH_ON, T + 1.0)
    assert axis.sdo_asked is None
    assert axis.sdo_answer == b"\x4b\x40\x60\0" + ENABLED + b"\0\0"


@pytest.mark.parametrize("state", P)
@pytest.mark.parametrize("wanted", [P.SWITCH_ON_DISABLED, P.OPERATION_ENABLED, P.QUICK_STOP_ACTIVE])
def test_only_a_drive_that_followed_setpoints_can_leave_that_unasked(
    state: P, wanted: canopen_frames.TargetState
) -> None:
    axis = made()
    axis.state = state
    fault = axis.find_fault(T, wanted)
    in_fault = state in (P.FAULT, P.FAULT_REACTION_ACTIVE)
    if not in_fault:
        left = wanted is P.OPERATION_ENABLED and state is not P.OPERATION_ENABLED
        assert (fault is not None) == left
        axis.powered_up = False
        assert axis.find_fault(T, wanted) is None
    else:
        assert isinstance(fault, DriveFault)
        assert fault.cause == "fault"


@pytest.mark.parametrize("state", P)
def test_a_drive_that_may_still_move_is_late_to_lose_its_power(state: P) -> None:
    axis = made()
    axis.state = state
    without = (P.NOT_READY_TO_SWITCH_ON, P.SWITCH_ON_DISABLED, P.FAULT, P.FAULT_REACTION_ACTIVE)
    late = axis.stop_overdue_fault("quick stop", 1.0)
    said = ("B", "timeout", 0, f"drive B: is {state} 1 s after quick stop; expected switch on disabled")
    assert late == (None if state in without else said)


def test_what_is_no_state_of_cia_402_is_a_fault() -> None:
    axis = made()
    axis.on_status(b"\x2a\0", T)
    assert axis.find_fault(T, WANTED) == ("B", "state", 0, "drive B: statusword 002A has no CiA 402 state")
    assert state_of(axis) is P.OPERATION_ENABLED
    assert axis.heard < math.inf


@pytest.mark.parametrize("most", [1, 3, 40])
def test_as_many_positions_may_be_missed_as_the_configuration_says(most: int) -> None:
    axis = Cia402Axis("B", 2, Scale(1e6, 0.0), msgspec.structs.replace(UNHURRIED, missed_positions=most))
    axis.on_heartbeat(OPERATIONAL, T)
    axis.on_status(ENABLED, T)
    for cycle in range(most + 1):
        assert axis.find_fault(T, WANTED) is None, cycle
        count_sync(axis)
        if cycle == 0:
            axis.on_position(canopen_frames.POSITION.pack(1000), T)
        end_reading(axis)
    assert axis.find_fault(T, WANTED) == ("B", "silent", 0, f"drive B: no position for {most} cycles in a row")


CURRENT = 0x6078_0010
FOLLOWING = 0x1237


@given(
    st.permutations([ACTUAL_POSITION, STATUSWORD]) | st.permutations([ACTUAL_POSITION, STATUSWORD, CURRENT]),
    st.integers(0, 0xFFFF) | st.sampled_from([FOLLOWING, FOLLOWING | 0x8400, 0x0237, 0x1218]),
    st.integers(-(2**31), 2**31 - 1),
)
@example([STATUSWORD, ACTUAL_POSITION], 0x1218, 1000)
@example([ACTUAL_POSITION, STATUSWORD], 0x1218, 1000)
def test_compiled_cycles_end_with_a_new_state_wherever_the_frame_of_the_position_has_it(
    entries: list[int], statusword: int, counts: int
) -> None:
    """The position, the current and the other bits may have any values."""
    axis = made()
    feedback = FeedbackPdo(canopen_frames.TPDO2 + 2, tuple(entries))
    axis.set_up(replace(axis.exchange, feedback=feedback, status=None), axis.units)

    def frame(statusword: int, counts: int) -> bytes:
        values = {ACTUAL_POSITION: counts, STATUSWORD: statusword, CURRENT: counts & 0x7FFF}
        return b"".join(
            values[entry].to_bytes((entry & 0xFF) // 8, "little", signed=entry != STATUSWORD) for entry in entries
        )

    axis.on_position(frame(FOLLOWING, 7), T)
    _, length, _, mask, data, *_ = axis.expected_rows(0)[0]
    came = frame(statusword, counts)
    assert length == len(came)
    expected = all(byte & bits == wanted for byte, bits, wanted in zip(came, mask, data, strict=False))
    assert expected == (not (statusword ^ FOLLOWING) & (0x6F | canopen_frames.FOLLOWS_SETPOINTS))
