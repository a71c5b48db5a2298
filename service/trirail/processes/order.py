"""Orders to the processes of a service."""

from __future__ import annotations

import msgspec

from trirail.config import Config
from trirail.wire.credentials import Admission


class Order(msgspec.Struct, frozen=True):
    """Order to a child process, with the content of all files that it needs, read when the service started."""

    config: Config
    record: str | None
    """Recording file to write; None for a file named by the time."""
    admission: Admission | None = None
    """Credentials and roles, for a service with certificates."""
    again: bool = False
    """Whether this is a restart of the process."""
