"""Orders to the processes of a service."""

from __future__ import annotations

import msgspec

from trirail.config import Config
from trirail.wire.credentials import Admission


class Order(msgspec.Struct, frozen=True):
    """Order to a child process: all that it needs of files, as the service found them at its start."""

    config: Config
    record: str | None
    """Recording file to write; None for one named by the time."""
    admission: Admission | None = None
    """Credentials and roles of a service with certificates."""
    again: bool = False
    """Whether the service has had this process before."""
