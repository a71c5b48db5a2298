"""When a command counts as carried out: by what the robot does and what its drives say, stated command by command."""

from __future__ import annotations

from itertools import product

import pytest
from conftest import CONFIG
from trirail.config import geometry
from trirail.control.completion import still_powered, verdict
from trirail.control.feedback import Measured
from trirail.wire.vocabulary import Command, Mode
from trirail_drivers.interface import DriveFault, Feedback, PowerState

P = PowerState
OFF, ON = P.SWITCH_ON_DISABLED, P.OPERATION_ENABLED
CAN_MOVE = (ON, P.QUICK_STOP_ACTIVE, P.FAULT_REACTION_ACTIVE)
DONE, NOT_YET = "", None
WHY = "drive B: silent"


def saying(
    *states: PowerState, homed: tuple[bool, bool, bool] = (True, True, True), fault: DriveFault | None = None
) -> Measured:
    measured = Measured(geometry(CONFIG.geometry).packed(), CONFIG.period, 1e-3)
    a, b, c = states or (OFF, OFF, OFF)
    measured.start(Feedback((0.0, 0.0, 0.0), (a, b, c), fault, homed=homed))
    return measured


def one(state: PowerState, index: int) -> Measured:
    """Two drives without power, and one in this state."""
    states = [OFF, OFF, OFF]
    states[index] = state
    return saying(*states)


@pytest.mark.parametrize("mode", Mode)
def test_enable_is_over_when_the_robot_is_no_longer_powering_up(mode: Mode) -> None:
    said = verdict(Command.ENABLE, mode, WHY if mode is Mode.FAULT else None, saying(), settled=True)
    expected = {Mode.ENABLING: NOT_YET, Mode.FAULT: WHY, Mode.DISABLED: "disabled while powering up"}
    assert said == expected.get(mode, DONE)


@pytest.mark.parametrize(("mode", "index", "state"), [*product(Mode, range(3), P)])
def test_disable_is_over_when_the_robot_stands_and_no_drive_can_move(mode: Mode, index: int, state: P) -> None:
    can_move = state in CAN_MOVE
    expected = NOT_YET if can_move or mode is Mode.STOPPING else DONE
    assert verdict(Command.DISABLE, mode, None, one(state, index), settled=True) == expected
    assert verdict(Command.QUICK_STOP, mode, None, one(state, index), settled=True) == (NOT_YET if can_move else DONE)


@pytest.mark.parametrize("name", [Command.DISABLE, Command.QUICK_STOP])
def test_a_drive_that_keeps_its_power_in_the_end_fails_the_command(name: Command) -> None:
    late, silent = DriveFault("B", "timeout", 0, "it has not stopped"), DriveFault("B", "silent", 0, WHY)
    assert verdict(name, Mode.FAULT, WHY, saying(OFF, ON, OFF, fault=late), settled=True) == "it has not stopped"
    assert verdict(name, Mode.FAULT, WHY, saying(OFF, ON, OFF, fault=silent), settled=True) is NOT_YET
    assert verdict(Command.STOP, Mode.STOPPING, WHY, saying(OFF, ON, OFF, fault=late), settled=True) is NOT_YET


@pytest.mark.parametrize("name", [Command.STOP, Command.PAUSE, Command.RELEASE])
@pytest.mark.parametrize("mode", Mode)
def test_a_stop_is_over_when_the_robot_stands(name: Command, mode: Mode) -> None:
    expected = NOT_YET if mode is Mode.STOPPING else DONE
    assert verdict(name, mode, None, saying(ON, ON, ON), settled=True) == expected


@pytest.mark.parametrize("homed", [*product((False, True), repeat=3)])
@pytest.mark.parametrize("mode", Mode)
def test_home_is_done_when_every_drive_is_homed(mode: Mode, homed: tuple[bool, bool, bool]) -> None:
    measured = saying(ON, ON, ON, homed=homed)
    under_way = mode in (Mode.HOMING, Mode.STOPPING)
    without = {None: "stopped before every drive was homed", WHY: WHY}
    for latched, why in without.items():
        expected = NOT_YET if under_way else DONE if all(homed) else why
        assert verdict(Command.HOME, mode, latched, measured, settled=True) == expected


@pytest.mark.parametrize("name", [Command.RESUME, Command.OVERRIDE, Command.ACQUIRE])
@pytest.mark.parametrize("mode", Mode)
def test_what_changes_the_rate_or_the_lease_is_done_at_once(name: Command, mode: Mode) -> None:
    assert verdict(name, mode, None, saying(ON, ON, ON), settled=False) == DONE


@pytest.mark.parametrize(("settled", "index", "state"), [*product((False, True), range(3), P)])
def test_reset_is_done_when_the_drives_had_time_and_none_is_in_fault(settled: bool, index: int, state: P) -> None:
    measured = one(state, index)
    faulty = state in (P.FAULT, P.FAULT_REACTION_ACTIVE)
    expected = DONE if settled and not faulty else NOT_YET
    assert verdict(Command.RESET, Mode.DISABLED, None, measured, settled=settled) == expected
    assert verdict(Command.RESET, Mode.FAULT, WHY, measured, settled=settled) == f"the cause is still there: {WHY}"


@pytest.mark.parametrize(("index", "state"), [*product(range(3), P)])
def test_still_powered_names_the_drives_that_can_move(index: int, state: P) -> None:
    states, _, advice = still_powered(one(state, index), WHY).partition(" by what it said last: ")
    assert (states == f"drive {'ABC'[index]} is {state}") == (state in CAN_MOVE)
    assert (states == "") == (state not in CAN_MOVE)
    assert advice == f"send reset again when the drives stand (fault: {WHY})"
