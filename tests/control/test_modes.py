"""The rules of the modes, each over every state: together they say what every event does in every state."""

from __future__ import annotations

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
from trirail.errors import RefusalCode
from trirail.telemetry import palette
from trirail.wire.vocabulary import Mode

E = ModeEvent
Outcome = Step | RefusalCode
COMES_TO_REST = {STOPPING: HOLDING, STOPPING_TO_DISABLE: DISABLED, PAUSING: PAUSED, RELEASING: HOLDING}
"""Each state that brakes, and what comes of it."""


def outcome(state: ModeState, event: ModeEvent) -> Outcome:
    """What comes of an event: a step, or why it is refused."""
    decided = step(state, event)
    if isinstance(decided, Refusal):
        assert decided.message
        return decided.code
    return decided


def assert_rule(event: ModeEvent, *changes: dict[ModeState, Outcome]) -> None:
    """The event does this in these states, each of which is named once, and nothing in all others."""
    stated = {state: comes for rule in changes for state, comes in rule.items()}
    assert len(stated) == sum(map(len, changes))
    for state in STATES:
        assert outcome(state, event) == stated.get(state, Step(state)), (event, state)


def each(states: tuple[ModeState, ...] | set[ModeState], comes: Outcome) -> dict[ModeState, Outcome]:
    return dict.fromkeys(states, comes)


def test_a_state_is_one_of_a_kind_and_every_mode_has_its_colours() -> None:
    assert len(set(STATES)) == len(STATES)
    assert {state.mode for state in STATES} == set(Mode) == set(palette.MODES) == set(terminal.COLOURS)


def test_a_goal_is_under_way_in_motion_and_while_it_is_paused_or_its_jog_ends() -> None:
    assert {state for state in STATES if state.has_goal} == {MOVING, PAUSING, PAUSED, RELEASING}


def test_a_fault_stops_from_everywhere_and_the_first_one_stays() -> None:
    for event in (E.FAULT, E.QUICK_STOP):
        assert_rule(event, each(set(STATES) - {FAULT}, Step(FAULT, Action.QUICK_STOP)))


def test_only_a_reset_leads_out_of_a_fault_and_no_further_than_to_disabled() -> None:
    assert_rule(E.RESET, each(set(STATES) - {FAULT}, RefusalCode.NO_FAULT), {FAULT: Step(DISABLED, Action.CLEAR)})
    for event in set(ModeEvent) - {E.RESET}:
        asks = event in {E.ENABLE, E.GOAL, E.PAUSE, E.RESUME, E.HOME}
        assert outcome(FAULT, event) == (RefusalCode.FAULT if asks else Step(FAULT))


def test_nothing_but_enable_gives_power_and_it_is_confirmed_where_there_is_some() -> None:
    powers_up: dict[ModeState, Outcome] = {DISABLED: Step(ENABLING, Action.POWER_UP)}
    assert_rule(E.ENABLE, powers_up, {STOPPING_TO_DISABLE: RefusalCode.STOPPING, FAULT: RefusalCode.FAULT})
    for event in set(ModeEvent) - {E.ENABLE, E.FAULT, E.QUICK_STOP}:
        assert outcome(DISABLED, event) == Step(DISABLED) or isinstance(outcome(DISABLED, event), RefusalCode)


def test_power_goes_at_once_from_a_robot_that_stands_and_from_a_moving_one_when_it_does() -> None:
    for event in (E.DISABLE, E.SHUTDOWN):
        assert_rule(
            event,
            each((ENABLING, HOLDING, PAUSED), Step(DISABLED, Action.POWER_DOWN)),
            {MOVING: Step(STOPPING_TO_DISABLE, Action.BRAKE), HOMING: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING)},
            each((STOPPING, PAUSING, RELEASING), Step(STOPPING_TO_DISABLE)),
        )


def test_a_stop_ends_what_is_under_way_and_so_do_a_lost_gateway_and_lateness() -> None:
    in_motion: dict[ModeState, Outcome] = {
        ENABLING: Step(DISABLED, Action.POWER_DOWN),
        MOVING: Step(STOPPING, Action.BRAKE),
        HOMING: Step(STOPPING, Action.STOP_HOMING),
        PAUSING: Step(STOPPING),
        RELEASING: Step(STOPPING),
    }
    for event in (E.STOP, E.GATEWAY_LOST):
        assert_rule(event, in_motion, {PAUSED: Step(HOLDING)})
    assert_rule(E.LATE, in_motion)


def test_at_standstill_comes_what_the_stop_was_for() -> None:
    comes: dict[ModeState, Outcome] = {state: Step(then) for state, then in COMES_TO_REST.items()}
    comes[STOPPING_TO_DISABLE] = Step(DISABLED, Action.POWER_DOWN)
    assert_rule(E.STANDSTILL, comes)
    assert_rule(E.ARRIVED, comes | {PAUSING: Step(HOLDING), MOVING: Step(HOLDING)})  # nothing is left to be resumed


def test_a_goal_begins_where_the_robot_holds_moves_or_brakes_for_something_that_can_be_replaced() -> None:
    assert_rule(
        E.GOAL,
        each((HOLDING, MOVING, PAUSING, PAUSED, RELEASING), Step(MOVING, Action.START)),
        each((DISABLED, ENABLING), RefusalCode.NOT_ENABLED),
        each((STOPPING, STOPPING_TO_DISABLE), RefusalCode.STOPPING),
        {HOMING: RefusalCode.HOMING, FAULT: RefusalCode.FAULT},
    )


def test_a_goal_under_way_is_paused_and_resumed_and_a_jog_that_nobody_renews_ends() -> None:
    without = {state for state in STATES if not state.has_goal} - {FAULT}
    fault: dict[ModeState, Outcome] = {FAULT: RefusalCode.FAULT}
    assert_rule(E.PAUSE, {MOVING: Step(PAUSING, Action.BRAKE)}, each(without, RefusalCode.NO_GOAL), fault)
    resumed = each((PAUSING, PAUSED), Step(MOVING, Action.RESUME))
    assert_rule(E.RESUME, resumed, each(without | {RELEASING}, RefusalCode.NOT_PAUSED), fault)
    assert_rule(E.NOT_RENEWED, {MOVING: Step(RELEASING, Action.BRAKE)})


def test_homing_begins_where_the_robot_holds() -> None:
    assert_rule(
        E.HOME,
        {HOLDING: Step(HOMING, Action.HOME), FAULT: RefusalCode.FAULT},
        each((DISABLED, ENABLING), RefusalCode.NOT_ENABLED),
        each((MOVING, PAUSING, PAUSED), RefusalCode.MOVING),
        each((STOPPING, STOPPING_TO_DISABLE, RELEASING), RefusalCode.STOPPING),
    )


def test_what_the_drives_report_ends_what_waits_for_it() -> None:
    assert_rule(E.POWERED, {ENABLING: Step(HOLDING)})
    assert_rule(E.HOMED, {HOMING: Step(HOLDING)})
