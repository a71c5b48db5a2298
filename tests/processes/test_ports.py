"""What the loop takes from the gateway: nothing while it is frozen, and after its death nothing that it sent before."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st
from trirail.processes.heartbeats import Heartbeats, Watch
from trirail.processes.ports import GatewayLink
from trirail.wire import links
from trirail.wire.event_codes import EventCode
from trirail.wire.packets import CommandRequest, message
from trirail.wire.vocabulary import Command

PATIENCE = 2


class Turn(NamedTuple):
    """One cycle: what the gateway sends and whether it lives, and what the loop does."""

    sent: list[Command]
    beats: bool
    dies: bool
    limit: int
    handles: bool


TURNS = st.lists(
    st.builds(
        Turn,
        st.lists(st.sampled_from([Command.STOP, Command.ENABLE, Command.QUICK_STOP]), max_size=3),
        st.booleans(),
        st.sampled_from([False] * 3 + [True]),
        st.integers(0, 4),
        st.booleans(),
    ),
    min_size=10,
    max_size=40,
)


@given(TURNS)
def test_requests_are_handled_in_order_unless_the_gateway_is_frozen_or_has_died_before(turns: list[Turn]) -> None:
    heartbeats = Heartbeats.create()
    heart = heartbeats.heart("gateway")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "gateway"
        port = links.Port(links.listen(path))
        gateway, client = GatewayLink(port, Watch(heart, PATIENCE), 0.2), links.connect(path)
        assert port.accept()
        on_the_way: list[CommandRequest] = []
        in_hand: list[CommandRequest] = []
        dead = frozen = False
        new_beat = True
        ticket = silence = 0
        heart.beat()
        for turn in turns:
            for name in turn.sent * (not dead):
                ticket += 1
                on_the_way.append(CommandRequest(ticket, "ann", name))
                assert client.send(message(on_the_way[-1]))
            if turn.dies and not dead:
                while client.receive() is not None:  # otherwise the kernel drops what it has sent
                    pass
                client.close()
                dead = True
            if turn.beats:
                heart.beat()
                new_beat = True
            gateway.read(turn.limit)
            if not frozen:
                in_hand += on_the_way[: turn.limit]
                del on_the_way[: turn.limit]
            assert gateway.has_quick_stop == any(each.name is Command.QUICK_STOP for each in in_hand)
            if turn.handles:
                assert list(gateway.requests()) == ([] if frozen else in_hand)
                in_hand = in_hand if frozen else []
            port.send(b"state")  # this also notices the death of a frozen gateway
            lost = gateway.lost()
            if dead:
                assert lost is not None
                assert lost.code is EventCode.GATEWAY_LOST
                in_hand, on_the_way, dead, frozen = [], [], False, False
                client = links.connect(path)
                assert port.accept()
                continue
            silence, new_beat = 0 if new_beat else silence + 1, False
            freezes = silence > PATIENCE and not frozen
            assert (None if lost is None else lost.code) == (EventCode.GATEWAY_FROZEN if freezes else None)
            frozen = silence > PATIENCE or (frozen and silence > 0)
            assert gateway.frozen == frozen
        client.close()
        port.close()
