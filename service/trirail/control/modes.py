"""The modes of the service as a pure state machine: what each event does in each mode."""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

from trirail.wire.vocabulary import Mode


class Event(Enum):
    """What can happen: requests, what the motion and the drives report, and what goes wrong."""

    ENABLE = auto()
    DISABLE = auto()
    GOAL = auto()
    STOP = auto()
    QUICK_STOP = auto()
    RESET = auto()
    PAUSE = auto()
    RESUME = auto()
    RELEASE = auto()  # nobody keeps the jog alive any more
    HOME = auto()
    POWERED = auto()  # all drives reached operation enabled
    HOMED = auto()  # all drives know where they are, and follow setpoints again
    STANDSTILL = auto()  # the commanded motion has come to rest
    ARRIVED = auto()  # so it has, and at the end of its path
    FAULT = auto()  # a drive, the bus or a setpoint is bad
    GATEWAY_LOST = auto()
    LATE = auto()  # too many ticks missed in a row
    SHUTDOWN = auto()


class Action(Enum):
    """What the loop does on the way from one state to the next, in the same cycle."""

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


class State(NamedTuple):
    """A mode, and what is to come once the robot stands: its drives disabled, the same goal again, or a jog's end."""

    mode: Mode
    disable_after: bool = False
    paused: bool = False
    released: bool = False

    @property
    def has_goal(self) -> bool:
        """Whether a goal can be under way."""
        return self.mode is Mode.MOVING or self.paused or self.released


class Step(NamedTuple):
    """The next state, and what to do on the way."""

    state: State
    action: Action = Action.NOTHING


class Refusal(NamedTuple):
    """The event makes no sense in this mode: the state stays."""

    code: str
    message: str


DISABLED = State(Mode.DISABLED)
ENABLING = State(Mode.ENABLING)
HOMING = State(Mode.HOMING)
HOLDING = State(Mode.HOLDING)
MOVING = State(Mode.MOVING)
STOPPING = State(Mode.STOPPING)
STOPPING_TO_DISABLE = State(Mode.STOPPING, disable_after=True)
PAUSING = State(Mode.STOPPING, paused=True)
PAUSED = State(Mode.HOLDING, paused=True)
RELEASING = State(Mode.STOPPING, released=True)
FAULT = State(Mode.FAULT)

STATES = (
    DISABLED,
    ENABLING,
    HOMING,
    HOLDING,
    MOVING,
    STOPPING,
    STOPPING_TO_DISABLE,
    PAUSING,
    PAUSED,
    RELEASING,
    FAULT,
)

_NO_FAULT = Refusal("no_fault", "there is no fault to reset")
_DISABLED = Refusal("not_enabled", "the robot is disabled: send enable first")
_ENABLING = Refusal("not_enabled", "the drives are still powering up: send it again when the mode is holding")
_HOMING = Refusal("homing", "the robot is homing: send the goal when the mode is holding")
_MOVING = Refusal("moving", "the robot is moving: send stop, then home")
_PAUSED = Refusal("moving", "a goal is paused: send stop, then home")
_STOPPING = Refusal("stopping", "the robot is stopping: send it again when the mode is holding")
_DISABLING = Refusal("stopping", "the robot is stopping to be disabled: send enable when the mode is disabled")
_FAULT = Refusal("fault", "the robot is in fault: remove the cause, then send reset and enable")

_NO_GOAL = Refusal("no_goal", "there is no goal under way")
_NOT_PAUSED = Refusal("not_paused", "there is no paused goal to resume")

_POWER_OFF = Step(DISABLED, Action.POWER_DOWN)
_TRIP = Step(FAULT, Action.QUICK_STOP)

_TABLE: dict[State, dict[Event, Step | Refusal]] = {
    DISABLED: {
        Event.ENABLE: Step(ENABLING, Action.POWER_UP),
        Event.GOAL: _DISABLED,
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.HOME: _DISABLED,
        Event.RESET: _NO_FAULT,
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    ENABLING: {
        Event.DISABLE: _POWER_OFF,
        Event.GOAL: _ENABLING,
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.STOP: _POWER_OFF,
        Event.HOME: _ENABLING,
        Event.RESET: _NO_FAULT,
        Event.POWERED: Step(HOLDING),
        Event.GATEWAY_LOST: _POWER_OFF,
        Event.LATE: _POWER_OFF,
        Event.SHUTDOWN: _POWER_OFF,
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    HOMING: {
        Event.DISABLE: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING),
        Event.GOAL: _HOMING,
        Event.STOP: Step(STOPPING, Action.STOP_HOMING),
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.RESET: _NO_FAULT,
        Event.HOMED: Step(HOLDING),
        Event.GATEWAY_LOST: Step(STOPPING, Action.STOP_HOMING),
        Event.LATE: Step(STOPPING, Action.STOP_HOMING),
        Event.SHUTDOWN: Step(STOPPING_TO_DISABLE, Action.STOP_HOMING),
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    HOLDING: {
        Event.DISABLE: _POWER_OFF,
        Event.GOAL: Step(MOVING, Action.START),
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.HOME: Step(HOMING, Action.HOME),
        Event.RESET: _NO_FAULT,
        Event.SHUTDOWN: _POWER_OFF,
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    MOVING: {
        Event.DISABLE: Step(STOPPING_TO_DISABLE, Action.BRAKE),
        Event.GOAL: Step(MOVING, Action.START),
        Event.STOP: Step(STOPPING, Action.BRAKE),
        Event.PAUSE: Step(PAUSING, Action.BRAKE),
        Event.RELEASE: Step(RELEASING, Action.BRAKE),
        Event.HOME: _MOVING,
        Event.RESET: _NO_FAULT,
        Event.ARRIVED: Step(HOLDING),
        Event.GATEWAY_LOST: Step(STOPPING, Action.BRAKE),
        Event.LATE: Step(STOPPING, Action.BRAKE),
        Event.SHUTDOWN: Step(STOPPING_TO_DISABLE, Action.BRAKE),
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    STOPPING: {
        Event.DISABLE: Step(STOPPING_TO_DISABLE),
        Event.GOAL: _STOPPING,
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.HOME: _STOPPING,
        Event.RESET: _NO_FAULT,
        Event.STANDSTILL: Step(HOLDING),
        Event.ARRIVED: Step(HOLDING),
        Event.SHUTDOWN: Step(STOPPING_TO_DISABLE),
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    STOPPING_TO_DISABLE: {
        Event.ENABLE: _DISABLING,
        Event.GOAL: _DISABLING,
        Event.PAUSE: _NO_GOAL,
        Event.RESUME: _NOT_PAUSED,
        Event.HOME: _DISABLING,
        Event.RESET: _NO_FAULT,
        Event.STANDSTILL: _POWER_OFF,
        Event.ARRIVED: _POWER_OFF,
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    PAUSING: {
        Event.DISABLE: Step(STOPPING_TO_DISABLE),
        Event.GOAL: Step(MOVING, Action.START),
        Event.STOP: Step(STOPPING),
        Event.RESUME: Step(MOVING, Action.RESUME),
        Event.HOME: _PAUSED,
        Event.RESET: _NO_FAULT,
        Event.STANDSTILL: Step(PAUSED),
        Event.ARRIVED: Step(HOLDING),
        Event.GATEWAY_LOST: Step(STOPPING),
        Event.LATE: Step(STOPPING),
        Event.SHUTDOWN: Step(STOPPING_TO_DISABLE),
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    PAUSED: {
        Event.DISABLE: _POWER_OFF,
        Event.GOAL: Step(MOVING, Action.START),
        Event.STOP: Step(HOLDING),
        Event.RESUME: Step(MOVING, Action.RESUME),
        Event.HOME: _PAUSED,
        Event.RESET: _NO_FAULT,
        Event.GATEWAY_LOST: Step(HOLDING),
        Event.SHUTDOWN: _POWER_OFF,
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    RELEASING: {
        Event.DISABLE: Step(STOPPING_TO_DISABLE),
        Event.GOAL: Step(MOVING, Action.START),
        Event.STOP: Step(STOPPING),
        Event.RESUME: _NOT_PAUSED,
        Event.HOME: _STOPPING,
        Event.RESET: _NO_FAULT,
        Event.STANDSTILL: Step(HOLDING),
        Event.ARRIVED: Step(HOLDING),
        Event.GATEWAY_LOST: Step(STOPPING),
        Event.LATE: Step(STOPPING),
        Event.SHUTDOWN: Step(STOPPING_TO_DISABLE),
        Event.QUICK_STOP: _TRIP,
        Event.FAULT: _TRIP,
    },
    FAULT: {
        Event.ENABLE: _FAULT,
        Event.GOAL: _FAULT,
        Event.PAUSE: _FAULT,
        Event.RESUME: _FAULT,
        Event.HOME: _FAULT,
        Event.RESET: Step(DISABLED, Action.CLEAR),
    },
}


def step(state: State, event: Event) -> Step | Refusal:
    """Decide what `event` does in `state`; what is not in the table changes nothing.

    What is already so is confirmed, not refused: enabling an enabled robot, stopping one that stands. The first
    fault is the one that stays: neither a second one nor anything but a reset leads out of it, and a reset never
    leads further than to disabled.
    """
    return _TABLE[state].get(event, Step(state))
