"""Decoding of published samples by a client: invalid samples are skipped, counted, and reported once."""

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
    """Decoder of samples for one client; each of its Zenoh callbacks handles one kind of content.

    Any program on the network may publish anything on any key, so invalid content must never raise an error.
    """

    def __init__(self) -> None:
        self.skipped = 0
        """Number of samples that were not valid messages."""

    def messages(self, kind: type[T], deliver: Callable[[T], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a callback that decodes messages of a `kind`, JSON or msgpack by their encoding, for `deliver`.

        The connection's own thread calls `deliver`, which must return quickly.
        """

        def read(sample: zenoh.Sample) -> T:
            what = f"not of kind {kind.__name__.lower()}"
            message: T = boundary.decode(sample.payload.to_bytes(), kind, what, str(sample.encoding))
            return message

        return self._handler(read, deliver)

    def batches(self, deliver: Callable[[bytes], None]) -> zenoh.handlers.Callback[zenoh.Sample]:
        """Return a callback that passes whole batches of records, packed as in wire.records, to `deliver`."""
        from trirail.wire import records  # with numpy, which most commands do without

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

        # Not indirect: that would start a thread of Zenoh that keeps Python from ending.
        return zenoh.handlers.Callback(on_sample, indirect=False)

    def _skip(self, key: str, refusal: RefusedError) -> None:
        self.skipped += 1
        if self.skipped == 1:
            _LOG.warning("trirail: skipped on %s: %s; what else is no message is only counted", quoted(key), refusal)
