"""Access of the cycle to the CAN bus. It never waits or raises, latches the first fault, and reopens a lost bus."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from typing import Protocol

import can

from trirail_drivers.bus import canerrors
from trirail_drivers.bus.can_frame import ERROR, EXTENDED_BITS
from trirail_drivers.bus.frame_calls import shared_frames
from trirail_drivers.bus.frame_io import frame_io
from trirail_drivers.bus.frames import Frame
from trirail_drivers.bus.packed_frames import BusAccess, PackedFrames
from trirail_drivers.bus.reopening import AbsentBus, Reopening
from trirail_drivers.errors import shortened
from trirail_drivers.interface import Clock, DriveFault
from trirail_drivers.timing import MOST_DATA, BusTiming

MAX_FRAMES = 1000
"""Maximum number of frames that one `receive` handles, so that a babbling node cannot block it."""
UNSENT_CYCLES = 3
"""Number of consecutive cycles with a full transmit queue that constitute a fault."""

TRIAL_CYCLES = 3
"""Number of consecutive cycles in which a reopened bus must accept every frame before it counts as working again."""

Handler = Callable[[bytearray, float], None]
"""Function that handles the data of a frame received at a time [s]. It raises struct.error for a wrong length."""


class Listener(Protocol):
    """Drive whose frames the bus passes to a handler."""

    def note_fault(self, cause: str, code: int, text: str) -> None:
        """Latch a fault of the drive."""


class Wire:
    """Access of the cycle to one bus. It passes received frames to their handlers, and collects warnings.

    It latches the first fault since the last reset; `stop` is called when a fault is latched.
    """

    def __init__(
        self, bus: can.BusABC, timing: BusTiming, stop: Callable[[], None], reopening: Reopening | None = None
    ) -> None:
        """`reopening` reopens a lost bus; without `reopening`, a lost bus stays lost."""
        self.bus = bus
        """Bus for use outside the cycle, during set-up and closing."""
        self.down = ""
        """Reason why the bus is lost, one line for people; "" while the bus is usable."""
        self._name = reopening.name if reopening is not None else str(bus.channel_info)
        self._reopening = reopening
        self.traffic = 0
        """Duration of all frames sent and received, each with worst-case stuffing [ns]."""
        self._frames_ns = timing.frames_ns
        self._frames = shared_frames(frame_io(bus))
        self.fault: DriveFault | None = None
        self._stop = stop
        self._handlers: dict[int, tuple[Listener, Handler]] = {}
        self._warnings: list[str] = []
        self._warned: set[str] = set()
        self._unsent = False
        self._unsent_cycles = 0
        self._sent = False
        """Whether a frame was sent in this cycle."""
        self._dead = False
        """Whether the lost bus can no longer send either."""
        self._trial: int | None = None
        """Number of cycles in which a reopened bus has accepted every frame; None if no bus is on trial."""
        self._awaits_frame = False
        """Whether the bus counts as working again only once a frame has been received."""

    def listen(self, can_id: int, listener: Listener, handler: Handler) -> None:
        """Set the handler for data frames with an 11-bit identifier."""
        self._handlers[can_id] = listener, handler
        self._frames.set_identifiers(self._handlers)

    def forget(self, listener: Listener) -> None:
        """Remove the handlers of a drive, whose frames may have new identifiers."""
        self._handlers = {can_id: entry for can_id, entry in self._handlers.items() if entry[0] is not listener}
        self._frames.set_identifiers(self._handlers)

    def begin(self, now: float, *, stopping: bool = False) -> None:
        """Begin a cycle, and continue the reopening of a lost bus.

        `stopping` means that drives may still be stopping.
        """
        # A cycle in which no frame was sent does not count: an idle bus proves nothing.
        if self._trial is not None:
            self._trial = 0 if self._unsent else self._trial + self._sent
        self._unsent_cycles = self._unsent_cycles + 1 if self._unsent else 0
        self._unsent = self._sent = False
        if self.down and self._reopening is not None:
            self._continue_reopening(self._reopening, now, stopping=stopping)

    def _continue_reopening(self, reopening: Reopening, now: float, *, stopping: bool) -> None:
        """Take the next step of reopening: abandon the lost bus, open it in the background, or try it out."""
        if self._trial is not None:
            if self._trial >= TRIAL_CYCLES and not self._awaits_frame:
                self._end_trial()
            return
        if stopping and not self._dead:
            return  # the bus may still transmit the frames that stop the drives
        if not isinstance(self.bus, AbsentBus):
            reopening.retire(self.bus)
            self._use(AbsentBus(self._name))
            self._dead = True
        outcome = reopening.attempt(now)
        if isinstance(outcome, str):
            self.down = self._down_text(outcome)
        elif outcome is not None:
            self._dead, self._trial, self._unsent_cycles = False, 0, 0
            try:
                self._use(outcome)
            except (can.CanError, OSError) as error:
                self.lose(f"cannot receive: {canerrors.explain(error, self._name)}")

    def _end_trial(self) -> None:
        self.down, self._trial, self._awaits_frame = "", None, False
        self._warnings.append(f"CAN bus {self._name} is up again")

    def _use(self, bus: can.BusABC) -> None:
        """Replace the bus."""
        self.bus = bus
        self._frames = shared_frames(frame_io(bus))
        self._frames.set_identifiers(self._handlers)

    def lose(self, reason: str, *, dead: bool = True) -> None:
        """Mark the bus as lost and to be reopened, and latch a fault. A bus that is not `dead` may still send."""
        text = self._down_text(reason)
        if self._reopening is not None:
            self.down = self.down or text
            self._dead, self._trial = self._dead or dead, None
        self.fail(DriveFault("", "bus", 0, text))

    def _down_text(self, reason: str) -> str:
        return shortened(f"CAN bus {self._name} is down: {reason}")

    def close(self) -> None:
        """Close the bus."""
        if self._reopening is not None:
            self._reopening.close()
        with contextlib.suppress(can.CanError, OSError):
            self.bus.shutdown()

    def fail(self, fault: DriveFault) -> None:
        """Latch a fault, unless one is already latched."""
        if self.fault is None:
            self.fault = fault
            self._stop()

    @property
    def carries(self) -> bool:
        """Whether the bus is usable, or has been reopened and is on trial."""
        return not self.down or self._trial is not None

    @property
    def reopens(self) -> bool:
        """Whether a lost bus will be reopened."""
        return self._reopening is not None

    @property
    def access(self) -> BusAccess:
        """Bus access for compiled code."""
        return self._frames.access

    @property
    def is_healthy(self) -> bool:
        """Whether there is no fault and no warning, and the bus accepts every frame."""
        sends = not self._unsent and self._unsent_cycles == 0
        return self.fault is None and not self._warnings and not self.down and sends

    def put_back(self, arrived: PackedFrames, handled: int, number: int, error: int) -> None:
        """Put frames back that compiled code has received but not handled; see frame_calls.SharedFrames."""
        self._frames.put_back(arrived, handled, number, error)

    def warn(self, text: str) -> None:
        """Add a warning; the same warning is added only once between resets."""
        if text not in self._warned:
            self._warned.add(text)
            self._warnings.append(text)

    def warnings(self) -> tuple[str, ...]:
        """Return and clear the new warnings."""
        warnings = tuple(self._warnings)
        self._warnings.clear()
        return warnings

    def reset(self) -> None:
        """Clear the fault, and allow every warning again."""
        self.fault = None
        self._warned.clear()

    def send(self, frame: Frame) -> bool:
        """Send a frame without waiting; return whether the bus accepted it.

        A frame is dropped if the transmit queue is full. A full queue becomes a fault only after UNSENT_CYCLES cycles.
        """
        try:
            self._frames.send(frame)
        except (can.CanError, OSError) as error:
            self._unsent = True
            if not self._dead:
                self._handle_send_error(error)
            return False
        self._sent = True
        self.traffic += self._frames_ns[frame.length]
        return True

    def _handle_send_error(self, error: Exception) -> None:
        """Turn a failed send into a warning, a fault or a lost bus."""
        reason = f"cannot send: {canerrors.explain(error, self._name)}"
        if not canerrors.queue_is_full(error):
            self.lose(reason)
        elif self._unsent_cycles < UNSENT_CYCLES - 1:
            self.warn(f"CAN bus: {reason}")
        elif canerrors.error_number(error) is not None:  # ENOBUFS, EAGAIN: the interface exists; reopening is no help
            self.fail(DriveFault("", "bus", 0, f"CAN bus: {reason}"))
        else:  # The queue is full or the adapter is gone; python-can gives no error number to tell them apart.
            self._awaits_frame = True
            self.lose(reason, dead=False)

    def receive(self, now: float) -> None:
        """Handle every frame that has arrived."""
        try:
            for _ in range(MAX_FRAMES):
                received = self._frames.receive()
                if received is None:
                    return
                self._dispatch(*received, now)
        except (can.CanError, OSError) as error:
            self.lose(f"cannot receive: {canerrors.explain(error, self._name, sending=False)}", dead=False)

    def wait(self, seconds: float, clock: Clock) -> None:
        """Wait up to `seconds` for a frame and handle it. Not for use in the cycle. Raises can.CanError or OSError."""
        received = self._frames.receive(seconds)
        if received is not None:
            self._dispatch(*received, clock())

    def _dispatch(self, identifier: int, data: bytearray, now: float) -> None:
        if identifier & ERROR:
            self._handle_error_frame(canerrors.decode_error_frame(identifier & EXTENDED_BITS, data, self._name))
            return
        self.traffic += self._frames_ns[min(len(data), MOST_DATA)]
        if self._trial is not None:  # a received frame proves that the bus is working again
            self._end_trial()
        entry = self._handlers.get(identifier)  # none for 29-bit identifiers and remote frames, which have flags
        if entry is None:
            return
        listener, handler = entry
        try:
            handler(data, now)
        except struct.error:
            listener.note_fault("frame", 0, f"frame {identifier:03X} has wrong length {len(data)}")

    def _handle_error_frame(self, report: canerrors.ErrorReport) -> None:
        if report.severity is canerrors.Severity.FAULT:
            self.lose(report.text)
        elif report.severity is canerrors.Severity.WARNING:
            self.warn(f"CAN bus: {report.text}")
