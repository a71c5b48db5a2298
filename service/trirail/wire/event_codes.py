"""Event codes, which tell programs the content of an event and let web pages translate the event's message."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Any, NamedTuple, Self


class EventCode(StrEnum):
    """Content of an event's message, as a code."""

    meaning: str
    """Meaning of the code, in one line."""
    params: tuple[str, ...]
    """Names of the values in the message; the values are in SI units and radians."""

    # Goals and modes.
    GOAL_STARTED = "goal_started", "a goal has begun", "goal", "user"
    ARRIVED = "arrived", "the goal has reached its end"
    SETTLED = "settled", "the robot is in position", "settle"
    NOT_IN_POSITION = "not_in_position", "the robot did not settle in time", "timeout"
    STANDSTILL = "standstill", "the robot is at rest"
    RELEASED = "released", "a jog or track was not renewed and has stopped"
    NOT_RENEWED = "not_renewed", "a jog or track was not renewed in time", "goal", "user"
    PASSED = "passed", "the robot passed the goal's end on its way to the next goal", "goal"
    PREEMPTED = "preempted", "another goal has replaced the goal", "goal"
    EARLIER_GOAL_ENDED = (
        "earlier_goal_ended",
        "an earlier goal, which the goal was to follow, has ended",
        "goal",
        "outcome",
    )
    TOO_LATE = "too_late", "the goal waited longer than its valid_for"
    STOPPED_AT_LIMIT = "stopped_at_limit", "a jog has stopped at a limit"
    BEYOND_LIMIT = "beyond_limit", "a track's target is beyond a limit", "goal"
    COMMAND = "command", "a user sent a command", "command", "user"
    OVERRIDE = "override", "a user has set the speed override", "percent", "user"
    PLANNER_BUSY = "planner_busy", "a goal waits for the planner", "goal", "silence"
    REFUSED = "refused", "the event's code says why something was refused"
    POWERED = "powered", "all drives are enabled"
    POWERED_NOT_HOMED = "powered_not_homed", "all drives are enabled, slider positions are unknown"
    HOMED = "homed", "all drives are homed"
    OUTSIDE_LIMITS = (
        *("outside_limits", "the robot is outside its limits"),
        *("part", "name", "quantity", "value", "limit", "unit"),
    )

    # The lease.
    LEASE_ACQUIRED = "lease_acquired", "a user has acquired the lease", "user"
    LEASE_TAKEN_OVER = "lease_taken_over", "a user has taken the lease from another user", "user", "before"
    LEASE_RELEASED = "lease_released", "a user has released the lease", "user"
    LEASE_EXPIRED = "lease_expired", "the lease's holder gave no sign of life", "user", "timeout"

    # Faults.
    FOLLOWING_ERROR = "following_error", "a slider lags too far behind", "slider", "value", "limit"
    ENABLE_TIMEOUT = "enable_timeout", "drives were not enabled in time", "drives", "timeout"
    BAD_SETPOINT = "bad_setpoint", "the last gate has refused a setpoint"
    BAD_POSITION = "bad_position", "the robot cannot hold at the measured slider positions"
    DRIVE_FAULT = "drive_fault", "a drive or its bus reports a fault", "cause", "drive", "code"
    LOOP_DIED = "loop_died", "the loop's process has died"
    LOOP_FROZEN = "loop_frozen", "the loop's process hung and was killed"
    INTERNAL_ERROR = "internal_error", "an error of the service's own", "error"
    SUSPENDED = "suspended", "the computer was suspended, and the robot has stopped", "duration"
    MACHINE_BUSY = "machine_busy", "the loop missed ticks in a row", "ticks"
    GATEWAY_LOST = "gateway_lost", "the gateway's process has died"
    GATEWAY_FROZEN = "gateway_frozen", "the gateway's process hangs", "timeout"
    SHUTDOWN = "shutdown", "the service is ending"
    SHUTDOWN_SLOW = "shutdown_slow", "the controlled stop at the service's end took too long: quick stop", "timeout"

    # Drives.
    DRIVE_WARNING = "drive_warning", "a warning of the drives or their bus", "warning"
    DRIVE_NOT_READY = "drive_not_ready", "a drive must be configured again", "drive", "reason"
    DRIVE_READY = "drive_ready", "a drive is configured, but others are not", "drive"
    DRIVES_READY = "drives_ready", "a drive is configured, and so are all others", "drive"
    POSITION_UNKNOWN = "position_unknown", "a slider must be homed again", "slider"
    SLIDER_MOVED = "slider_moved", "a slider moved while its drive was off", "slider", "position_before", "position"

    # Outputs and inputs.
    OUTPUT_SET = "output_set", "a user has set an output", "output", "on", "user"
    MARKS_PLANNED = "marks_planned", "an accepted goal switches outputs on its path", "goal", "number"
    OUTPUTS_SWITCHED = "outputs_switched", "outputs have switched on the path of a goal", "goal", "number"
    INPUT_CHANGED = "input_changed", "an input has changed", "input", "on", "x", "y", "phi"
    INPUT_REACHED = "input_reached", "an input has changed at which the goal was to end", "input", "x", "y", "phi"

    # Poses and alignments.
    POSE_TAUGHT = "pose_taught", "a pose was taught", "pose", "user", "x", "y", "phi"
    POSE_REMOVED = "pose_removed", "a taught pose was removed", "pose", "user"
    POSES_UNREADABLE = "poses_unreadable", "the file of taught poses cannot be read", "file"
    POSES_LOST = "poses_lost", "the file of taught poses has been deleted", "file"
    ALIGNMENT_LOOK = "alignment_look", "an alignment has taken pictures", "id", "purpose", "number"
    ALIGNMENT_ENDED = "alignment_ended", "an alignment has ended", "id", "purpose", "end", "seconds"

    # Recordings.
    RECORDING = "recording", "a recording has begun", "file"
    RECORDER_LOST = "recorder_lost", "the recorder's process has ended"
    RECORDER_UNREADABLE = "recorder_unreadable", "the recorder sent an invalid message", "error"
    NOT_RECORDED = "not_recorded", "the recording cannot be written", "error"
    NOT_CAPTURED = "not_captured", "the log of CAN frames cannot be written", "error"
    RECORDED_AGAIN = "recorded_again", "the recording is written again"
    RECORDING_INCOMPLETE = "recording_incomplete", "parts of the recording are missing", "lost", "skipped", "absent"
    RECORDING_MOVED = "recording_moved", "a recording was deleted or moved", "file", "next"
    CAPTURE_MOVED = "capture_moved", "a log of CAN frames was deleted or moved", "file"
    RECORDINGS_DELETED = "recordings_deleted", "old recordings were deleted", "keep_mb", "files"
    RECORDINGS_DELETED_FOR_SPACE = (
        "recordings_deleted_for_space",
        "old recordings were deleted, because the disk was nearly full",
        *("free_mb", "files"),
    )
    RECORDINGS_KEPT = "recordings_kept", "old recordings cannot be deleted", "error"
    NOT_INDEXED = "not_indexed", "the index of sessions cannot be written", "error"
    BLACK_BOX_INCOMPLETE = "black_box_incomplete", "parts of the minute before a fault are missing", "file", "error"
    BLACK_BOX_LATER = "black_box_later", "faults repeat within a minute, and are saved in one file", "until"
    BLACK_BOX_SHORT = "black_box_short", "too many messages before a fault, the oldest are missing", "until"
    NO_BLACK_BOX = "no_black_box", "the minute before a fault cannot be kept", "error"

    # The network.
    ROUTER_LINKED = "router_linked", "the gateway is connected to a router", "router"
    ROUTER_LOST = "router_lost", "the gateway has no connection to a router", "router"
    NAME_IN_USE = "name_in_use", "another service in the Zenoh network has the same robot name", "robot"
    SESSIONS_FULL = "sessions_full", "nearly as many sessions as the gateway accepts", "used", "most"
    DESCRIPTORS_FULL = "descriptors_full", "nearly as many file descriptors as the gateway may open", "used", "most"
    CONNECTIONS_WAIT = "connections_wait", "many connections open no session", "count", "wait"
    CERTIFICATE_EXPIRES = (
        "certificate_expires",
        "the robot's certificate expires in a few seconds, and the robot stops",
    )

    OTHER = "other", "a code of a newer service that this client does not know"

    def __new__(cls, code: str, meaning: str = "", *params: str) -> Self:
        """Create a member from its row. A call with only a code, such as EventCode("arrived"), looks the member up."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.meaning, member.params = meaning, params
        return member

    @classmethod
    def _missing_(cls, value: object) -> EventCode | None:
        """Return OTHER for a code that only a newer service knows."""
        return cls.OTHER if isinstance(value, str) else None


Params = dict[str, float | str]
MAX_PARAM = 200
"""Maximum length of a text parameter [characters], so that an event with a long error message fits into a packet."""


class EventText(NamedTuple):
    """English text for people, with an event code and its parameters for programs."""

    text: str
    code: EventCode
    params: Params

    def __str__(self) -> str:
        return self.text

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the message fields `event_code` and `params`, by field name."""
        return {"event_code": self.code, "params": self.params}


def coded(text: str, code: EventCode, /, **params: float | str) -> EventText:
    """Return a text with its event code; `params` are the values that the code's `params` name."""
    return EventText(encodable(text), code, {name: _plain(value) for name, value in params.items()})


def encodable(text: str) -> str:
    """Return a text in which characters that UTF-8 lacks are escaped, as in file names of other encodings."""
    return text.encode(errors="backslashreplace").decode()


def _plain(value: float | str) -> float | str:
    """Convert a value to a string or a finite float, which JSON can represent; infinity and NaN become strings."""
    if isinstance(value, str):
        return encodable(value)[:MAX_PARAM]
    return float(value) if math.isfinite(value) else str(value)
