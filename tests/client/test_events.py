"""Events for clients: each one once, whatever restarts and however the machine's clock is set."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace
from trirail.client.connection import once
from trirail.config import SIM, load
from trirail.processes.order import Order
from trirail.wire.messages import Event, Notice

ACTS = ["event", "gateway restarts", "service restarts", "clock set back", "clock set on"]
STEPS = {"clock set back": -500.0, "clock set on": 500.0}


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
