"""Ports for the processes beside the loop, and the loop's sides of gateway and planner."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from trirail.processes.heartbeats import Watch
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.links import Port
from trirail.wire.packets import PlannerLost, Request, decode_request
from trirail.wire.plan_packets import PlanAnswer, PlanRequest, decode_plan_answer, encode


class Ports(NamedTuple):
    """One port for each of them."""

    gateway: Port
    recorder: Port
    planner: Port


REQUESTS_A_CYCLE = 4
"""Requests that are handled in one cycle: at 1 kHz more than the gateway sends on average."""
URGENT_REQUESTS_A_CYCLE = 128
"""Requests that are handled in a cycle with an urgent stop: more than the gateway has under way at a time, so that
a stop waits for none of those sent before it, and none of these begins after it."""
ANSWERS_A_CYCLE = 2
"""Packets of the planner that are handled in one cycle: it has one request at a time."""


class GatewayLink:
    """Requests of the gateway, and whether it is alive."""

    def __init__(self, port: Port, watch: Watch, timeout: float) -> None:
        self._port = port
        self._watch = watch
        self._timeout = timeout
        self._in_hand: list[Request] = []
        self.frozen = False
        """Whether it gives no sign of life."""

    @property
    def ended(self) -> bool:
        """Whether it has gone, and receiving or sending has not found that yet."""
        return self._port.ended

    @property
    def postponed(self) -> bool:
        """Whether requests have been read and not handled."""
        return bool(self._in_hand)

    def read(self, limit: int = REQUESTS_A_CYCLE) -> None:
        """Read its packets, `limit` requests at most: no more than a cycle has time for.

        Nothing is read from a frozen gateway until it serves again. One that sends an unreadable packet is
        disconnected, and started again.
        """
        for _ in range(0 if self.frozen else limit):
            packet = self._port.receive()
            if packet is None:
                return
            try:
                self._in_hand.append(decode_request(memoryview(packet)[1:]))
            except msgspec.DecodeError:
                self._port.hang_up()

    def requests(self) -> Iterator[Request]:
        """Yield the requests that have been read."""
        while self._in_hand and not self.frozen:
            yield self._in_hand.pop(0)

    def lost(self) -> EventText | None:
        """Return how it has been lost in this cycle, to be called once in each; None if it has not.

        Its requests that were read and not handled are dropped: nobody is there to stop their effects.
        """
        if self._port.clear_lost():
            self.frozen = False
            self._in_hand.clear()
            return coded("the gateway is gone: controlled stop", EventCode.GATEWAY_LOST)
        if self._watch.silent():
            if not self.frozen:
                self.frozen = True
                words = f"the gateway is frozen, no sign of life for {self._timeout:g} s: controlled stop"
                return coded(words, EventCode.GATEWAY_FROZEN, timeout=self._timeout)
        elif self._watch.heard:
            self.frozen = False
        return None


class PlannerLink:
    """Requests of the control to the planner: trirail.control.plan_requests.PlannerPort."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._awaited: int | None = None
        self._unsent: str | None = None

    @property
    def idle(self) -> bool:
        """Whether there is nothing to report that the planner does not report itself."""
        return self._unsent is None

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request; a failure is reported in the next cycle."""
        if not self._port.connected:
            self._unsent = "the planner is not there, it is being started again"
        elif not self._port.send(encode(request)):
            self._unsent = "the planner cannot be asked, it takes no more"
        else:
            self._awaited = request.number

    def answers(self) -> Iterator[PlanAnswer | PlannerLost]:
        """Yield the answers for the control; answers without a request are ignored."""
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
            except msgspec.DecodeError as error:  # a planner that sends such packets is started again
                self._port.hang_up()
                self._awaited = None
                yield PlannerLost(f"the planner has said something unreadable, {error}")
                return
            if answer.number == self._awaited:
                self._awaited = None
            yield answer
        if self._port.clear_lost() and self._awaited is not None:
            self._awaited = None
            yield PlannerLost("the planner has died")

    def accept(self) -> None:
        """Accept a new planner."""
        self._port.accept()
