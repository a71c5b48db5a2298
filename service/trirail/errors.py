"""The service's errors: one tree under TrirailError, each with what a person needs to act on it."""

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
]


class ConfigError(TrirailError):
    """A configuration file that cannot be used; names file, key, value and what is allowed."""


class ServiceError(TrirailError):
    """The service cannot start, or cannot be reached."""


class EmptyRecordingError(ServiceError):
    """A recording in which nothing has been recorded: its service ended before the first cycle reached it."""


class KinematicsError(TrirailError, ValueError):
    """No such pose or slider positions: unreachable or singular. Names leg, value and limit.

    `leg` is "A", "B", "C" or "" where no single leg is at fault; `value` and `limit` are in metres or radians.
    """

    def __init__(self, message: str, *, leg: str = "", value: float | None = None, limit: float | None = None) -> None:
        super().__init__(message)
        self.leg = leg
        self.value = value
        self.limit = limit


class AlignmentFault(StrEnum):
    """Why marks do not tell how a part lies."""

    MISSING = "missing"
    """Too few were found, or one is not in the calibration."""
    DISTANCE = "distance"
    """Two are too far from each other, or too near: another part, a wrong calibration, heat."""
    SWAPPED = "swapped"
    """Their names are exchanged."""
    STILL = "still"
    """They do not move when the stage does."""
    MOVES = "moves"
    """The moves of a calibration are too few, or all in one direction."""


class AlignmentError(TrirailError):
    """Marks that do not tell how a part lies; nothing moves because of them.

    `fault` says why, for programs; `value` and `limit` are in the fault's own unit, where it is a matter of a limit.
    """

    def __init__(
        self, fault: AlignmentFault, message: str, *, value: float | None = None, limit: float | None = None
    ) -> None:
        super().__init__(message)
        self.fault = fault
        self.value = value
        self.limit = limit


class RefusalCode(StrEnum):
    """Why a goal or command is refused, or was not carried out; for people, the message beside it says more."""

    meaning: str
    """What it means, in one line."""
    remedy: str
    """What the sender can do."""

    # What was sent.
    MALFORMED = (
        "malformed",
        "not a message of its kind: a field is missing, unknown or impossible",
        "send what the schema allows",
    )
    TOO_LARGE = "too_large", "more bytes than are read", "send a smaller message"
    UNKNOWN_ENCODING = "unknown_encoding", "neither JSON nor msgpack", "name the encoding, or none for JSON"
    UNKNOWN_KEY = (
        "unknown_key",
        "not a key of the table; Zenoh delivers none such, so a query on one ends without any reply",
        "use a key of the table",
    )
    WILDCARD = "wildcard", "a key for more than one robot or user", "name one of each"
    BAD_NAME = (
        "bad_name",
        "a name with other than letters, digits, - and _, or a new pose's that reads as a quantity: 5mm",
        "use another name",
    )
    UNKNOWN_COMMAND = "unknown_command", "no such command", "send one of those that the message names"
    DUPLICATE_ID = "duplicate_id", "the goal's id has been used", "give every goal an id of its own, or none"
    UNKNOWN_FRAME = "unknown_frame", "no tool or frame of that name in [frames]", "use one of those that info tells"
    UNKNOWN_POSE = "unknown_pose", "no pose of that name", "use one of those that poses tells, or teach it"
    CONFIGURED_POSE = (
        "configured_pose",
        "a pose of [poses] in the configuration, neither to be taught nor removed",
        "choose another name, or change the configuration",
    )

    # Who sent it.
    NOT_ALLOWED = (
        "not_allowed",
        "the user's role does not allow it, or he has none",
        "ask for a role that does: [zenoh.users] of the robot's configuration",
    )

    LEASED = "leased", "another user holds the lease", "wait until it is free, or take it over"
    NO_LEASE = (
        "no_lease",
        "nobody holds the lease: none to release, or this robot moves for a holder alone",
        "send acquire",
    )
    LEASE_OVER = "lease_over", "the lease was released, taken over, or kept by no sign of life", "acquire a new one"

    # What the robot's mode allows.
    NOT_ENABLED = "not_enabled", "the drives have no power yet", "send enable, and wait for it"
    NOT_HOMED = "not_homed", "where the sliders are is not known", "send home"
    HOMING = "homing", "the robot is homing", "wait until the mode is holding"
    MOVING = "moving", "the robot moves, or a goal is paused", "send stop first"
    STOPPING = "stopping", "the robot has not come to rest yet", "send it again when it stands"
    FAULT = "fault", "the robot is in fault", "remove the cause, then send reset and enable"
    NO_FAULT = "no_fault", "there is no fault to reset", "none is needed"
    NO_GOAL = "no_goal", "no such goal is under way", "none is needed"
    NOT_PAUSED = "not_paused", "no goal is paused", "send a goal"
    NOTHING_TO_HOME = "nothing_to_home", "the encoders are absolute", "none is needed"
    NOT_AT_REST = "not_at_rest", "a slider is moved from outside", "enable when it stands"

    # The way to the goal.
    OUT_OF_WORKSPACE = (
        "out_of_workspace",
        "the goal, its path or the robot is outside of its limits",
        "choose another goal; sliders moves out of where goto cannot",
    )
    SINGULAR = (
        "singular",
        "the robot is singular there, or its sliders belong to no pose",
        "choose another path; move the sliders",
    )
    ABOVE_LIMIT = "above_limit", "a jog, or a limit of the goal's own, is above the robot's limit", "lower it"
    TOO_FAST = (
        "too_fast",
        "too fast for a slider or the platform",
        "give it more time, or send a trajectory with stretch",
    )
    WRONG_START = (
        "wrong_start",
        "a trajectory that does not begin as the robot stands",
        "go to its first point first, at rest: follow with --go-there, go_there=True",
    )
    WRONG_END = "wrong_end", "a trajectory that ends in motion", "let it end at rest"
    NO_PLAN = "no_plan", "no motion to it was found from the present one", "send it again when the robot holds"
    PLANNER_LOST = (
        "planner_lost",
        "the planner has died; what is under way goes on",
        "send it again: a planner that is lost is started again",
    )
    NO_VELOCITY = "no_velocity", "a jog that moves nothing", "give it a velocity"
    AT_LIMIT = "at_limit", "the jog has ended at a limit", "begin a new one, away from it"
    JOG_OVER = (
        "jog_over",
        "the jog or track is over: not renewed in time, paused, stopped or refused",
        "begin a new one",
    )
    WRONG_TIME = (
        "wrong_time",
        "a track's target of too long ago, or of too far ahead",
        "have both machines' clocks agree, or leave time out",
    )

    # Too late, too much, or not carried out.
    EXPIRED = "expired", "the goal could not begin in time", "send it again, or with a longer valid_for"
    QUEUE_FULL = "queue_full", "as many goals wait for each other as may", "send it when one has ended"
    BUSY = "busy", "more messages, goals or commands at once than are kept", "send fewer"
    STOPPED = "stopped", "the robot was told to stop before the goal began", "send it again"
    FAULTED = (
        "faulted",
        "the robot went into fault before the goal began",
        "remove the cause, send reset and enable, then the goal",
    )
    FAILED = "failed", "the command was taken but could not be carried out", "see the message"
    TIMEOUT = "timeout", "not carried out in time", "look at the state, then send it again"
    ENDED = "ended", "the service has ended", "start it"
    INTERNAL = "internal", "an error of the service's own", "please report it"
    OTHER = "other", "a code that this client does not know; no service sends it", "see the message"

    def __new__(cls, code: str, meaning: str = "", remedy: str = "") -> Self:
        """Make a member of its row; with a code alone the enumeration looks it up."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.remedy = meaning, remedy
        return member

    @classmethod
    def _missing_(cls, value: object) -> RefusalCode | None:
        """Take a code of a newer service for OTHER: the refusal is one all the same."""
        return cls.OTHER if isinstance(value, str) else None


class RefusedError(TrirailError):
    """The service said no to a goal or command, or a client sees that it would; has the fields of an error reply.

    `code` says why, for programs. Where one slider or value is at fault, `slider` is "A", "B" or "C", `value` what was
    asked of it, and `limit` what is allowed: SI units and radians.
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
