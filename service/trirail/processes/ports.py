"""Where the processes beside the loop connect, and the loop's sides of gateway and planner."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from trirail.processes.heartbeats import Watch
from trirail.wire.links import Port
from trirail.wire.packets import PlannerLost, Request, decode_request
from trirail.wire.plan_packets import PlanAnswer, PlanRequest, decode_plan_answer, encode


class Ports(NamedTuple):
    """One for each of them."""

    gateway: Port
    recorder: Port
    planner: Port


REQUESTS_A_CYCLE = 4
"""Requests that are taken in one cycle: at 1 kHz more than the gateway can send, so that a stop waits for nothing."""
ANSWERS_A_CYCLE = 2
"""Packets of the planner's that are taken in one cycle: it has been asked once."""


class GatewayLink:
    """What the gateway asks for, and whether it lives."""

    def __init__(self, port: Port, watch: Watch, timeout: float) -> None:
        self._port = port
        self._watch = watch
        self._timeout = timeout
        self._in_hand: list[Request] = []
        self.frozen = False
        """Whether it gives no sign of life."""

    @property
    def ended(self) -> bool:
        """Whether it has gone, and that has not been found by receiving or sending yet."""
        return self._port.ended

    @property
    def postponed(self) -> bool:
        """Whether something has been read, and nobody has taken it up."""
        return bool(self._in_hand)

    def read(self) -> None:
        """Read what it has sent: as much as comes in a cycle, and no more than a cycle has time for.

        Nothing is read of what a frozen one has left, until it serves again. One that says what cannot be read has lost
        its mind: it is let go, and started again.
        """
        for _ in range(0 if self.frozen else REQUESTS_A_CYCLE):
            packet = self._port.receive()
            if packet is None:
                return
            try:
                self._in_hand.append(decode_request(memoryview(packet)[1:]))
            except msgspec.DecodeError:
                self._port.hang_up()

    def requests(self) -> Iterator[Request]:
        """Yield what has been read."""
        while self._in_hand and not self.frozen:
            yield self._in_hand.pop(0)

    def lost(self) -> str | None:
        """Return how it has been lost in this cycle, to be asked once in each; None where it has not.

        What has been read of it and not taken up goes with it: nobody is there who could stop what would come of that.
        """
        if self._port.take_lost():
            self.frozen = False
            self._in_hand.clear()
            return "the gateway is gone: controlled stop"
        if self._watch.silent():
            if not self.frozen:
                self.frozen = True
                return f"the gateway is frozen, no sign of life for {self._timeout:g} s: controlled stop"
        elif self._watch.heard:
            self.frozen = False
        return None


class PlannerLink:
    """Where the control asks the planner: trirail.control.plan_requests.PlannerPort."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._awaited: int | None = None
        self._unsent: str | None = None

    @property
    def idle(self) -> bool:
        """Whether there is nothing to be said that the planner does not say itself."""
        return self._unsent is None

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request; what cannot be sent is said in the next cycle."""
        if not self._port.connected:
            self._unsent = "the planner is not there, it is being started again"
        elif not self._port.send(encode(request)):
            self._unsent = "the planner cannot be asked, it takes no more"
        else:
            self._awaited = request.number

    def answers(self) -> Iterator[PlanAnswer | PlannerLost]:
        """Yield what there is to be given to the control; what was not asked for is left aside."""
        if self._unsent is not None:
            unsent, self._unsent = self._unsent, None
            yield PlannerLost(unsent)
        for _ in range(ANSWERS_A_CYCLE):
            packet = self._port.receive()
            if packet is None:
                break
            if self._awaited is None:
                continue
            try:
                answer = decode_plan_answer(packet)
            except msgspec.DecodeError as error:  # one that says such things is started again
                self._port.hang_up()
                self._awaited = None
                yield PlannerLost(f"the planner has said something unreadable, {error}")
                return
            if answer.number == self._awaited:
                self._awaited = None
            yield answer
        if self._port.take_lost() and self._awaited is not None:
            self._awaited = None
            yield PlannerLost("the planner has died")

    def accept(self) -> None:
        """Take a planner that comes anew."""
        self._port.accept()
