"""Base class of all trirail errors, and the errors that concern drives and buses."""

from __future__ import annotations

MAX_MESSAGE_LENGTH = 500
"""Maximum length of a message [characters]."""
_ELLIPSIS = " … "


def shortened(text: str, longest: int = MAX_MESSAGE_LENGTH) -> str:
    """Cut out the middle of a long text, since the beginning names the problem and the end names the remedy."""
    if len(text) <= longest:
        return text
    end = longest // 3
    return f"{text[: longest - end - len(_ELLIPSIS)]}{_ELLIPSIS}{text[-end:]}"


class TrirailError(Exception):
    """Base class of all errors of trirail. The message is one line that names the object, the problem and the remedy.

    The length of the message is bounded, since the message may quote a file or another message of any length.
    """

    def __init__(self, message: str) -> None:
        super().__init__(shortened(message))


class FileError(TrirailError):
    """A file cannot be read or created."""


class DriveError(TrirailError):
    """A drive or its bus cannot be used as configured."""


class BusError(DriveError):
    """The CAN interface is missing, down, or cannot carry the configured traffic."""


class BusAbsentError(BusError):
    """The CAN interface is missing or down, but may appear or come up later."""


class DriveTimeout(DriveError):
    """A drive did not answer in time."""

    def __init__(self, drive: str, waiting_for: str, seconds: float) -> None:
        super().__init__(
            f"drive {drive}: no {waiting_for} within {seconds:g} s; check that the drive is powered and on this bus"
        )
        self.drive = drive


class DriveAbsentError(DriveTimeout):
    """A drive has not answered any request."""


class ConfigurationRefused(DriveError):
    """A drive did not accept a written value: a different value was read back."""

    def __init__(
        self, drive: str, name: str, index: int, subindex: int, wanted: object, read_back: object, seconds: float
    ) -> None:
        super().__init__(
            f"drive {drive}: object {index:04X}:{subindex:02X} ({name}): expected {wanted}, found {read_back} "
            f"after {seconds:.3g} s"
        )
        self.drive = drive
