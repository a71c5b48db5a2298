"""When a command counts as carried out: by what the robot does and what its drives say, stated command by command."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import msgspec
import pytest
from control_rig import CONFIG, ControlRig
from trirail.config import geometry
from trirail.control.commands import EFFECTS, SETTLE, CommandProgress, power_left, powered_drives, powered_message
from trirail.control.feedback import MeasuredState
from trirail.wire.vocabulary import Command, Mode
from trirail_drivers.interface import DriveFault, Feedback, PowerState, Unready

P = PowerState
OFF, ON = P.SWITCH_ON_DISABLED, P.OPERATION_ENABLED
CAN_MOVE = (ON, P.QUICK_STOP_ACTIVE, P.FAULT_REACTION_ACTIVE)
DONE, NOT_YET = "", None
WHY = "drive B: silent"


def saying(
    *states: PowerState, homed: tuple[bool, bool, bool] = (True, True, True), fault: DriveFault | None = None
) -> MeasuredState:
    measured = MeasuredState(geometry(CONFIG.geometry).packed(), CONFIG.period, 1e-3)
    a, b, c = states or (OFF, OFF, OFF)
    measured.start(Feedback((0.0, 0.0, 0.0), (a, b, c), fault, homed=homed))
    return measured


def one_of_three() -> Iterator[tuple[str, PowerState, MeasuredState]]:
    """Two drives without power, and one, which is named, in any state."""
    for index, state in product(range(3), P):
        states = [OFF, OFF, OFF]
        states[index] = state
        yield "ABC"[index], state, saying(*states)


def said(
    name: Command, mode: Mode, measured: MeasuredState, why: str | None = None, settled: bool = True
) -> str | None:
    return EFFECTS[name].rule(CommandProgress(mode, why, measured, settled))


def test_enable_is_over_when_the_robot_is_no_longer_powering_up() -> None:
    other = {
        Mode.ENABLING: NOT_YET,
        Mode.FAULT: WHY,
        Mode.DISABLED: "the robot was disabled while the drives were powering up",
    }
    for mode in Mode:
        latched = WHY if mode is Mode.FAULT else None
        assert said(Command.ENABLE, mode, saying(), latched) == other.get(mode, DONE), mode


def test_disable_and_quick_stop_are_over_when_no_drive_can_move() -> None:
    for mode, (_, state, measured) in product(Mode, one_of_three()):
        over = NOT_YET if state in CAN_MOVE else DONE
        assert said(Command.QUICK_STOP, mode, measured) == over, (mode, state)
        if mode is Mode.STOPPING:
            over = NOT_YET
        elif mode not in (Mode.DISABLED, Mode.FAULT):  # somebody has enabled it again: it may never be over
            over = "the robot was enabled again before all drives were without power"
        assert said(Command.DISABLE, mode, measured) == over, (mode, state)


def test_a_drive_that_keeps_its_power_in_the_end_fails_the_command() -> None:
    late, silent = DriveFault("B", "timeout", 0, "it has not stopped"), DriveFault("B", "silent", 0, WHY)
    for name in (Command.DISABLE, Command.QUICK_STOP):
        assert said(name, Mode.FAULT, saying(OFF, ON, OFF, fault=late), WHY) == "it has not stopped"
        assert said(name, Mode.FAULT, saying(OFF, ON, OFF, fault=silent), WHY) is NOT_YET
    assert said(Command.STOP, Mode.STOPPING, saying(OFF, ON, OFF, fault=late), WHY) is NOT_YET


def test_a_stop_is_over_when_the_robot_stands() -> None:
    for name, mode in product((Command.STOP, Command.PAUSE, Command.RELEASE), Mode):
        assert said(name, mode, saying(ON, ON, ON)) == (NOT_YET if mode is Mode.STOPPING else DONE), (name, mode)


def test_home_is_done_when_every_drive_is_homed() -> None:
    either = (False, True)
    for mode, a, b, c in product(Mode, either, either, either):
        measured = saying(ON, ON, ON, homed=(a, b, c))
        for latched, why in {None: "homing was stopped before all drives were homed", WHY: WHY}.items():
            is_homed = a and b and c and mode is not Mode.FAULT
            over = NOT_YET if mode in (Mode.HOMING, Mode.STOPPING) else DONE if is_homed else why
            assert said(Command.HOME, mode, measured, latched) == over, (mode, a, b, c)


def test_what_changes_the_rate_or_the_lease_is_done_at_once() -> None:
    for name, mode in product((Command.RESUME, Command.OVERRIDE, Command.ACQUIRE), Mode):
        assert said(name, mode, saying(ON, ON, ON), settled=False) == DONE, (name, mode)


def test_reset_is_done_when_the_drives_had_time_and_none_is_in_fault() -> None:
    for settled, (_, state, measured) in product((False, True), one_of_three()):
        faulty = state in (P.FAULT, P.FAULT_REACTION_ACTIVE)
        over = DONE if settled and not faulty else NOT_YET
        assert said(Command.RESET, Mode.DISABLED, measured, settled=settled) == over, (settled, state)
        assert said(Command.RESET, Mode.FAULT, measured, WHY, settled) == f"the cause of the fault persists: {WHY}"


def test_still_powered_names_the_drives_that_can_move() -> None:
    for drive, state, measured in one_of_three():
        states, _, advice = powered_message(measured, WHY).partition(" according to the last statusword: ")
        assert states == (f"drive {drive} is {state}" if state in CAN_MOVE else "")
        assert advice == f"send reset again when the drives are at rest (fault: {WHY})"


def test_power_that_is_left_is_that_of_drives_that_can_move_or_are_silent_after_a_stop() -> None:
    for _, state, measured in one_of_three():
        assert power_left(measured) == (powered_drives(measured) if state in CAN_MOVE else "")
        measured.feedback = measured.feedback._replace(unready=(None, Unready(WHY), None))
        assert power_left(measured) == (powered_drives(measured) if state in CAN_MOVE else "")
    for cause, silent in product(("timeout", "silent"), (False, True)):
        measured = saying(fault=DriveFault("B", cause, 0, "it has not stopped"))
        measured.feedback = measured.feedback._replace(unready=(None, Unready(WHY) if silent else None, None))
        left = cause == "timeout" and silent
        assert power_left(measured) == ("it has not stopped, and does not answer" if left else "")


@pytest.mark.parametrize("rate_hz", [10, 100, 1000])
def test_a_reset_is_answered_when_the_drives_had_time_to_leave_their_faults(rate_hz: int) -> None:
    rig = ControlRig(msgspec.structs.replace(CONFIG, loop=msgspec.structs.replace(CONFIG.loop, rate_hz=rate_hz)))
    rig.command("quick_stop")
    assert rig.control.fault == "quick_stop by ann"
    before = rig.control.cycles
    rig.command("reset")
    assert rig.control.fault is None
    assert rig.control.cycles - before == max(3, round(SETTLE * rate_hz)) + 1
