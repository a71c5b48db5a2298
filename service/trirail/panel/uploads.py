"""Trajectory files that a tab uploads in parts."""

from __future__ import annotations

from typing import NamedTuple

from trirail.panel.messages import BeginUpload


class UploadedFile(NamedTuple):
    """Trajectory file that has been uploaded completely."""

    name: str
    content: bytes

    @property
    def text(self) -> str:
        """Content as text. Bytes that are not UTF-8 are replaced, so that the check names the line with them."""
        return self.content.decode("utf-8-sig", "replace")


class Uploads:
    """Receiver of the trajectory files of one tab, which stores only the newest file."""

    def __init__(self) -> None:
        self._file = BeginUpload(0, "", 0)
        self._content = bytearray()

    def begin(self, file: BeginUpload) -> dict[str, int]:
        """Begin a file, and drop the previous file. Return the acknowledgement."""
        self._file, self._content = file, bytearray()
        return self._acknowledgement

    def append(self, part: bytes) -> dict[str, int]:
        """Append a part to the file. Return the acknowledgement.

        Raises ValueError if the file would become longer than announced.
        """
        size = len(self._content) + len(part)
        if size > self._file.size:
            raise ValueError(f"file {self._file.name}: {size} bytes exceed the announced size of {self._file.size}")
        self._content += part
        return self._acknowledgement

    def find(self, number: int) -> UploadedFile | None:
        """Return the file with a number; None if the file is not complete, or another file has replaced it."""
        if number != self._file.file or len(self._content) < self._file.size:
            return None
        return UploadedFile(self._file.name, bytes(self._content))

    @property
    def _acknowledgement(self) -> dict[str, int]:
        return {"file": self._file.file, "size": len(self._content)}
