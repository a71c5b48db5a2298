"""Every state × event, against the statement of what each event does."""

from __future__ import annotations

import pytest
from trirail.cli import terminal
from trirail.control.modes import (
    DISABLED,
    ENABLING,
    FAULT,
    HOLDING,
    HOMING,
    MOVING,
    PAUSED,
    PAUSING,
    RELEASING,
    STATES,
    STOPPING,
    STOPPING_TO_DISABLE,
    Action,
    ModeEvent,
    ModeState,
    Refusal,
    Step,
    step,
)
from trirail.telemetry import palette
from trirail.wire.vocabulary import Mode

REFUSED = None

# One row a state, one column an event: the next state (None: refused) and the action where there is one.
E = ModeEvent
TABLE: dict[ModeState, dict[ModeEvent, tuple[ModeState, Action] | None]] = {
    DISABLED: {
        E.ENABLE: (ENABLING, Action.POWER_UP),
        E.DISABLE: (DISABLED, Action.NOTHING),
        E.GOAL: REFUSED,
        E.STOP: (DISABLED, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (DISABLED, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (DISABLED, Action.NOTHING),
        E.POWERED: (DISABLED, Action.NOTHING),
        E.STANDSTILL: (DISABLED, Action.NOTHING),
        E.ARRIVED: (DISABLED, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (DISABLED, Action.NOTHING),
        E.LATE: (DISABLED, Action.NOTHING),
        E.SHUTDOWN: (DISABLED, Action.NOTHING),
    },
    ENABLING: {
        E.ENABLE: (ENABLING, Action.NOTHING),
        E.DISABLE: (DISABLED, Action.POWER_DOWN),
        E.GOAL: REFUSED,
        E.STOP: (DISABLED, Action.POWER_DOWN),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (ENABLING, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (ENABLING, Action.NOTHING),
        E.POWERED: (HOLDING, Action.NOTHING),
        E.STANDSTILL: (ENABLING, Action.NOTHING),
        E.ARRIVED: (ENABLING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (DISABLED, Action.POWER_DOWN),
        E.LATE: (DISABLED, Action.POWER_DOWN),
        E.SHUTDOWN: (DISABLED, Action.POWER_DOWN),
    },
    HOMING: {
        E.ENABLE: (HOMING, Action.NOTHING),
        E.DISABLE: (STOPPING_TO_DISABLE, Action.STOP_HOMING),
        E.GOAL: REFUSED,
        E.STOP: (STOPPING, Action.STOP_HOMING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (HOMING, Action.NOTHING),
        E.HOME: (HOMING, Action.NOTHING),
        E.HOMED: (HOLDING, Action.NOTHING),
        E.POWERED: (HOMING, Action.NOTHING),
        E.STANDSTILL: (HOMING, Action.NOTHING),
        E.ARRIVED: (HOMING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING, Action.STOP_HOMING),
        E.LATE: (STOPPING, Action.STOP_HOMING),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.STOP_HOMING),
    },
    HOLDING: {
        E.ENABLE: (HOLDING, Action.NOTHING),
        E.DISABLE: (DISABLED, Action.POWER_DOWN),
        E.GOAL: (MOVING, Action.START),
        E.STOP: (HOLDING, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (HOLDING, Action.NOTHING),
        E.HOME: (HOMING, Action.HOME),
        E.HOMED: (HOLDING, Action.NOTHING),
        E.POWERED: (HOLDING, Action.NOTHING),
        E.STANDSTILL: (HOLDING, Action.NOTHING),
        E.ARRIVED: (HOLDING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (HOLDING, Action.NOTHING),
        E.LATE: (HOLDING, Action.NOTHING),
        E.SHUTDOWN: (DISABLED, Action.POWER_DOWN),
    },
    MOVING: {
        E.ENABLE: (MOVING, Action.NOTHING),
        E.DISABLE: (STOPPING_TO_DISABLE, Action.BRAKE),
        E.GOAL: (MOVING, Action.START),
        E.STOP: (STOPPING, Action.BRAKE),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: (PAUSING, Action.BRAKE),
        E.RESUME: (MOVING, Action.NOTHING),
        E.NOT_RENEWED: (RELEASING, Action.BRAKE),
        E.HOME: REFUSED,
        E.HOMED: (MOVING, Action.NOTHING),
        E.POWERED: (MOVING, Action.NOTHING),
        E.STANDSTILL: (MOVING, Action.NOTHING),
        E.ARRIVED: (HOLDING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING, Action.BRAKE),
        E.LATE: (STOPPING, Action.BRAKE),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.BRAKE),
    },
    STOPPING: {
        E.ENABLE: (STOPPING, Action.NOTHING),
        E.DISABLE: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.GOAL: REFUSED,
        E.STOP: (STOPPING, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (STOPPING, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (STOPPING, Action.NOTHING),
        E.POWERED: (STOPPING, Action.NOTHING),
        E.STANDSTILL: (HOLDING, Action.NOTHING),
        E.ARRIVED: (HOLDING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING, Action.NOTHING),
        E.LATE: (STOPPING, Action.NOTHING),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.NOTHING),
    },
    STOPPING_TO_DISABLE: {
        E.ENABLE: REFUSED,
        E.DISABLE: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.GOAL: REFUSED,
        E.STOP: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.POWERED: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.STANDSTILL: (DISABLED, Action.POWER_DOWN),
        E.ARRIVED: (DISABLED, Action.POWER_DOWN),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.LATE: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.NOTHING),
    },
    PAUSING: {
        E.ENABLE: (PAUSING, Action.NOTHING),
        E.DISABLE: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.GOAL: (MOVING, Action.START),
        E.STOP: (STOPPING, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: (PAUSING, Action.NOTHING),
        E.RESUME: (MOVING, Action.RESUME),
        E.NOT_RENEWED: (PAUSING, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (PAUSING, Action.NOTHING),
        E.POWERED: (PAUSING, Action.NOTHING),
        E.STANDSTILL: (PAUSED, Action.NOTHING),
        E.ARRIVED: (HOLDING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING, Action.NOTHING),
        E.LATE: (STOPPING, Action.NOTHING),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.NOTHING),
    },
    PAUSED: {
        E.ENABLE: (PAUSED, Action.NOTHING),
        E.DISABLE: (DISABLED, Action.POWER_DOWN),
        E.GOAL: (MOVING, Action.START),
        E.STOP: (HOLDING, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: (PAUSED, Action.NOTHING),
        E.RESUME: (MOVING, Action.RESUME),
        E.NOT_RENEWED: (PAUSED, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (PAUSED, Action.NOTHING),
        E.POWERED: (PAUSED, Action.NOTHING),
        E.STANDSTILL: (PAUSED, Action.NOTHING),
        E.ARRIVED: (PAUSED, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (HOLDING, Action.NOTHING),
        E.LATE: (PAUSED, Action.NOTHING),
        E.SHUTDOWN: (DISABLED, Action.POWER_DOWN),
    },
    RELEASING: {
        E.ENABLE: (RELEASING, Action.NOTHING),
        E.DISABLE: (STOPPING_TO_DISABLE, Action.NOTHING),
        E.GOAL: (MOVING, Action.START),
        E.STOP: (STOPPING, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.QUICK_STOP),
        E.RESET: REFUSED,
        E.PAUSE: (RELEASING, Action.NOTHING),
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (RELEASING, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (RELEASING, Action.NOTHING),
        E.POWERED: (RELEASING, Action.NOTHING),
        E.STANDSTILL: (HOLDING, Action.NOTHING),
        E.ARRIVED: (HOLDING, Action.NOTHING),
        E.FAULT: (FAULT, Action.QUICK_STOP),
        E.GATEWAY_LOST: (STOPPING, Action.NOTHING),
        E.LATE: (STOPPING, Action.NOTHING),
        E.SHUTDOWN: (STOPPING_TO_DISABLE, Action.NOTHING),
    },
    FAULT: {
        E.ENABLE: REFUSED,
        E.DISABLE: (FAULT, Action.NOTHING),
        E.GOAL: REFUSED,
        E.STOP: (FAULT, Action.NOTHING),
        E.QUICK_STOP: (FAULT, Action.NOTHING),
        E.RESET: (DISABLED, Action.CLEAR),
        E.PAUSE: REFUSED,
        E.RESUME: REFUSED,
        E.NOT_RENEWED: (FAULT, Action.NOTHING),
        E.HOME: REFUSED,
        E.HOMED: (FAULT, Action.NOTHING),
        E.POWERED: (FAULT, Action.NOTHING),
        E.STANDSTILL: (FAULT, Action.NOTHING),
        E.ARRIVED: (FAULT, Action.NOTHING),
        E.FAULT: (FAULT, Action.NOTHING),
        E.GATEWAY_LOST: (FAULT, Action.NOTHING),
        E.LATE: (FAULT, Action.NOTHING),
        E.SHUTDOWN: (FAULT, Action.NOTHING),
    },
}


def test_the_table_names_every_state_and_event() -> None:
    assert set(TABLE) == set(STATES)
    assert len(set(STATES)) == len(STATES)
    assert all(set(row) == set(ModeEvent) for row in TABLE.values())


@pytest.mark.parametrize("event", ModeEvent)
@pytest.mark.parametrize("state", STATES)
def test_step(state: ModeState, event: ModeEvent) -> None:
    decided = step(state, event)
    wanted = TABLE[state][event]
    if wanted is None:
        assert isinstance(decided, Refusal)
        assert decided.code
        assert decided.message
    else:
        assert decided == Step(*wanted)


def test_every_mode_has_its_colours() -> None:
    assert set(palette.MODES) == set(Mode)
    assert set(terminal.COLOURS) == set(Mode)


@pytest.mark.parametrize("state", STATES)
def test_a_fault_stops_from_everywhere_and_only_reset_leads_out(state: ModeState) -> None:
    assert step(state, ModeEvent.FAULT) in (Step(FAULT, Action.QUICK_STOP), Step(FAULT))
    leaving = {
        event for event in ModeEvent if not isinstance(out := step(FAULT, event), Refusal) and out.state != FAULT
    }
    assert leaving == {ModeEvent.RESET}


def test_only_enable_powers_up() -> None:
    for state in STATES:
        for event in ModeEvent:
            decided = step(state, event)
            if isinstance(decided, Step) and decided.action is Action.POWER_UP:
                assert (state.mode, event) == (Mode.DISABLED, ModeEvent.ENABLE)


@pytest.mark.parametrize("state", STATES)
def test_a_goal_is_under_way_in_motion_and_while_it_is_paused(state: ModeState) -> None:
    assert state.has_goal == (state in (MOVING, PAUSING, PAUSED, RELEASING))
