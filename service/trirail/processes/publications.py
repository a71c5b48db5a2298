"""What the gateway publishes for one robot: the state, every cycle's records, and events with their past."""

from __future__ import annotations

import msgspec
import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, RepliesConfig, declare_advanced_publisher

from trirail.wire import boundary, zenoh_session
from trirail.wire.messages import Event
from trirail.wire.state import RobotSummary, State

EVENTS_KEPT = 1000
"""So many events a client hears that asks for the past."""
_PAST = RepliesConfig(
    priority=zenoh.Priority.BACKGROUND, congestion_control=zenoh.CongestionControl.BLOCK, express=False
)


class Publications:
    """Publishers on a robot's keys. State and records are dropped where somebody is slow, events wait for them."""

    def __init__(self, opened: zenoh.Session, robot: str) -> None:
        def dropping(name: str, encoding: str, priority: zenoh.Priority) -> zenoh.Publisher:
            return opened.declare_publisher(
                zenoh_session.key(robot, name),
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
            )

        self._state = dropping("state", boundary.JSON, zenoh.Priority.DATA_HIGH)
        self._summary = dropping("summary", boundary.JSON, zenoh.Priority.DATA)
        self._records = dropping("records", boundary.BINARY, zenoh.Priority.DATA_LOW)
        self._event = declare_advanced_publisher(
            opened,
            zenoh_session.key(robot, "event"),
            encoding=boundary.JSON,
            # The past goes out in one burst, whole, in a queue of its own: who is slow to take it delays nothing else.
            cache=CacheConfig(max_samples=EVENTS_KEPT, replies_config=_PAST),
            sample_miss_detection=MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def state(self, state: State) -> None:
        """Publish the newest state."""
        self._state.put(msgspec.json.encode(state))

    def summary(self, summary: RobotSummary) -> None:
        """Publish the newest summary."""
        self._summary.put(msgspec.json.encode(summary))

    def records(self, batch: bytes) -> None:
        """Publish packed records, laid out as in wire.records."""
        self._records.put(batch)

    def event(self, event: Event) -> None:
        """Publish an event; who comes later hears it too."""
        self._event.put(msgspec.json.encode(event))
