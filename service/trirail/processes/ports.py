"""Ports on which the loop accepts the other processes, and the loop's links to the gateway and the planner."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from trirail.processes.heartbeats import Watch
from trirail.wire.decoding import INVALID
from trirail.wire.event_codes import EventCode, EventText, coded
from trirail.wire.links import Port
from trirail.wire.packets import CommandRequest, PlannerLost, Request, decode_request
from trirail.wire.plan_packets import PlanAnswer, PlanRequest, decode_plan_answer, encode
from trirail.wire.vocabulary import Command


class Ports(NamedTuple):
    """Ports on which the loop accepts connections of the other processes."""

    gateway: Port
    recorder: Port
    planner: Port


REQUESTS_A_CYCLE = 4
"""Maximum number of requests handled in one cycle. At 1 kHz, this is more than the gateway sends on average."""
URGENT_REQUESTS_A_CYCLE = 128
"""Maximum number of requests handled in a cycle with an urgent stop.

The gateway never has more requests in progress. Therefore the stop does not wait for earlier requests, and no earlier
request is handled after the stop.
"""
ANSWERS_A_CYCLE = 2
"""Maximum number of the planner's packets handled in one cycle. The planner works on one request at a time."""


class GatewayLink:
    """Link to the gateway, which receives requests and detects the loss of the gateway."""

    def __init__(self, port: Port, watch: Watch, timeout: float) -> None:
        self._port = port
        self._watch = watch
        self._timeout = timeout
        self._in_hand: list[Request] = []
        self.frozen = False
        """True if the heartbeat of the gateway is missing."""

    @property
    def ended(self) -> bool:
        """True if the gateway has disconnected, but no attempt to receive or send has noticed that yet."""
        return self._port.ended

    def read(self, limit: int = REQUESTS_A_CYCLE) -> None:
        """Read at most `limit` requests, by default as many as can be handled in one cycle.

        Nothing is read from a frozen gateway until its heartbeat returns. If the gateway sends an invalid packet, it is
        disconnected. The supervisor then restarts the gateway.
        """
        for _ in range(0 if self.frozen else limit):
            packet = self._port.receive()
            if packet is None:
                return
            try:
                self._in_hand.append(decode_request(memoryview(packet)[1:]))
            except INVALID:
                self._port.hang_up()

    @property
    def has_quick_stop(self) -> bool:
        """True if a quick stop is among the requests that have been read but not handled."""
        quick_stop = Command.QUICK_STOP
        return any(isinstance(each, CommandRequest) and each.name is quick_stop for each in self._in_hand)

    def requests(self) -> Iterator[Request]:
        """Yield the requests that have been read but not handled; none while the gateway is frozen."""
        while self._in_hand and not self.frozen:
            yield self._in_hand.pop(0)

    def lost(self) -> EventText | None:
        """Check the gateway, once per cycle. Return a message if the gateway was lost in this cycle, else None.

        If the gateway has disconnected, requests that were read but not handled are dropped, because no client could
        stop their effects.
        """
        if self._port.clear_lost():
            self.frozen = False
            self._in_hand.clear()
            return coded("the gateway has died: controlled stop", EventCode.GATEWAY_LOST)
        if self._watch.silent():
            if not self.frozen:
                self.frozen = True
                words = f"the gateway is frozen, without a sign of life for {self._timeout:g} s: controlled stop"
                return coded(words, EventCode.GATEWAY_FROZEN, timeout=self._timeout)
        elif self._watch.has_beat:
            self.frozen = False
        return None


class PlannerLink:
    """Link to the planner, which implements trirail.control.plan_requests.PlannerPort."""

    def __init__(self, port: Port) -> None:
        self._port = port
        self._awaited: int | None = None
        self._unsent: str | None = None
        self._in_hand: list[PlanAnswer | PlannerLost] = []

    @property
    def idle(self) -> bool:
        """True if every failure to send a request has been reported."""
        return self._unsent is None

    def request_plan(self, request: PlanRequest) -> None:
        """Send a request to the planner. If that fails, `read` reports the failure in the next cycle."""
        if self._port.send(encode(request)):
            self._awaited = request.number
        elif self._port.connected:
            self._unsent = "the queue of requests to the planner is full"
        else:  # perhaps since this attempt, which was the first to notice that the planner has died
            self._unsent = "the planner is not running and is being restarted"

    def answers(self) -> Iterator[PlanAnswer | PlannerLost]:
        """Yield the answers and reports that have been read but not handled."""
        while self._in_hand:
            yield self._in_hand.pop(0)

    def read(self, prepare: Callable[[PlanAnswer | PlannerLost], None]) -> None:
        """Read the planner's answers, and reports that a request was lost, and call `prepare` with each of them."""
        for answer in self._received():
            prepare(answer)
            self._in_hand.append(answer)

    def _received(self) -> Iterator[PlanAnswer | PlannerLost]:
        """Yield the planner's answers, and reports that a request was lost. Ignore answers without a request."""
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
            except INVALID as error:  # the supervisor restarts such a planner
                self._port.hang_up()
                self._awaited = None
                yield PlannerLost(f"the planner has sent an invalid packet, {error}")
                return
            if answer.number == self._awaited:
                self._awaited = None
            yield answer
        if self._port.clear_lost() and self._awaited is not None:
            self._awaited = None
            yield PlannerLost("the planner has died")

    def accept(self) -> None:
        """Accept the connection of a new planner, if one is waiting."""
        self._port.accept()
