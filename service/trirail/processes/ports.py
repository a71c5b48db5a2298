"""Where the processes beside the loop connect, and the loop's side of the planner."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import msgspec

from trirail.wire.links import Port
from trirail.wire.packets import PlannerLost
from trirail.wire.plan_packets import PlanAnswer, PlanRequest, decode_plan_answer, encode


class Ports(NamedTuple):
    """One for each of them."""

    gateway: Port
    recorder: Port
    planner: Port


ANSWERS_A_CYCLE = 2
"""Packets of the planner's that are taken in one cycle: it has been asked once."""


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
