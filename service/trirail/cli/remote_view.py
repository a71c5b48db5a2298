"""Live view that is drawn on this machine from the records, events and states that services publish through Zenoh."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence
from types import TracebackType

import msgspec
import numpy as np
import zenoh
from zenoh.ext import HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from trirail.client.samples import SampleReader
from trirail.errors import ServiceError
from trirail.telemetry.columns import SECOND
from trirail.telemetry.drawn_robot import DrawnRobot
from trirail.telemetry.readout import ReadoutState
from trirail.telemetry.sinks import Relay, free_port, live_relay, live_server
from trirail.telemetry.streams import LIVE_HZ, MissingDataReport, Streams, open_together
from trirail.wire import zenoh_session
from trirail.wire.credentials import Credentials
from trirail.wire.messages import Event
from trirail.wire.records import unpack
from trirail.wire.state import Info, State
from trirail.wire.vocabulary import MODES

HISTORY_MB = 256.0
"""Memory for the history shown to viewers that connect late [1e6 bytes]. Nothing else runs in this process."""
FIRST_RECORDS_TIMEOUT_S = 5.0
"""Time-out for the first records [s]."""
SILENCE_S = 2.0
"""Time without messages after which the last ones are shown, although no records follow them [s]."""
MISSING = "missing data: {} cycles on the way here, {} batches in this view (viewer too slow)"


class RemoteView:
    """Live view of one robot, or of several side by side, for viewers on this machine while the context is open.

    Raises ServiceError if no records arrive from one of the robots.
    """

    def __init__(self, robots: Sequence[Info], connect: str, credentials: Credentials | None = None) -> None:
        self._session = zenoh_session.open_client(connect, credentials)
        self.ended = threading.Event()
        """Set when the service of a robot has been restarted. Its times begin again, so this view cannot continue."""
        self.robots: list[RemoteRobot] = []
        """Robots that are drawn, in the order of the argument `robots`."""
        try:
            for info in robots:
                root = f"/{info.robot}" if len(robots) > 1 else ""
                self.robots.append(RemoteRobot(info, self._session, f"{info.robot} from {connect}", root, self.ended))
            server = live_server(free_port(), HISTORY_MB)
        except BaseException:
            self._session.close()  # type: ignore[no-untyped-call]
            raise
        self.url = server.uri
        """Address for viewers on this machine."""
        if len(self.robots) == 1:
            stream = self.robots[0].streams.open(server)
        else:
            names = ", ".join(info.robot for info in robots)
            stream = open_together([robot.streams for robot in self.robots], f"{names} from {connect}", server)
        self.relay = live_relay(stream)
        for robot in self.robots:
            robot.draw(self.relay)

    def __enter__(self) -> RemoteView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop drawing."""
        self._session.close()  # type: ignore[no-untyped-call]
        for robot in self.robots:
            robot.end()
        self.relay.close()


class RemoteRobot:
    """Received data of one robot, and its drawing. Raises ServiceError if no records arrive.

    `ended` is set when the service has been restarted; nothing is drawn from then on.
    Wall-clock times are based on this machine's clock at the first record, so they are late by the network delay. The
    times of events are those of their cycles, because the service's clock may differ.
    """

    def __init__(self, info: Info, session: zenoh.Session, name: str, root: str, ended: threading.Event) -> None:
        self.restarted = False
        """Whether the service has been restarted."""
        self._ended = ended
        self._queue: queue.SimpleQueue[Event | State | bytes | None] = queue.SimpleQueue()
        self.lost = 0
        """Number of cycles that were lost between the service and this program."""
        self._cycle: int | None = None
        self._bus_load: float | None = None
        self._mode: int | None = None
        """Mode in the newest state, as an index in MODES; None before the first state."""
        self._session = session
        self._reader = SampleReader()
        self._subscribe(info.robot)
        self._first_records = self._first(info)
        self._newest: np.void = unpack(self._first_records)[-1]
        self._offset_ns = time.time_ns() - int(self._newest["deadline_ns"])
        self._rate_hz = info.rate_hz
        self.streams = Streams(DrawnRobot.from_info(info), name, self._offset_ns, root)
        self._thread = threading.Thread(target=self._run, name=f"records of {info.robot}", daemon=True)

    def draw(self, relay: Relay) -> None:
        """Start drawing in a thread."""
        self.streams.attach(relay, LIVE_HZ)
        self._missing = MissingDataReport(self.streams, MISSING, lambda: (self.lost, relay.skipped))
        self._records(self._first_records)
        self._thread.start()

    def end(self) -> None:
        """Draw the data that has arrived, then stop drawing."""
        self._queue.put(None)
        self._thread.join()

    def _subscribe(self, robot: str) -> None:
        heard, declare = self._reader, self._session.declare_subscriber
        self._declared = [
            declare(zenoh_session.key(robot, "records"), heard.batches(self._queue.put)),
            declare(zenoh_session.key(robot, "state"), heard.messages(State, self._queue.put)),
            declare_advanced_subscriber(
                self._session,
                zenoh_session.key(robot, "event"),
                heard.messages(Event, self._queue.put),
                history=HistoryConfig(detect_late_publishers=True),
                recovery=RecoveryConfig(periodic_queries=None, heartbeat=True),
            ),
        ]

    def _first(self, info: Info) -> bytes:
        """Return the first records; put earlier items back into the queue, after these records."""
        deadline = time.monotonic() + FIRST_RECORDS_TIMEOUT_S
        before: list[Event | State | None] = []
        while (left := deadline - time.monotonic()) > 0.0:
            try:
                item = self._queue.get(timeout=left)
            except queue.Empty:
                break
            if isinstance(item, bytes):
                for earlier in before:
                    self._queue.put(earlier)
                return item
            before.append(item)
        raise ServiceError(
            f"robot {info.robot!r} answers, but sends no records within {FIRST_RECORDS_TIMEOUT_S:g} s: "
            "check that this user may read them, and that every router on the way forwards them"
        )

    def _run(self) -> None:
        timeout: float | None = SILENCE_S
        while not self.restarted:
            try:
                item = self._queue.get(timeout=timeout)
            except queue.Empty:
                self._show_silence()
                timeout = None
                continue
            timeout = SILENCE_S
            if item is None:
                self.streams.flush()
                return
            if isinstance(item, bytes):
                self._records(item)
            elif isinstance(item, Event):
                self.streams.event(self._on_this_clock(item))
            else:
                self._state(item)

    def _show_silence(self) -> None:
        """Show the last events and the last mode, although no records follow, for example because the loop has died."""
        self.streams.log("warning", f"no messages for {SILENCE_S:g} s: service ended or connection lost")
        if self._mode is not None and self._newest["mode"] != self._mode:
            last = self._newest.copy()
            last["cycle"], last["mode"] = last["cycle"] + 1, self._mode
            self.streams.records(last.tobytes())
        self.streams.flush()

    def _records(self, batch: bytes) -> None:
        cycles = unpack(batch)["cycle"]
        if self._cycle is not None:
            if cycles[0] <= self._cycle:
                self.restarted = True
                self._ended.set()
                return
            self.lost += int(cycles[0]) - self._cycle - 1
        self._cycle = int(cycles[-1])
        self._newest = unpack(batch)[-1]
        self.streams.records(batch)
        self._missing.check()
        self.streams.save()  # past data arrives together; in separate batches it would be skipped

    def _on_this_clock(self, event: Event) -> Event:
        """Return an event with the time of its cycle on this machine's clock."""
        since = (event.cycle - int(self._newest["cycle"])) / self._rate_hz
        wall = (int(self._newest["deadline_ns"]) + self._offset_ns) / SECOND + since
        return msgspec.structs.replace(event, time=wall)

    def _state(self, state: State) -> None:
        self._mode = MODES.index(state.mode)
        goal, target = (state.goal.id, state.goal.target) if state.goal else (None, None)
        self.streams.update_state(ReadoutState(goal, target, state.override, "; ".join(state.faults) or None))
        if state.loop.bus_load != self._bus_load:
            self._bus_load = state.loop.bus_load
            self.streams.bus_load(state.loop.bus_load)
