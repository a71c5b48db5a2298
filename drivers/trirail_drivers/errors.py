"""The root of every error trirail raises, and the drives' branch of it."""

from __future__ import annotations

LONGEST = 500
"""Characters of a message at most."""
_CUT = " … "


def shortened(text: str, longest: int = LONGEST) -> str:
    """Cut a text that is too long in its middle: it begins with what is wrong and where, and ends with the remedy."""
    if len(text) <= longest:
        return text
    end = longest // 3
    return f"{text[: longest - end - len(_CUT)]}{_CUT}{text[-end:]}"


class TrirailError(Exception):
    """Anything trirail refuses or cannot do; the message is one line that says what, where and the remedy.

    It is of bounded length, for it may repeat what a file or a message held.
    """

    def __init__(self, message: str) -> None:
        super().__init__(shortened(message))


class FileError(TrirailError):
    """A file that cannot be read, or cannot be made where it is to be."""


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

    def __init__(
        self, drive: str, name: str, index: int, subindex: int, wanted: object, found: object, seconds: float
    ) -> None:
        super().__init__(
            f"drive {drive}: object {index:04X}:{subindex:02X} ({name}): wanted {wanted}, found {found} "
            f"after {seconds:.3g} s"
        )
        self.drive = drive
