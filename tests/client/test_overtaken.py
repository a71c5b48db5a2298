"""A state that is asked for after an answer or an event shows what that has told, however late states arrive."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from trirail.client import connection
from trirail.client.async_client import AsyncRobot
from trirail.client.client import Robot
from trirail.config import SIM, load
from trirail.processes.publications import StateMaker
from trirail.wire import zenoh_session
from trirail.wire.messages import CommandReply, Event
from trirail.wire.records import DTYPE
from waiting import WITHIN

BEHIND = 20
"""States that are still to be published when the service answers of the one that shows it."""


class Service:
    """Publishes states one after the other; what it answers and tells of is shown by a later one."""

    def __init__(self, session: zenoh.Session) -> None:
        self.seq, self.known = 1000, 0
        self._session = session
        self._states = StateMaker(load(SIM))
        self._over = threading.Event()
        answer = zenoh.handlers.Callback(self._answer, indirect=False)
        self._declared = session.declare_queryable("trirail/demo/cmd/**", answer)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()

    def event(self) -> None:
        self.known = self.seq + BEHIND
        event = Event("mode", "info", "holding", mode="holding", seq=self.known, t=0.0, cycle=self.known, time=0.0)
        self._session.put("trirail/demo/event", msgspec.json.encode(event))

    def _answer(self, query: zenoh.Query) -> None:
        self.known = self.seq + BEHIND
        with query:
            query.reply(query.key_expr, msgspec.json.encode(CommandReply("pause", "holding", self.known)))

    def _publish(self) -> None:
        rows = np.zeros(1, DTYPE)
        while not self._over.wait(0.005):
            self.seq += 1
            rows["cycle"] = self.seq
            self._states.records(rows)
            self._session.put("trirail/demo/state", msgspec.json.encode(self._states.newest()))


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "MAX_OVERTAKEN_S", WITHIN)


@pytest.fixture
def locator(tmp_path: Path) -> str:
    return f"unixsock-stream/{tmp_path}/zenoh"


@pytest.fixture
def service(locator: str) -> Iterator[Service]:
    with zenoh_session.open_service([locator]) as session:
        service = Service(session)
        try:
            yield service
        finally:
            service.close()


@pytest.mark.parametrize("command", [Robot.pause, Robot.override])
def test_after_an_answer(service: Service, locator: str, command: Callable[..., object]) -> None:
    with Robot("demo", locator) as robot:
        command(robot, *((50.0,) if command is Robot.override else ()))
        assert robot.state().seq >= service.known > BEHIND


def test_after_the_second_answer_too(service: Service, locator: str) -> None:
    with Robot("demo", locator) as robot:
        robot.pause()
        service.seq += BEHIND
        robot.pause()
        assert robot.state().seq >= service.known > BEHIND


def test_after_an_answer_in_an_event_loop(service: Service, locator: str) -> None:
    async def main() -> int:
        async with AsyncRobot("demo", locator) as robot:
            await robot.stop()
            return (await robot.state()).seq

    assert asyncio.run(main()) >= service.known > BEHIND


def test_after_an_event(service: Service, locator: str) -> None:
    with Robot("demo", locator) as robot:
        over = threading.Event()

        def tell() -> None:
            while not over.wait(0.02):  # who listens since when is nobody's to know
                service.event()

        telling = threading.Thread(target=tell)
        telling.start()
        try:
            event = next(robot.events(timeout=WITHIN))
        finally:
            over.set()
            telling.join()
        assert robot.state(WITHIN).seq >= event.cycle > BEHIND


def test_a_service_that_was_started_again_and_counts_from_one_is_heard(
    service: Service, locator: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_OVERTAKEN_S", 0.05)
    with Robot("demo", locator) as robot:
        robot.pause()
        service.seq = 1
        assert robot.state().seq < service.known
