"""Data with which the supervisor starts the processes of a service."""

from __future__ import annotations

from uuid import uuid4

import msgspec

from trirail.config import Config
from trirail.wire.credentials import Admission


class Order(msgspec.Struct, frozen=True):
    """Data for a child process, including the content of all files that it needs.

    The files are read once, when the service starts.
    """

    config: Config
    record: str | None
    """Recording file to write; None to write a file that is named after the robot and the time."""
    admission: Admission | None = None
    """Credentials and roles; None for a service without certificates."""
    again: bool = False
    """True if the process is being restarted."""
    run: str = msgspec.field(default_factory=lambda: uuid4().hex)
    """Identity of this run of the service, the same for a restarted process."""
