"""What the service is told of an alignment while it runs: recordings, reports and panels have it from there.

A message a look. An alignment never ends because of them: where one is not taken, a warning says so, once.
"""

from __future__ import annotations

import itertools
import time
import uuid
import warnings
from collections.abc import Iterator
from typing import cast

import msgspec

from trirail.alignment.results import Measurement
from trirail.alignment.wishes import LookReport, Sighting
from trirail.wire.looks import AlignmentLook, LookEnd, LookError, SeenMark
from trirail.wire.text import quoted


class UnrecordedAlignmentWarning(UserWarning):
    """The service did not take what it was told of an alignment; recordings and panels lack it."""


class LookReports:
    """Makes the messages of one alignment, and the ids of its goals, which begin with its own."""

    def __init__(self) -> None:
        self.id = f"align-{uuid.uuid4().hex[:8]}"
        self._goals = itertools.count(1)
        self._last: LookReport | None = None
        self._number = 0
        self._began = 0.0
        self._lost = False

    def goal_ids(self) -> Iterator[str]:
        """Yield the ids of its goals."""
        return (f"{self.id}-{number}" for number in self._goals)

    def message(self, report: LookReport) -> bytes | None:
        """Return what is to be sent; None where that cannot be said, or an earlier one was not taken."""
        if self._last is None or self._last.purpose != report.purpose:
            self._number, self._began = 0, _time(report)
        self._number = max(1, self._number + (report.sighting is not None))
        self._last = report
        try:
            return None if self._lost else msgspec.json.encode(self._message(report))
        except (ValueError, TypeError) as error:
            self.lost(error)
            return None

    def failure(self, error: BaseException) -> bytes | None:
        """Return what is to be sent where an error ends it; None where its end was told, or it has not looked yet."""
        if self._last is None or self._last.end is not None:
            return None
        return self.message(LookReport(self._last.purpose, end="failed", words=str(error) or type(error).__name__))

    def lost(self, error: Exception) -> None:
        """Warn, once, that the service does not take it."""
        if not self._lost:
            self._lost = True
            words = f"this alignment is not in the service's recording: {error}"
            warnings.warn(words, UnrecordedAlignmentWarning, stacklevel=4)

    def _message(self, report: LookReport) -> AlignmentLook:
        sighting, measured = report.sighting, report.measurement
        return AlignmentLook(
            id=self.id,
            purpose=report.purpose,
            number=self._number,
            marks=() if sighting is None else tuple(_marks(sighting, measured)),
            error=None if measured is None else _error(measured),
            pose=None if sighting is None else sighting.pose,
            correction=report.correction,
            end=cast(LookEnd | None, report.end and str(report.end)),  # tests/wire/test_looks.py holds them together
            words=quoted(report.words),
            noise=report.noise,
            seconds=max(0.0, _time(report) - self._began),
        )


def _time(report: LookReport) -> float:
    return time.monotonic() if report.sighting is None else report.sighting.time


def _marks(sighting: Sighting, measured: Measurement | None) -> Iterator[SeenMark]:
    to_go = {} if measured is None else measured.errors
    for name, pixel in sighting.marks.items():
        yield SeenMark(str(name), pixel, to_go.get(name))


def _error(measured: Measurement) -> LookError:
    return LookError(measured.worst, measured.shift, measured.turn, measured.misfit, measured.distance)
