"""The root of every error trirail raises, and the drives' branch of it."""

from __future__ import annotations


class TrirailError(Exception):
    """Anything trirail refuses or cannot do; the message is one line that says what, where and the remedy."""


class DriveError(TrirailError):
    """A drive or its bus cannot be used as configured."""


class BusError(DriveError):
    """The CAN interface is missing, down, or cannot carry the configured traffic."""


class DriveTimeout(DriveError):
    """A drive did not answer in time."""

    def __init__(self, drive: str, waiting_for: str, seconds: float) -> None:
        super().__init__(f"drive {drive}: no {waiting_for} within {seconds:g} s; is it powered and on this bus?")
        self.drive = drive


class ConfigurationRefused(DriveError):
    """A drive did not take a value: what was read back differs from what was written."""

    def __init__(self, drive: str, name: str, index: int, subindex: int, wanted: object, found: object) -> None:
        super().__init__(f"drive {drive}: object {index:04X}:{subindex:02X} ({name}): wanted {wanted}, found {found}")
        self.drive = drive
