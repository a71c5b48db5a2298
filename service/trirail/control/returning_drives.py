"""Messages about drives that are lost and return, and about sliders that have moved while their drives were off."""

from __future__ import annotations

from collections.abc import Iterator

from trirail_drivers.interface import Feedback, Triple, Unready

from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.messages import Level

JUMP_CYCLES = 3
"""Number of cycles after which a position that has jumped must still be elsewhere, which a wrong frame is not."""


class ReturningDrives:
    """Detector of drives that are lost or have been configured again. It compares successive feedback."""

    def __init__(self, labels: tuple[str, str, str], windows: Triple) -> None:
        """Set the labels of the drives. A slider that moves by more than its value of `windows` [m] is reported."""
        self._labels = labels
        self._windows = windows
        self._before: tuple[Unready | None, ...] = (None, None, None)
        self._last: list[float | None] = [None, None, None]
        """Position of each drive when it was lost [m]; None if it was not homed."""
        self._jumped: dict[int, tuple[float, int]] = {}
        """Position before a jump [m], and number of cycles since then, of each slider that has jumped."""

    @property
    def watches_jump(self) -> bool:
        """Whether a position has jumped, and the next cycles show whether it stays there."""
        return bool(self._jumped)

    def update_jumps(
        self, feedback: Feedback, jumps: tuple[bool, bool, bool], before: Triple
    ) -> Iterator[tuple[Level, EventText]]:
        """Yield a warning for each slider whose position has jumped and stays there. Call this before `update`.

        Parameters
        ----------
        jumps
            Whether the position of each slider has changed faster than the slider can move.
        before
            Positions in the previous cycle [m].

        """
        for i, (jumps_now, position) in enumerate(zip(jumps, feedback.position, strict=True)):
            if feedback.unready[i] is not None or self._before[i] is not None:  # `update` compares the positions
                self._jumped.pop(i, None)
            elif i in self._jumped or jumps_now:
                last, cycles = self._jumped.pop(i, (before[i], 0))
                if cycles < JUMP_CYCLES:
                    self._jumped[i] = last, cycles + 1
                elif abs(position - last) > self._windows[i]:
                    words = (
                        f"slider {self._labels[i]}: its position has jumped, without power, from {last * 1e3:.3f} mm "
                        f"to {position * 1e3:.3f} mm: check it before you enable"
                    )
                    label = self._labels[i]
                    text = coded(words, EventCode.SLIDER_MOVED, slider=label, position_before=last, position=position)
                    yield "warning", text

    def update(self, feedback: Feedback) -> Iterator[tuple[Level, EventText]]:
        """Yield a level and a message for each drive that has been lost or has returned."""
        if feedback.unready == self._before:
            return
        reported = {feedback.fault.message} if feedback.fault is not None else set()
        for i, (now, before) in enumerate(zip(feedback.unready, self._before, strict=True)):
            if now is not None and before is None:
                self._last[i] = feedback.position[i] if feedback.homed[i] else None
            if now is not None and (before is None or now.reason != before.reason):
                if now.reason not in reported:  # a lost bus gives all drives the same reason
                    name = self._labels[i]
                    yield "warning", coded(now.reason, EventCode.DRIVE_NOT_READY, drive=name, reason=now.reason)
                reported.add(now.reason)
            elif now is None and before is not None:
                yield from self._back(i, feedback)
        self._before = feedback.unready

    def _back(self, i: int, feedback: Feedback) -> Iterator[tuple[Level, EventText]]:
        """Yield a message that a drive is configured again, and a warning if its slider has moved or is not homed."""
        label, position, last = self._labels[i], feedback.position[i], self._last[i]
        waiting = any(each is not None for each in feedback.unready)
        if waiting:
            words = f"drive {label} is configured: send reset when all drives are configured"
            yield "info", coded(words, EventCode.DRIVE_READY, drive=label)
        else:
            words = f"drive {label} is configured, and so are the others: send reset, then enable"
            yield "info", coded(words, EventCode.DRIVES_READY, drive=label)
        if not feedback.homed[i]:
            words = f"slider {label}: the position is unknown because the drive was configured again; send home"
            yield "warning", coded(words, EventCode.POSITION_UNKNOWN, slider=label)
        elif last is not None and abs(position - last) > self._windows[i]:
            moved = (
                f"slider {label}: moved while its drive was off, from {last * 1e3:.3f} mm to {position * 1e3:.3f} mm"
            )
            yield "warning", coded(moved, EventCode.SLIDER_MOVED, slider=label, position_before=last, position=position)
