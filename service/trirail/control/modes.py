"""State machine of the robot's modes. A table without side effects defines the effect of each event in each mode."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

from trirail.errors import RefusalCode
from trirail.wire.vocabulary import Mode


class ModeEvent(Enum):
    """Event of the state machine: a request, a report about the motion or the drives, or a failure."""

    ENABLE = auto()
    DISABLE = auto()
    GOAL = auto()
    STOP = auto()
    QUICK_STOP = auto()
    RESET = auto()
    PAUSE = auto()
    RESUME = auto()
    NOT_RENEWED = auto()  # the client did not renew its jog or track in time
    INPUT_EDGE = auto()  # the digital input that ends the current goal has switched
    HOME = auto()
    POWERED = auto()  # all drives have reached the state "operation enabled"
    HOMED = auto()  # all drives know their positions and follow setpoints again after homing
    STANDSTILL = auto()  # the commanded motion is at rest
    ARRIVED = auto()  # the commanded motion is at rest at the end of its path
    FAULT = auto()  # a drive, the bus or a setpoint is faulty
    GATEWAY_LOST = auto()
    LATE = auto()  # too many ticks were missed in a row
    SHUTDOWN = auto()


class Action(Enum):
    """Action that the loop executes in the cycle in which the state changes."""

    NOTHING = auto()
    POWER_UP = auto()
    POWER_DOWN = auto()
    START = auto()
    BRAKE = auto()
    RESUME = auto()
    QUICK_STOP = auto()
    CLEAR = auto()
    HOME = auto()
    STOP_HOMING = auto()


class ModeState(NamedTuple):
    """Mode of the robot, with flags for the next change once the robot is at rest.

    If `disable_after` is set, the drives are disabled. If `paused` is set, the goal remains available for a resume. If
    `released` is set, the goal ends: a jog or track that was not renewed, or a goal that an input has stopped.
    """

    mode: Mode
    disable_after: bool = False
    paused: bool = False
    released: bool = False

    @property
    def has_goal(self) -> bool:
        """Whether the robot can have an active goal in this state."""
        return self.mode is Mode.MOVING or self.paused or self.released


class Step(NamedTuple):
    """Transition to a state, with the action that belongs to the transition."""

    state: ModeState
    action: Action = Action.NOTHING


class Refusal(NamedTuple):
    """Refusal of an event that is not allowed in a mode. The state does not change."""

    code: RefusalCode
    message: str


DISABLED = ModeState(Mode.DISABLED)
ENABLING = ModeState(Mode.ENABLING)
HOMING = ModeState(Mode.HOMING)
HOLDING = ModeState(Mode.HOLDING)
MOVING = ModeState(Mode.MOVING)
STOPPING = ModeState(Mode.STOPPING)
STOPPING_TO_DISABLE = ModeState(Mode.STOPPING, disable_after=True)
PAUSING = ModeState(Mode.STOPPING, paused=True)
PAUSED = ModeState(Mode.HOLDING, paused=True)
RELEASING = ModeState(Mode.STOPPING, released=True)
FAULT = ModeState(Mode.FAULT)

_NO_FAULT = Refusal(RefusalCode.NO_FAULT, "there is no fault to reset")
_DISABLED = Refusal(RefusalCode.NOT_ENABLED, "the robot is disabled: send enable first")
_ENABLING = Refusal(
    RefusalCode.NOT_ENABLED, "the drives are still powering up: repeat the request when the mode is holding"
)
_HOMING = Refusal(RefusalCode.HOMING, "the robot is homing: repeat the request when the mode is holding")
_MOVING = Refusal(RefusalCode.MOVING, "the robot is moving: send stop, then home")
_PAUSED = Refusal(RefusalCode.MOVING, "a goal is paused: send stop, then home")
_STOPPING = Refusal(RefusalCode.STOPPING, "the robot is stopping: repeat the request when the mode is holding")
_DISABLING = Refusal(
    RefusalCode.STOPPING, "the robot is stopping and will then be disabled: send enable when the mode is disabled"
)
_FAULT = Refusal(RefusalCode.FAULT, "the robot is in fault: remove the cause, then send reset and enable")

_NO_GOAL = Refusal(RefusalCode.NO_GOAL, "no goal is in progress")
_NOT_PAUSED = Refusal(RefusalCode.NOT_PAUSED, "there is no paused goal to resume")

_POWER_OFF = Step(DISABLED, Action.POWER_DOWN)
_TRIP = Step(FAULT, Action.QUICK_STOP)

_IN_ALL_MODES: dict[ModeEvent, Step | Refusal] = {
    ModeEvent.RESET: _NO_FAULT,
    ModeEvent.QUICK_STOP: _TRIP,
    ModeEvent.FAULT: _TRIP,
}
_WITHOUT_GOAL = _IN_ALL_MODES | {ModeEvent.PAUSE: _NO_GOAL, ModeEvent.RESUME: _NOT_PAUSED}

_TABLE: dict[ModeState, dict[ModeEvent, Step | Refusal]] = {
    DISABLED: _WITHOUT_GOAL
    | {
        ModeEvent.ENABLE: Step(ENABLING, Action.POWER_UP),
        ModeEvent.GOAL: _DISABLED,
        ModeEvent.HOME: _DISABLED,
    },
    ENABLING: _WITHOUT_GOAL
    | {
        ModeEvent.DISABLE: _POWER_OFF,
        ModeEvent.GOAL: _ENABLING,
        ModeEvent.STOP: _POWER_OFF,
        ModeEvent.HOME: _ENABLING,
        ModeEvent.POWERED: Step(HOLDING),
        ModeEvent.GATEWAY_LOST: _POWER_OFF,
        ModeEvent.LATE: _POWER_OFF,
        ModeEvent.SHUTDOWN: _POWER_OFF,
    },
    HOMING: _WITHOUT_GOAL
    | {
        ModeEvent.DISABLE: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING),
        ModeEvent.GOAL: _HOMING,
        ModeEvent.STOP: Step(STOPPING, Action.STOP_HOMING),
        ModeEvent.HOMED: Step(HOLDING),
        ModeEvent.GATEWAY_LOST: Step(STOPPING, Action.STOP_HOMING),
        ModeEvent.LATE: Step(STOPPING, Action.STOP_HOMING),
        ModeEvent.SHUTDOWN: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING),
    },
    HOLDING: _WITHOUT_GOAL
    | {
        ModeEvent.DISABLE: _POWER_OFF,
        ModeEvent.GOAL: Step(MOVING, Action.START),
        ModeEvent.HOME: Step(HOMING, Action.HOME),
        ModeEvent.SHUTDOWN: _POWER_OFF,
    },
    MOVING: _IN_ALL_MODES
    | {
        ModeEvent.DISABLE: Step(STOPPING_TO_DISABLE, Action.BRAKE),
        ModeEvent.GOAL: Step(MOVING, Action.START),
        ModeEvent.STOP: Step(STOPPING, Action.BRAKE),
        ModeEvent.PAUSE: Step(PAUSING, Action.BRAKE),
        ModeEvent.NOT_RENEWED: Step(RELEASING, Action.BRAKE),
        ModeEvent.INPUT_EDGE: Step(RELEASING, Action.BRAKE),
        ModeEvent.HOME: _MOVING,
        ModeEvent.ARRIVED: Step(HOLDING),
        ModeEvent.GATEWAY_LOST: Step(STOPPING, Action.BRAKE),
        ModeEvent.LATE: Step(STOPPING, Action.BRAKE),
        ModeEvent.SHUTDOWN: Step(STOPPING_TO_DISABLE, Action.BRAKE),
    },
    STOPPING: _WITHOUT_GOAL
    | {
        ModeEvent.DISABLE: Step(STOPPING_TO_DISABLE),
        ModeEvent.GOAL: _STOPPING,
        ModeEvent.HOME: _STOPPING,
        ModeEvent.STANDSTILL: Step(HOLDING),
        ModeEvent.ARRIVED: Step(HOLDING),
        ModeEvent.SHUTDOWN: Step(STOPPING_TO_DISABLE),
    },
    STOPPING_TO_DISABLE: _WITHOUT_GOAL
    | {
        ModeEvent.ENABLE: _DISABLING,
        ModeEvent.GOAL: _DISABLING,
        ModeEvent.HOME: _DISABLING,
        ModeEvent.STANDSTILL: _POWER_OFF,
        ModeEvent.ARRIVED: _POWER_OFF,
    },
    PAUSING: _IN_ALL_MODES
    | {
        ModeEvent.DISABLE: Step(STOPPING_TO_DISABLE, Action.BRAKE),
        ModeEvent.GOAL: Step(MOVING, Action.START),
        ModeEvent.STOP: Step(STOPPING, Action.BRAKE),
        ModeEvent.RESUME: Step(MOVING, Action.RESUME),
        ModeEvent.INPUT_EDGE: Step(RELEASING, Action.BRAKE),
        ModeEvent.HOME: _PAUSED,
        ModeEvent.STANDSTILL: Step(PAUSED),
        ModeEvent.ARRIVED: Step(HOLDING),
        ModeEvent.GATEWAY_LOST: Step(STOPPING, Action.BRAKE),
        ModeEvent.LATE: Step(STOPPING, Action.BRAKE),
        ModeEvent.SHUTDOWN: Step(STOPPING_TO_DISABLE, Action.BRAKE),
    },
    PAUSED: _IN_ALL_MODES
    | {
        ModeEvent.DISABLE: _POWER_OFF,
        ModeEvent.GOAL: Step(MOVING, Action.START),
        ModeEvent.STOP: Step(HOLDING),
        ModeEvent.RESUME: Step(MOVING, Action.RESUME),
        ModeEvent.INPUT_EDGE: Step(HOLDING),
        ModeEvent.ARRIVED: Step(HOLDING),
        ModeEvent.HOME: _PAUSED,
        ModeEvent.GATEWAY_LOST: Step(HOLDING),
        ModeEvent.SHUTDOWN: _POWER_OFF,
    },
    RELEASING: _IN_ALL_MODES
    | {
        ModeEvent.DISABLE: Step(STOPPING_TO_DISABLE),
        ModeEvent.GOAL: Step(MOVING, Action.START),
        ModeEvent.STOP: Step(STOPPING),
        ModeEvent.RESUME: _NOT_PAUSED,
        ModeEvent.HOME: _STOPPING,
        ModeEvent.STANDSTILL: Step(HOLDING),
        ModeEvent.ARRIVED: Step(HOLDING),
        ModeEvent.GATEWAY_LOST: Step(STOPPING),
        ModeEvent.LATE: Step(STOPPING),
        ModeEvent.SHUTDOWN: Step(STOPPING_TO_DISABLE),
    },
    FAULT: {
        ModeEvent.ENABLE: _FAULT,
        ModeEvent.GOAL: _FAULT,
        ModeEvent.PAUSE: _FAULT,
        ModeEvent.RESUME: _FAULT,
        ModeEvent.HOME: _FAULT,
        ModeEvent.RESET: Step(DISABLED, Action.CLEAR),
    },
}
STATES = tuple(_TABLE)


def step(state: ModeState, event: ModeEvent) -> Step | Refusal:
    """Return the effect of `event` in `state`. An event without an entry in the table changes nothing.

    A request that would change nothing is confirmed, not refused. An example is a stop while the robot is at rest. The
    mode FAULT lasts until a reset, after which the robot is disabled.
    """
    return _TABLE[state].get(event, Step(state))
