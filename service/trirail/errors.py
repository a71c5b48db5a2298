"""Errors of the service.

All errors derive from TrirailError. Their messages name the object, its value, the limit and the remedy.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Self

from trirail_drivers.errors import TrirailError

__all__ = [
    "AlignmentError",
    "AlignmentFault",
    "ConfigError",
    "EmptyRecordingError",
    "KinematicsError",
    "RefusalCode",
    "RefusedError",
    "ServiceError",
    "TrirailError",
    "WaitTimeoutError",
]


class ConfigError(TrirailError):
    """A configuration file is invalid; the message names the file, the key, its value and the allowed values."""


class ServiceError(TrirailError):
    """The service cannot start or cannot be reached."""


class WaitTimeoutError(TrirailError, TimeoutError):
    """A goal did not end, or a picture did not arrive, within the caller's time-out; the goal continues."""


class EmptyRecordingError(ServiceError):
    """A recording contains no cycle: its service ended before the first one was recorded."""


class KinematicsError(TrirailError, ValueError):
    """A pose or a set of slider positions is unreachable or singular; the message names the leg, value and limit.

    `leg` is "A", "B", "C", or "" if no single leg is at fault; `value` and `limit` are in metres or radians.
    """

    def __init__(self, message: str, *, leg: str = "", value: float | None = None, limit: float | None = None) -> None:
        super().__init__(message)
        self.leg = leg
        self.value = value
        self.limit = limit


class AlignmentFault(StrEnum):
    """Reason why the marks do not determine the pose of a part."""

    MISSING = "missing"
    """Too few marks were found, or the calibration does not contain one of them."""
    DISTANCE = "distance"
    """The distance between two marks is wrong: the part is a different one, the calibration is wrong, or heat expanded
    the part."""
    SWAPPED = "swapped"
    """The names of two marks are swapped."""
    STILL = "still"
    """The marks do not move with the stage."""
    MOVES = "moves"
    """The calibration has too few moves, or all of them are in one direction."""


class AlignmentError(TrirailError):
    """The marks do not determine the pose of a part; no correction is sent.

    `fault` is the reason in a form for programs. `value` and `limit` are in the unit of that fault, and None if the
    fault has no limit.
    """

    def __init__(
        self, fault: AlignmentFault, message: str, *, value: float | None = None, limit: float | None = None
    ) -> None:
        super().__init__(message)
        self.fault = fault
        self.value = value
        self.limit = limit


class RefusalCode(StrEnum):
    """Reason why a goal or command was refused or not carried out; the message gives the details for people."""

    meaning: str
    """Meaning of the code, in one line."""
    remedy: str
    """Next step for the sender."""

    # The message.
    MALFORMED = (
        "malformed",
        "the message is not valid: a field is missing, unknown or has an impossible value",
        "send what the schema allows",
    )
    TOO_LARGE = "too_large", "exceeds the maximum size", "send a smaller message"
    UNKNOWN_ENCODING = "unknown_encoding", "neither JSON nor msgpack", "state the encoding, or omit it for JSON"
    UNKNOWN_KEY = (
        "unknown_key",
        "not a key of the table; Zenoh does not deliver it, so a query on it ends without a reply",
        "use a key of the table",
    )
    WILDCARD = "wildcard", "a key for more than one robot or user", "name one robot and one user"
    BAD_NAME = (
        "bad_name",
        "characters other than letters, digits, - and _ in the name, or a pose named as a quantity: 5mm",
        "use another name",
    )
    UNKNOWN_COMMAND = "unknown_command", "unknown command", "send one of the commands in the message"
    DUPLICATE_ID = "duplicate_id", "the goal's id has already been used", "give every goal its own id, or none"
    UNKNOWN_FRAME = "unknown_frame", "no tool or frame of that name in [frames]", "use a name that info lists"
    UNKNOWN_POSE = "unknown_pose", "no pose of that name", "use a name that poses lists, or teach the pose"
    CONFIGURED_POSE = (
        "configured_pose",
        "a pose of [poses] in the configuration cannot be taught or removed",
        "choose another name, or change the configuration",
    )

    # The sender.
    NOT_ALLOWED = (
        "not_allowed",
        "the role of the user does not allow the request",
        "ask for another role in [zenoh.users] of the robot's configuration",
    )

    LEASED = "leased", "another user holds the lease", "wait until it is free, or take it over"
    NO_LEASE = (
        "no_lease",
        "no user holds the lease: there is no lease to release, or this robot requires a lease for motion",
        "send acquire",
    )
    LEASE_OVER = "lease_over", "the lease was released, taken over, or not renewed in time", "acquire a new lease"

    # The robot's mode.
    NOT_ENABLED = "not_enabled", "the drives have no power yet", "send enable, and wait until the mode is holding"
    NOT_HOMED = "not_homed", "the positions of the sliders are unknown", "send home"
    HOMING = "homing", "the robot is homing", "wait until the mode is holding"
    MOVING = "moving", "the robot moves, or a goal is paused", "send stop first"
    STOPPING = "stopping", "the robot is still stopping", "send the request again when the robot is at rest"
    FAULT = "fault", "the robot is in fault", "remove the cause, then send reset and enable"
    NO_FAULT = "no_fault", "there is no fault to reset", "none is needed"
    NO_GOAL = "no_goal", "no such goal is active", "none is needed"
    NOT_PAUSED = "not_paused", "no goal is paused", "send a goal"
    NOTHING_TO_HOME = "nothing_to_home", "the encoders are absolute", "none is needed"
    NOT_AT_REST = (
        "not_at_rest",
        "a slider is being moved by an external force",
        "send enable when the slider is at rest",
    )

    # The path to the goal.
    OUT_OF_WORKSPACE = (
        "out_of_workspace",
        "the goal or its path exceeds a limit, or leads further beyond a limit",
        "choose a goal inside; from beyond a limit every goal that leads back is accepted, at low speed",
    )
    SINGULAR = (
        "singular",
        "the path passes a singular pose, or the slider positions do not correspond to any pose",
        "choose another path; move the sliders",
    )
    ABOVE_LIMIT = "above_limit", "a jog, or the goal's own limit, exceeds the robot's limit", "lower it"
    TOO_FAST = (
        "too_fast",
        "too fast for a slider or the platform",
        "allow more time, or send a trajectory with stretch",
    )
    WRONG_START = (
        "wrong_start",
        "the trajectory does not start at the robot's position and velocity",
        "move to its first point before: follow --go-there, go_there=True",
    )
    WRONG_END = "wrong_end", "the trajectory ends in motion", "let it end at rest"
    NO_PLAN = (
        "no_plan",
        "the planner found no motion to the goal from the current one",
        "send the goal again when the mode is holding",
    )
    PLANNER_LOST = (
        "planner_lost",
        "the planner process has ended; motions in progress continue",
        "send the goal again: the planner is restarted",
    )
    NO_VELOCITY = "no_velocity", "the jog has no velocity", "set a velocity"
    AT_LIMIT = "at_limit", "the jog ended at a limit", "start a new jog away from the limit"
    JOG_OVER = (
        "jog_over",
        "the jog or track is over: not renewed in time, paused, stopped or refused",
        "start a new jog or track",
    )
    BAD_MARK = (
        "bad_mark",
        "a mark is not on the goal's path, its switches come too fast, or its output cannot switch on a path",
        "move the mark onto the path, or lower the speed",
    )
    UNKNOWN_OUTPUT = (
        "unknown_output",
        "no output or input of that name in the configuration",
        "use a name that info lists",
    )
    WRONG_TIME = (
        "wrong_time",
        "the time of a track's target is too old, or too far ahead",
        "synchronise both machines' clocks, or leave time out",
    )

    # Time, load and execution.
    EXPIRED = "expired", "the goal could not start in time", "send the goal again, or with a longer valid_for"
    QUEUE_FULL = "queue_full", "the goal queue is full", "send the goal when another goal has ended"
    BUSY = "busy", "too many messages, goals or commands are waiting", "send fewer, or more slowly"
    NAME_IN_USE = (
        "name_in_use",
        "another service in the network has the same robot name, so both robots would move",
        "give each robot its own name; stops always work",
    )
    STOPPED = "stopped", "a stop arrived before the goal or command was carried out", "send it again"
    FAULTED = (
        "faulted",
        "a fault occurred before the goal started",
        "remove the cause, send reset and enable, then the goal",
    )
    FAILED = "failed", "the command was accepted but could not be carried out", "see the message"
    TIMEOUT = "timeout", "the request was not carried out in time", "check the state, then send the request again"
    ENDED = "ended", "the service has ended", "start it"
    INTERNAL = "internal", "an internal error of the service", "please report it"
    OTHER = "other", "a code that is unknown to this client; no service sends it", "see the message"

    def __new__(cls, code: str, meaning: str = "", remedy: str = "") -> Self:
        """Create a member from its row in the table; the enumeration itself looks up members by code."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.remedy = meaning, remedy
        return member

    @classmethod
    def _missing_(cls, value: object) -> RefusalCode | None:
        """Map an unknown code to OTHER, so that an old client can still report a refusal by a newer service."""
        return cls.OTHER if isinstance(value, str) else None


class RefusedError(TrirailError):
    """The service refused a goal or command, or the client refused it before sending it.

    `code` is the reason in a form for programs. If a single slider or value is at fault, `slider` is "A", "B" or "C",
    `value` is the requested value, and `limit` is the limit of that value, both in SI units and radians.
    """

    def __init__(
        self,
        code: RefusalCode,
        message: str,
        *,
        slider: str | None = None,
        value: float | None = None,
        limit: float | None = None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.slider = slider
        self.value = value
        self.limit = limit
