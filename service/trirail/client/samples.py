"""Decoding of published samples by a client, which skips and counts invalid samples and logs the first of them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import msgspec
import zenoh

from trirail.errors import RefusedError
from trirail.wire import boundary
from trirail.wire.text import quoted

T = TypeVar("T", bound=msgspec.Struct)
_LOG = logging.getLogger("trirail")


class SampleReader:
    """Factory of Zenoh callbacks for one client; each callback decodes one kind of content.

    Any program on the network may publish anything on any key, so invalid content must never raise an error.
    """

    def __init__(self) -> None:
        self.skipped = 0
        """Number of samples that were not valid messages."""

    def messages(self, kind: type[T], deliver: Callable[[T], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a callback that decodes messages of a `kind` and passes them to `deliver`.

        The encoding of the sample, JSON or msgpack, selects the decoder. A thread of the connection calls `deliver`,
        which must return quickly.
        """

        def read(sample: zenoh.Sample) -> T:
            what = f"not of kind {kind.__name__.lower()}"
            message: T = boundary.decode(sample.payload.to_bytes(), kind, what, str(sample.encoding))
            return message

        return self._handler(read, deliver)

    def batches(self, deliver: Callable[[bytes], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a callback that passes valid batches of records, in the format of wire.records, to `deliver`."""
        from trirail.wire import records  # imports numpy, which most commands do not need

        return self._handler(lambda sample: records.checked(sample.payload.to_bytes()), deliver)

    def _handler(
        self, read: Callable[[zenoh.Sample], T | bytes], deliver: Callable[..., None]
    ) -> zenoh.handlers.Callback[zenoh.Sample]:
        def on_sample(sample: zenoh.Sample) -> None:
            try:
                content = read(sample)
            except RefusedError as refusal:
                self._skip(str(sample.key_expr), refusal)
            else:
                deliver(content)

        # An indirect callback would start a thread of Zenoh that prevents Python from exiting.
        return zenoh.handlers.Callback(on_sample, indirect=False)

    def _skip(self, key: str, refusal: RefusedError) -> None:
        self.skipped += 1
        if self.skipped == 1:
            _LOG.warning("trirail: skipped on %s: %s; what else is no message is only counted", quoted(key), refusal)
