"""Set-up of drives in the background of the cycle, after they have restarted, fallen silent or been absent.

The set-up is the same as at the start, but runs one step at a time to bound its traffic. It sends nothing while any
drive that answers has power.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Coroutine, Sequence
from typing import Any, ClassVar, Final, Generic, Protocol, TypeVar

import can

from trirail_drivers.bus.frames import Frame, FrameSender, packed
from trirail_drivers.bus.wire import Wire
from trirail_drivers.driver.axis import Axis
from trirail_drivers.driver.conversations import BackgroundConversation
from trirail_drivers.driver.refusals import SetUpDrive, merge_notes
from trirail_drivers.errors import DriveAbsentError, DriveError, DriveTimeout
from trirail_drivers.interface import Clock, Unready, UnreadyDrives

STEP_BITS: Final = 2000
"""Number of bit times between two set-up steps, whichever drives the steps belong to.

A request and its answer then use 13.5 % of a bus that the cycle fills to 75 %. A drive that is being set up sends no
position, which frees 11 % of that bus.
"""
RETRY_AFTER: Final = 2.0
"""Pause before a refused drive is configured again [s]: the cause may disappear without a boot-up message."""

AnyAxis = TypeVar("AnyAxis", bound=Axis)
Setup = TypeVar("Setup", bound=SetUpDrive)
StartState = TypeVar("StartState")


class SetupClient(Protocol):
    """Client that sends the set-up requests to one drive."""

    @property
    def answered(self) -> int:
        """Number of answered requests."""


class CycleSender:
    """Sender of set-up frames in the cycle. It does not wait, and a failure becomes a fault of the bus."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    @property
    def channel_info(self) -> str:
        """Name of the bus."""
        return str(self._wire.bus.channel_info)

    @property
    def protocol(self) -> can.CanProtocol:
        """Protocol of the bus; see FrameSender."""
        return self._wire.bus.protocol

    def send(self, msg: can.Message) -> None:
        """Send a frame."""
        self._wire.send(Frame.from_packed(packed(msg)))


class ReturningDrive(ABC, Generic[AnyAxis, Setup, StartState]):
    """Drive that may have to be set up again: its last complete set-up, and the progress of the current one.

    A set-up returns two results: the set-up of the drive, and its state at the start.
    """

    work: ClassVar[str]
    """Name of the set-up, for people."""
    counted: ClassVar[str]
    """Name of the requested items, for people."""

    def __init__(self, axis: AnyAxis) -> None:
        self.axis = axis
        self.setup: Setup | None = None
        """Result of the drive's last complete set-up."""
        self.requests = 0
        """Number of requests in the longest set-up."""
        self.conversation: BackgroundConversation[tuple[Setup, StartState]] | None = None
        self.client: SetupClient | None = None
        """Client of the current conversation."""
        self.is_next = False
        """Whether the conversation starts as soon as the cycle's last request has been answered. Until then, the cycle
        must not send another request.
        """
        self.refused = ""
        """Error of the last attempt."""
        self.retry_at = -math.inf
        self.boots = self.booted_at = 0
        """Number of restarts observed up to now, and number of the SYNC before the newest restart."""
        axis.setup_listener = self.receive

    @abstractmethod
    def start_setup(
        self, sender: FrameSender, clock: Clock
    ) -> tuple[Coroutine[Any, Any, tuple[Setup, StartState]], SetupClient]:
        """Return a new set-up of the drive, and its client."""

    @abstractmethod
    def accept(self, made: Setup, begun: StartState) -> str:
        """Let a configured drive take part in the cycle; return a warning, or "". May raise DriveError."""

    @abstractmethod
    def may_have_power(self, *, stopping: bool) -> bool:
        """Whether the drive's last message shows power, or the drive is silent while drives are `stopping`."""

    @property
    def settled(self) -> bool:
        """Whether a restarted drive is ready to receive requests."""
        return True

    @property
    def cause(self) -> str:
        """Reason for a new set-up, as the drive has reported it; "" if it has fallen silent."""
        return "has restarted" if self.axis.restarted else ""

    def has_answered(self, now: float) -> bool:  # noqa: ARG002
        """Whether the cycle's last request has been answered, or has timed out at time `now` [s]."""
        return True

    def record_setup(self, made: Setup, answered: int) -> None:
        """Record a complete set-up and its number of requests."""
        self.setup, self.requests, self.refused = made, max(self.requests, answered), ""

    def receive(self, identifier: int, data: bytes | bytearray) -> None:
        """Pass a frame of the drive to the conversation."""
        if self.conversation is not None:
            self.conversation.receive(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))

    def refuse(self, error: DriveError, now: float) -> None:
        """Record why the drive cannot take part in the cycle; another attempt to configure it follows later."""
        self.refused, self.retry_at = str(error), now + RETRY_AFTER

    def end(self) -> None:
        """Abandon the conversation, if there is one."""
        self.is_next = False
        if self.conversation is not None:
            self.conversation.close()
            self.conversation = self.client = None

    def interrupt(self) -> None:
        """Abandon a conversation whose last request the drive may still be handling."""
        self.end()

    def unready(self, *, blocked: bool) -> Unready | None:
        """Return the reason why the drive cannot be reset yet. If `blocked`, it waits until no drive has power."""
        axis, name = self.axis, f"drive {self.axis.name}"
        if axis.configured:
            return None
        if self.refused:
            return Unready(self.refused)
        answered = self.client.answered if self.client is not None else 0
        reason = self.cause or ("answers again" if answered else "")
        if not reason:
            return Unready(f"{name} does not answer")
        if blocked:
            return Unready(f"{name} {reason}: the drive is configured once no drive has power")
        return Unready(f"{name} {reason}: {self.work}", answered, self.requests, self.counted)


class Recovery(Generic[AnyAxis, Setup, StartState]):
    """Recovery of all drives. Call `step` after the setpoints of each cycle."""

    def __init__(self, wire: Wire, bits: float, each: Sequence[ReturningDrive[AnyAxis, Setup, StartState]]) -> None:
        """`bits` is the number of bit times in a cycle."""
        self._wire = wire
        self._sender = CycleSender(wire)
        self._each = each
        self._turn = 0
        self._steps_per_cycle = min(float(len(each)), bits / STEP_BITS)
        self._steps_due = 0.0
        self._now = 0.0
        self._stopping = False

    @property
    def setups(self) -> list[Setup]:
        """Last complete set-ups of the drives that have had one."""
        return [each.setup for each in self._each if each.setup is not None]

    @property
    def idle(self) -> bool:
        """Whether every drive is configured."""
        return all(each.axis.configured for each in self._each)

    @property
    def unready(self) -> UnreadyDrives:
        """For each drive, the reason why it cannot be reset yet."""
        if self.idle:
            return None, None, None
        a, b, c = (each.unready(blocked=self._blocked) for each in self._each)
        return a, b, c

    @property
    def _blocked(self) -> bool:
        """Whether any drive may have power."""
        return any(each.may_have_power(stopping=self._stopping) for each in self._each)

    def is_configuring(self, axis: Axis) -> bool:
        """Whether a drive is being configured or is next to be configured."""
        return any(each.axis is axis and (each.is_next or each.conversation is not None) for each in self._each)

    def step(self, now: float, *, stopping: bool) -> None:
        """Advance the set-up of the drives whose turn it is. `stopping`: drives may still be on their ramps."""
        for each in self._each:
            _restart_after_boot(each)
        if self.idle:
            return
        self._stopping = stopping
        if self._blocked:
            for each in self._each:
                each.interrupt()
            return
        # The sum is bounded: otherwise steps that no drive could use would accumulate and cause a burst.
        self._steps_due = min(self._steps_due + self._steps_per_cycle, max(1.0, self._steps_per_cycle))
        for _ in self._each:
            if self._steps_due < 1.0:
                return
            self._turn = (self._turn + 1) % len(self._each)
            each = self._each[self._turn]
            if not each.axis.configured and each.settled and now >= each.retry_at:
                self._continue(each, now)
                self._steps_due -= 1.0

    def abandon(self) -> None:
        """Abandon every conversation, because no boot-up message can be received while the bus is lost."""
        for each in self._each:
            each.refused, each.retry_at = "", -math.inf
            each.end()

    def _continue(self, each: ReturningDrive[AnyAxis, Setup, StartState], now: float) -> None:
        self._now = now
        if each.conversation is None:
            each.is_next = True
            if not each.has_answered(now):
                return
            each.axis.forget_power_state()
            conversation, each.client = each.start_setup(self._sender, lambda: self._now)
            each.conversation = BackgroundConversation(conversation)
        end = each.conversation.step(now)
        if end is None:
            return
        answered = each.client.answered if each.client is not None else 0
        each.end()
        if isinstance(end, DriveTimeout):  # the drive has disappeared again, or never appeared
            each.refused, each.axis.silent = "", True
            each.axis.restarted = each.axis.restarted and not isinstance(end, DriveAbsentError)
        elif isinstance(end, DriveError):
            each.refuse(end, now)
        else:
            try:
                warning = each.accept(*end)
            except DriveError as error:
                each.refuse(error, now)
                return
            if warning:
                self._wire.warn(warning)
            # Warn only of new notes; those of the previous set-up have already been reported.
            known = each.setup.notes if each.setup is not None else ()
            for line in merge_notes([(each.axis.name, [note for note in end[0].notes if note not in known])]):
                self._wire.warn(line)
            each.record_setup(end[0], answered)


def _restart_after_boot(each: ReturningDrive[Any, Any, Any]) -> None:
    """Restart the set-up of a drive that has booted again, and end the conversation of a configured drive."""
    if each.boots != each.axis.boots:
        each.boots, each.refused, each.retry_at = each.axis.boots, "", -math.inf
        each.booted_at = each.axis.syncs
        each.end()
    if each.axis.configured:
        each.end()
