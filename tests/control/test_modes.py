"""The rules of the modes: what each event does, and that it does nothing in all states that its rule does not name."""

from __future__ import annotations

from typing import NamedTuple

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
from trirail.errors import RefusalCode
from trirail.telemetry import palette
from trirail.wire.vocabulary import Mode

E = ModeEvent
Changes = dict[ModeState, Step | RefusalCode]
ALL = set(STATES)
UNDER_WAY = {MOVING, PAUSING, PAUSED, RELEASING}
"""The states in which there is a goal."""


class Rule(NamedTuple):
    """What events do, in the states that are named; they are confirmed in all others, and change nothing."""

    says: str
    events: set[ModeEvent]
    changes: Changes


def each(states: set[ModeState], comes: Step | RefusalCode) -> Changes:
    return dict.fromkeys(states, comes)


ENDED: Changes = {
    ENABLING: Step(DISABLED, Action.POWER_DOWN),
    **each({MOVING, PAUSING}, Step(STOPPING, Action.BRAKE)),
    HOMING: Step(STOPPING, Action.STOP_HOMING),
    RELEASING: Step(STOPPING),
}
"""What is under way is ended by a stop that leaves the power on."""
AT_REST: Changes = {
    **each({STOPPING, RELEASING}, Step(HOLDING)),
    STOPPING_TO_DISABLE: Step(DISABLED, Action.POWER_DOWN),
    PAUSING: Step(PAUSED),
}
"""At standstill comes what the stop was for."""
IN_FAULT: Changes = {FAULT: RefusalCode.FAULT}
UNPOWERED = each({DISABLED, ENABLING}, RefusalCode.NOT_ENABLED)

RULES = [
    Rule(
        "a fault stops from everywhere and the first one stays",
        {E.FAULT, E.QUICK_STOP},
        each(ALL - {FAULT}, Step(FAULT, Action.QUICK_STOP)),
    ),
    Rule(
        "a reset leads out of a fault, no further than to disabled",
        {E.RESET},
        each(ALL - {FAULT}, RefusalCode.NO_FAULT) | {FAULT: Step(DISABLED, Action.CLEAR)},
    ),
    Rule(
        "enable gives power, but not while it is being taken",
        {E.ENABLE},
        IN_FAULT | {DISABLED: Step(ENABLING, Action.POWER_UP), STOPPING_TO_DISABLE: RefusalCode.STOPPING},
    ),
    Rule(
        "power is taken at once where the robot stands, else when it does",
        {E.DISABLE, E.SHUTDOWN},
        {
            **each({ENABLING, HOLDING, PAUSED}, Step(DISABLED, Action.POWER_DOWN)),
            **each({MOVING, PAUSING}, Step(STOPPING_TO_DISABLE, Action.BRAKE)),
            HOMING: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING),
            **each({STOPPING, RELEASING}, Step(STOPPING_TO_DISABLE)),
        },
    ),
    Rule("a stop and a lost gateway end all", {E.STOP, E.GATEWAY_LOST}, ENDED | {PAUSED: Step(HOLDING)}),
    Rule("lateness ends what moves", {E.LATE}, ENDED),
    Rule("what brakes comes to rest", {E.STANDSTILL}, AT_REST),
    Rule("at the end nothing is left to resume", {E.ARRIVED}, AT_REST | each({PAUSING, PAUSED, MOVING}, Step(HOLDING))),
    Rule(
        "a goal begins where the robot holds, or in the place of another",
        {E.GOAL},
        {
            **each(UNDER_WAY | {HOLDING}, Step(MOVING, Action.START)),
            **each({STOPPING, STOPPING_TO_DISABLE}, RefusalCode.STOPPING),
            **UNPOWERED,
            HOMING: RefusalCode.HOMING,
            **IN_FAULT,
        },
    ),
    Rule(
        "a goal under way is paused",
        {E.PAUSE},
        each(ALL - UNDER_WAY, RefusalCode.NO_GOAL) | {MOVING: Step(PAUSING, Action.BRAKE)} | IN_FAULT,
    ),
    Rule(
        "a paused goal is resumed",
        {E.RESUME},
        each(ALL - {MOVING}, RefusalCode.NOT_PAUSED) | each({PAUSING, PAUSED}, Step(MOVING, Action.RESUME)) | IN_FAULT,
    ),
    Rule("a jog that nobody renews ends", {E.NOT_RENEWED}, {MOVING: Step(RELEASING, Action.BRAKE)}),
    Rule(
        "an edge ends its goal, also a paused one",
        {E.INPUT_EDGE},
        {MOVING: Step(RELEASING, Action.BRAKE), PAUSING: Step(RELEASING, Action.BRAKE), PAUSED: Step(HOLDING)},
    ),
    Rule(
        "homing begins where the robot holds",
        {E.HOME},
        {
            HOLDING: Step(HOMING, Action.HOME),
            **each({MOVING, PAUSING, PAUSED}, RefusalCode.MOVING),
            **each({STOPPING, STOPPING_TO_DISABLE, RELEASING}, RefusalCode.STOPPING),
            **UNPOWERED,
            **IN_FAULT,
        },
    ),
    Rule("powered drives hold", {E.POWERED}, {ENABLING: Step(HOLDING)}),
    Rule("homed drives hold", {E.HOMED}, {HOMING: Step(HOLDING)}),
]


def outcome(state: ModeState, event: ModeEvent) -> Step | RefusalCode:
    """What comes of an event: a step, or why it is refused."""
    decided = step(state, event)
    if isinstance(decided, Refusal):
        assert decided.message
        return decided.code
    return decided


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.says)
def test_rule(rule: Rule) -> None:
    for event in rule.events:
        assert {state: outcome(state, event) for state in STATES} == {s: Step(s) for s in STATES} | rule.changes


def test_every_event_has_its_rule_and_a_state_is_one_of_a_kind() -> None:
    assert {event for rule in RULES for event in rule.events} == set(ModeEvent)
    assert len(ALL) == len(STATES)


def test_every_mode_has_a_state_and_its_colours() -> None:
    assert {state.mode for state in STATES} == set(Mode) == set(palette.MODES) == set(terminal.COLOURS)


def test_a_goal_is_under_way_in_motion_and_while_it_is_paused_or_its_jog_ends() -> None:
    assert {state for state in STATES if state.has_goal} == UNDER_WAY


def test_only_enable_leaves_disabled_and_only_a_reset_leaves_a_fault() -> None:
    for state, leaves in ((DISABLED, {E.ENABLE, E.FAULT, E.QUICK_STOP}), (FAULT, {E.RESET})):
        comes = {event: outcome(state, event) for event in ModeEvent}
        assert {event for event, step in comes.items() if isinstance(step, Step) and step != Step(state)} == leaves
