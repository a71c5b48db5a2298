"""The service's errors: one tree under TrirailError, each with what a person needs to act on it."""

from __future__ import annotations

from trirail_drivers.errors import TrirailError

__all__ = ["ConfigError", "KinematicsError", "RefusedError", "ServiceError", "TrirailError"]


class ConfigError(TrirailError):
    """A configuration file that cannot be used; names file, key, value and what is allowed."""


class ServiceError(TrirailError):
    """The service cannot start, or cannot be reached."""


class KinematicsError(TrirailError, ValueError):
    """No such pose or slider positions: unreachable or singular. Names leg, value and limit.

    `leg` is "A", "B", "C" or "" where no single leg is at fault; `value` and `limit` are in metres or radians.
    """

    def __init__(self, message: str, *, leg: str = "", value: float | None = None, limit: float | None = None) -> None:
        super().__init__(message)
        self.leg = leg
        self.value = value
        self.limit = limit


class RefusedError(TrirailError):
    """The service said no to a goal or command; carries the fields of its error reply."""

    def __init__(
        self,
        code: str,
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
