"""Events for clients: each one once, whatever restarts and however the machine's clock is set."""

from __future__ import annotations

import asyncio
import json
import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace
from trirail.client.async_client import AsyncRobot
from trirail.client.connection import Connection, once
from trirail.client.goal import AsyncGoalHandle
from trirail.config import SIM, load
from trirail.processes.order import Order
from trirail.processes.publications import EVENTS_KEPT, Publications
from trirail.wire.messages import Event, Notice
from waiting import WITHIN, wait_until

ACTS = ["event", "gateway restarts", "service restarts", "clock set back", "clock set on"]
STEPS = {"clock set back": -500.0, "clock set on": 500.0}


@pytest.fixture
def lossy(tmp_path: Path) -> Iterator[tuple[zenoh.Session, Connection]]:
    """A service's session that loses every event but the first, as one does whose client is too slow; and a client."""
    at, event = f"unixsock-stream/{tmp_path}/z", "trirail/demo/event"
    rule = {"id": "lost", "messages": ["put"], "flows": ["egress"], "rules": [{"key_expr": event, "freq": 0.001}]}
    settings = {
        "mode": "peer", "listen": {"endpoints": [at]}, "timestamping": {"enabled": True}, "downsampling": [rule],
        "scouting": {"multicast": {"enabled": False}},
    }  # fmt: skip
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as service:
        connection = Connection("demo", at)
        yield service, connection
        connection.close()


def matches(sender: Any) -> bool:
    """Whether somebody listens; zenoh's stub takes the status for a bool."""
    return bool(sender.matching_status.matching)


def test_a_client_receives_events_that_were_lost_the_last_too(lossy: tuple[zenoh.Session, Connection]) -> None:
    service, connection = lossy
    published = Publications(service, "demo", "r")
    received: queue.Queue[Event] = queue.Queue()
    with connection.subscribe_to_events(received.put, history=False):
        heard = service.declare_publisher("trirail/demo/event")
        wait_until(lambda: matches(heard))
        for number in range(1, 6):
            published.event(Notice("service", "info", "x").event(number, 1.0, 1, 10.0))
        assert [received.get(timeout=WITHIN).seq for _ in range(5)] == [1, 2, 3, 4, 5]


def test_a_goal_that_ends_in_events_that_the_service_no_longer_has_is_marked(
    lossy: tuple[zenoh.Session, Connection], tmp_path: Path
) -> None:
    service, _ = lossy
    published = Publications(service, "demo", "r")

    async def wait() -> None:
        async with AsyncRobot("demo", f"unixsock-stream/{tmp_path}/z") as robot:
            goal = robot._goals.open(AsyncGoalHandle("g", robot.command, robot.role, lambda: robot._is_present("g")))
            heard = service.declare_publisher("trirail/demo/event")
            await asyncio.to_thread(wait_until, lambda: matches(heard))
            for number in range(1, EVENTS_KEPT + 5):
                published.event(Notice("service", "info", "x").event(number, 1.0, 1, 10.0))
                if number == 1:
                    await asyncio.to_thread(wait_until, lambda: robot._newest == {"r": 1})
            await asyncio.to_thread(wait_until, lambda: goal._missed == "events 2 to 4")

    asyncio.run(wait())


def test_no_client_makes_the_gateway_remember_its_heartbeats(lossy: tuple[zenoh.Session, Connection]) -> None:
    """For every session that subscribed to them, Zenoh 1.10.2 kept 4 kB while another client was connected."""
    service, connection = lossy
    of_events, of_heartbeats = map(
        service.declare_publisher, ("trirail/demo/event", "trirail/demo/event/@adv/pub/1/2/_")
    )
    with connection.subscribe_to_events(lambda _: None, history=True):
        wait_until(lambda: matches(of_events))
        with (
            connection.open_session() as session,
            session.declare_subscriber("last", lambda _: None),
        ):  # all before it has arrived
            arrived = service.declare_publisher("last")
            wait_until(lambda: matches(arrived))
            assert not matches(of_heartbeats)


@given(acts=st.lists(st.sampled_from(ACTS), max_size=20))
@example(acts=["event", "event", "clock set back", "service restarts", "event", "event", "event"])
@example(acts=["event", "clock set back", "event", "gateway restarts"])
def test_each_event_is_delivered_once(acts: list[str]) -> None:
    delivered: list[Event] = []
    deliver = once(delivered.append)
    sent: list[Event] = []
    run, past, time = 0, 0, 1000.0
    for act in acts:
        time += STEPS.get(act, 1.0)
        if act == "event":
            event = Notice("service", "info", "x").event(len(sent) - past + 1, 1.0, 1, time)
            sent.append(replace(event, run=str(run)))
            deliver(sent[-1])
        elif act == "gateway restarts":
            for event in sent[past:]:
                deliver(event)
        elif act == "service restarts":
            run, past = run + 1, len(sent)
    assert delivered == sent


def test_without_an_identity_a_later_time_tells_a_restart() -> None:
    """Services of earlier versions send none."""
    delivered: list[Event] = []
    deliver = once(delivered.append)
    first, second = (Notice("service", "info", "x").event(number, 1.0, 1, 10.0 + number) for number in (1, 2))
    restarted = Notice("service", "info", "x").event(1, 1.0, 1, 20.0)
    for event in (first, second, first, second, restarted, restarted):
        deliver(event)
    assert delivered == [first, second, restarted]


def test_every_run_of_a_service_has_an_identity_of_its_own() -> None:
    config = load(SIM)
    assert Order(config, None).run != Order(config, None).run != ""
    order = Order(config, None)
    assert replace(order, again=True).run == order.run
