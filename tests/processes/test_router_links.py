"""What is told of the links to routers: each change once, and a warning for as long as one lacks."""

from __future__ import annotations

import threading

import pytest
from processes.test_gateway import Rig
from processes.test_gateway import rig as rig  # noqa: PLC0414 - a fixture
from refusals import uncoded
from rigs import Clock
from trirail.processes.zenoh_links import DIAGNOSIS_PERIOD_S, ROUTER_GRACE_S, RouterLinks
from trirail.wire.messages import Notice

HUB = "tls/192.0.2.9:7447"
DOWN = f"no link to the router {HUB}: connection refused; the connection is retried, and local control continues"


class Net:
    """A router as the links see it."""

    def __init__(self) -> None:
        self.there, self.why, self.asked = False, "connection refused", 0
        self.told: list[Notice] = []
        self.clock = Clock()
        self.links = RouterLinks(
            [HUB], lambda: {HUB} if self.there else set(), self.why_not, self.told.append, self.clock
        )

    def why_not(self, _: str) -> str:
        self.asked += 1
        return self.why

    def wait(self, seconds: float) -> None:
        """Let time pass, look every second, and let what is asked be answered."""
        for _ in range(round(seconds)):
            self.clock.now += 1.0
            self.links.poll()
            self.links._asking.submit(lambda: None).result()


def test_nothing_is_said_of_a_router_that_is_there_soon() -> None:
    net = Net()
    net.wait(ROUTER_GRACE_S - 1)
    assert (net.told, net.links.warnings(), net.asked) == ([], (), 0)
    net.there = True
    net.wait(100)
    assert uncoded(net.told) == [Notice("service", "info", f"linked to the router {HUB}")]
    assert net.links.warnings() == ()


def test_a_router_that_does_not_answer_is_told_once_and_warned_of_until_it_does() -> None:
    net = Net()
    net.wait(100)
    assert uncoded(net.told) == [Notice("service", "warning", DOWN)]
    assert net.links.warnings() == (DOWN,)
    assert net.asked <= 100 / DIAGNOSIS_PERIOD_S + 1
    net.there = True
    net.wait(2)
    assert uncoded(net.told[1:]) == [Notice("service", "info", f"linked to the router {HUB}")]
    assert net.links.warnings() == ()


def test_a_link_that_is_lost_is_told_at_once_with_why() -> None:
    net = Net()
    net.there = True
    net.wait(10)
    net.there = False
    net.wait(3)
    assert uncoded(net.told[1:]) == [Notice("service", "warning", DOWN)]
    net.why = "the server's certificate has the name stray, expected hub"
    net.wait(2 * DIAGNOSIS_PERIOD_S)
    assert net.links.warnings() == (DOWN.replace("connection refused", net.why),)
    assert len(net.told) == 2


def test_nobody_waits_for_the_answer_why_there_is_none() -> None:
    net, answered = Net(), threading.Event()
    net.why = ""
    net.links._why_not = lambda _: str(answered.wait() and "")
    for _ in range(20):
        net.clock.now += 1.0
        net.links.poll()
    assert net.told == []
    answered.set()
    net.wait(2)
    assert [remark.level for remark in net.told] == ["warning"]


def test_whatever_answers_there_ends_nothing() -> None:
    net = Net()
    net.links._why_not = lambda _: str(bytes.fromhex("no certificate"))
    net.wait(100)
    assert [remark.level for remark in net.told] == ["warning"]
    assert "ValueError" in net.told[0].message


def test_without_routers_nothing_is_looked_at() -> None:
    links = RouterLinks([], lambda: pytest.fail("looked"), lambda _: "", lambda _: None)
    links.poll()
    assert links.warnings() == ()


def test_the_gateway_has_the_loop_tell_of_it_and_warns(rig: Rig) -> None:
    gateway = rig.gateway
    assert gateway.warnings() == ()
    gateway._routers._routers, net = Net().links._routers, gateway._routers
    net._why_not, net._routers[0].ask_at = lambda _: "connection refused", 0.0
    net.poll()
    net._asking.submit(lambda: None).result()
    net._due = 0.0
    net.poll()
    assert uncoded(rig.sent) == [Notice("service", "warning", DOWN)]
    assert gateway.warnings() == (DOWN,)
