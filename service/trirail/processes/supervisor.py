"""Supervisor (`trirail run`), which starts, monitors and restarts the other processes, and ends them in order."""

from __future__ import annotations

import os
import selectors
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from trirail_drivers import files

from trirail.config import Config
from trirail.errors import ServiceError
from trirail.processes.compiling import Progress
from trirail.processes.ending import loop_ends_within
from trirail.processes.forked_processes import ChildProcess, ForkServerLink
from trirail.processes.heartbeats import PROCESSES, HangWatch, Heartbeats
from trirail.processes.monitoring import MIN_SILENT_CYCLES, Health, Running
from trirail.processes.operating_system import Signals, Starter, Watchdog, notify
from trirail.processes.order import Order
from trirail.processes.realtime import release_startup_memory
from trirail.processes.sockets import raise_descriptor_limit
from trirail.telemetry import provenance
from trirail.wire import links
from trirail.wire.credentials import Admission
from trirail.wire.messages import Event, Level

CHILDREN = ("gateway", "recorder", "loop", "planner")
"""Processes in the order of their start.

The first two need no compiled code, and therefore start while compiled code is being imported.
"""
CHILDREN_WITH_DRIVES = ("gateway", "recorder", "loop", "drives", "planner")
"""Processes in the order of their start, if the drives are simulated.

The loop runs its rehearsal while the drives start, and then waits for the drives.
"""
PORTS = ("gateway", "recorder", "planner")
"""Processes that connect to the loop, in the order of trirail.processes.ports.Ports."""
WATCHED_BY_SYSTEMD = ("loop", "gateway")
"""Essential processes, without whose heartbeats systemd ends the service. It survives the loss of other processes."""
CONSEQUENCES = {
    "gateway": "the loop stops the robot and holds its position",
    "planner": "the motion in progress continues, and new goals are refused",
    "recorder": "the robot is not affected",
    "drives": "the robot is in fault; restart the service to restart them",
}
"""Consequence for the robot if a process dies."""
START_WITHIN = 300.0
"""Maximum time for the processes to start, and for compiling each function at the first start [s]."""
FORKS_WITHIN = 5.0
"""Maximum time for the fork server to fork a child when the service has started [s]."""
END_WITHIN = 6.0
"""Maximum time for processes to end before they are killed [s]. The loop may need longer, see ending.loop_ends_within.
"""
RESTART_DURING_START = 1.0
"""Pause before the restart of a process that has ended during the start of the service [s].

It is long enough to notice that the loop has ended, in which case the process is not restarted.
"""
RESTART_PERIOD_S = 60.0
"""Time for which a restart counts [s]."""
RESTART_PAUSES_S = (0.0, 0.1, 0.3, 1.0, 3.0)
"""Pauses before the restarts of one process within RESTART_PERIOD_S [s].

The first restart is immediate, because the robot holds its position until the gateway is back. The pauses become
longer, so that the restarts are not used up while a short shortage of memory or processes lasts.
"""
CHECK_PERIOD_S = 0.1
"""Interval between two checks of the other processes [s]."""
MAX_SILENCE_S = 0.7
"""Maximum time without a heartbeat [s]. After that time, a process is killed as hung; see heartbeats.HangWatch."""
MAX_RECORDER_SILENCE_S = 5.0
"""Maximum time without a heartbeat of the recorder [s].

It is longer, because the recorder may wait for a disk, and no motion depends on the recorder.
"""
RETRY_PAUSE_S = 10.0
"""Pause before the recorder or the planner is restarted again after all RESTART_PAUSES_S [s].

If the gateway ends again after that number of restarts, the service ends.
"""


class Supervisor:
    """Supervisor of the service, which runs in the foreground.

    Parameters
    ----------
    record
        Recording file; None for a file that is named after the robot and the time.
    report
        Function called with each message about the processes and with the level of the message.
    on_event
        Function called once with each event of the service.

    """

    def __init__(
        self,
        config: Config,
        record: Path | None,
        report: Callable[[str, Level], None],
        on_event: Callable[[Event], None] = lambda _: None,
    ) -> None:
        self._order = Order(config, str(record) if record else None, _admission(config))
        self._record = self._order.record
        self._report = report
        self._on_event = on_event
        self._names = CHILDREN_WITH_DRIVES if config.can.interface == "simulated" else CHILDREN
        self._children: dict[str, ChildProcess] = {}
        self._selector = selectors.DefaultSelector()
        self._restarts: dict[str, list[float]] = {name: [] for name in self._names}
        self._due: dict[str, float] = {}
        self._started = dict.fromkeys(self._names, 0)
        self._heartbeats = Heartbeats.create()
        loop_silent = max(MAX_SILENCE_S, MIN_SILENT_CYCLES * config.period)
        self._patience = {
            "loop": loop_silent,
            "gateway": max(MAX_SILENCE_S, config.watchdogs.gateway_timeout),
            "planner": MAX_SILENCE_S,
            "recorder": MAX_RECORDER_SILENCE_S,
        }
        self._watches = {
            name: HangWatch(self._heartbeats.heart(name), seconds, CHECK_PERIOD_S)
            for name, seconds in self._patience.items()
        }
        self._health = Health(self._heartbeats, config.period, CHECK_PERIOD_S)
        self._watchdog = Watchdog([self._heartbeats.heart(name) for name in WATCHED_BY_SYSTEMD])
        self._starter = Starter()
        self._software = provenance.software()  # computed before the fork, so that restarted processes report the same
        self._replaced = False
        self._newest_event = 0
        self._next_turn = 0.0
        self._progress_at = 0.0
        self._ending = False
        self._failed = False
        self._loop_has_run = False
        self._loop_ends_within = max(END_WITHIN, loop_ends_within(config.drives))
        self._up = False

    def run(
        self, up: Callable[[dict[str, dict[str, Any]]], None], start_threads: Callable[[], None] = lambda: None
    ) -> int:
        """Run the service until a signal arrives or the service must end; return the exit code.

        `up` is called once when all processes are ready, with the ready message of each process. `start_threads` is
        called after the fork of the fork server. Before, this process must have a single thread.
        """
        raise_descriptor_limit()
        with _runtime_folder() as folder, Signals() as signals:
            self._listening = _listen(folder)
            self._selector.register(signals.reader, selectors.EVENT_READ, None)
            sockets = [listening.fileno() for listening in self._listening]
            self._parent = ForkServerLink(self._order, folder, self._heartbeats, sockets)
            self._selector.register(self._parent, selectors.EVENT_READ)
            try:
                start_threads()
                with _metrics_server(self._order.config, self._health):  # after the fork, because it starts a thread
                    self._run_children(up, signals)
            finally:
                self._parent.close()
                for listening in self._listening:
                    listening.close()
        return 1 if self._failed else 0

    def _run_children(self, up: Callable[[dict[str, dict[str, Any]]], None], signals: Signals) -> None:
        try:
            for name in self._names:
                self._start(name)
            self._watch(up, signals)
        finally:
            self._end()

    def _start(self, name: str) -> None:
        if name in PROCESSES:
            self._heartbeats.heart(name).rest()
        self._started[name] += 1
        record = self._record if name == "recorder" else None
        child = ChildProcess(self._parent, name, record, again=self._started[name] > 1)
        self._children[name] = child
        self._selector.register(child.pipe, selectors.EVENT_READ, child)

    def _watch(self, up: Callable[[dict[str, dict[str, Any]]], None], signals: Signals) -> None:
        progress = Progress(lambda words: self._report(words, "info"), START_WITHIN)
        began = time.monotonic()
        while not self._ending:
            keys = [key for key, _ in self._selector.select(CHECK_PERIOD_S)]
            self._receive_from_parent()
            senders: list[ChildProcess | None] = [key.data for key in keys if key.fileobj is not self._parent]
            # Handle the loop first: if the loop has ended, the other processes end because of that.
            for child in sorted(senders, key=lambda child: child is not self._children.get("loop")):
                if child is None:
                    self._on_signal(signals.first(), progress)
                elif not child.read_messages() and not self._ending:
                    self._on_end(child)
                if child is not None:
                    self._pass_on(child)
                while child is not None and child.compiling:
                    self._progress_at = time.monotonic()
                    progress.begin(child.compiling.pop(0))
            if self._starter.has_ended() and not self._ending:
                self._end_because("the program that started this service has ended", progress)
            if self._ending:
                continue
            self._start_due()
            self._kill_hung()
            if self._up:
                self._watchdog.feed()
                continue
            ready = {
                name: child.ready_message for name, child in self._children.items() if child.ready_message is not None
            }
            if len(ready) == len(self._names):
                self._up = True
                up(ready)
                notify("READY=1")
                release_startup_memory()
            elif time.monotonic() - max(began, self._progress_at) > START_WITHIN:
                missing = ", ".join(name for name in self._names if name not in ready)
                raise ServiceError(f"the service did not start within {START_WITHIN:g} s; still starting: {missing}")

    def _on_signal(self, number: signal.Signals, progress: Progress) -> None:
        if number == signal.SIGTSTP:
            words = "the service cannot be suspended; Ctrl-C stops the robot and ends the service"
            self._report(f"{number.name}: {words}", "warning")
            return
        self._end_because(number.name, progress)

    def _end_because(self, reason: str, progress: Progress) -> None:
        ending = progress.interrupted if not self._up else "stopping the robot and disabling the drives"
        self._report(f"{reason}: {ending}", "info")
        self._ending = True

    def _kill_hung(self) -> None:
        """Check all processes once per CHECK_PERIOD_S, and kill hung processes. `_on_end` then handles their end."""
        now = time.monotonic()
        if now < self._next_turn:
            return
        self._next_turn = now + CHECK_PERIOD_S
        for child in self._children.values():
            if child.ready_message is None and now - max(child.began, self._progress_at) > START_WITHIN:
                if child.pid is None:
                    self._parent.kill()
                child.kill_hung(START_WITHIN)
            elif self._up and child.pid is None and now - child.began > FORKS_WITHIN:
                self._parent.kill_hung(FORKS_WITHIN)
        self._health.poll({name: self._running(name) for name in self._names})
        for name, watch in self._watches.items():
            watched = self._children.get(name)
            if watched is not None and watched.pid is not None and watch.hangs(watched.pid):
                watched.kill_hung(self._patience[name])

    def _running(self, name: str) -> Running:
        child, restarts = self._children.get(name), self._started[name] - 1
        if child is None:
            return Running(None, ready=False, restarts=restarts)
        return Running(child.pid, child.ready_message is not None, restarts)

    def _on_end(self, child: ChildProcess) -> None:
        """Handle the end of a process. Restart the process or end the service, depending on the process."""
        self._forget(child)
        child.wait(time.monotonic() + END_WITHIN)
        if child.name != "loop" and self._loop_is_ending():
            return  # the other processes end normally after the loop
        if not self._up and child.name != "loop" and child.returncode == 0:
            # Most likely, the loop could not start, has reported that, and has closed its connection to this process.
            self._due[child.name] = time.monotonic() + RESTART_DURING_START
            return
        said_why = child.returncode == os.EX_CONFIG
        name, restarts = child.name, self._restarts[child.name]
        if name == "loop":
            self._loop_has_run = child.ready_message is not None
            if child.returncode == 0:
                consequence = "the loop has stopped the robot and disabled the drives"
            elif self._loop_has_run:
                consequence = "the drives stop by their own watchdogs"
            else:
                consequence = "the loop had not started"
            self._fail(
                "" if said_why else f"the loop has died ({child.end_description}): {consequence}; the service ends"
            )
            return
        if child.ready_message is None and not restarts:
            self._fail("" if said_why else f"the {name} could not start ({child.end_description})")
            return
        if name == "drives":
            if child.returncode:  # otherwise, the loop has disconnected from the drives, and its end is reported
                self._report(f"the simulated drives have died ({child.end_description}): {CONSEQUENCES[name]}", "error")
            return
        now = time.monotonic()
        restarts[:] = [moment for moment in restarts if now - moment < RESTART_PERIOD_S] + [now]
        used_up = len(restarts) > len(RESTART_PAUSES_S)
        wait = RETRY_PAUSE_S if used_up else RESTART_PAUSES_S[len(restarts) - 1]
        if used_up and name == "gateway":
            self._fail(f"the gateway has died repeatedly ({child.end_description}): the service ends")
            return
        when = f" in {wait:g} s" if wait else ""
        self._report(
            f"the {name} has died ({child.end_description}): {CONSEQUENCES[name]}; restarting it{when}",
            "warning",
        )
        if name == "recorder":
            self._record = None  # do not overwrite the first recording
        self._due[name] = now + wait

    def _loop_is_ending(self) -> bool:
        """Return True if the loop has run and has stopped its heartbeat, or is gone.

        In that case only the end of the loop is reported, and not that of other processes.
        """
        loop = self._children.get("loop")
        return loop is None or (loop.ready_message is not None and not self._heartbeats.heart("loop").count)

    def _start_due(self) -> None:
        for name in [name for name, due in self._due.items() if due <= time.monotonic()]:
            del self._due[name]
            try:
                self._start(name)
            except OSError as error:  # no descriptor is free for the pipe
                self._report(f"cannot restart the {name} ({error.strerror}): trying again in 1 s", "warning")
                self._due[name] = time.monotonic() + 1.0
            self._check_source()

    def _check_source(self) -> None:
        """Warn once if trirail's files have changed: a restarted process mixes them with the modules of the start."""
        if self._replaced:
            return
        try:
            self._replaced = provenance.fingerprint() != self._software.source
        except FileNotFoundError:  # a file is being replaced
            self._replaced = True
        except OSError:  # for example, no descriptor is free
            return
        if self._replaced:
            words = (
                "the files of trirail have changed since the start, and restarted processes may fail: restart the "
                "service while the robot is at rest"
            )
            self._report(words, "warning")

    def _fail(self, reason: str) -> None:
        self._failed = self._ending = True
        if reason:
            self._report(reason, "error")

    def _receive_from_parent(self) -> None:
        """Process a message from the fork server. End the service if the fork server has died."""
        self._parent.receive()
        if self._parent.gone and not self._ending:
            loop = self._children.get("loop")
            turns = loop is not None and loop.ready_message is not None
            consequence = "the loop stops the robot and disables the drives" if turns else "the loop had not started"
            self._fail(
                f"the process that starts the others has died ({self._parent.describe_end()}): {consequence}; the "
                "service ends"
            )

    def _pass_on(self, child: ChildProcess) -> None:
        while child.events:
            event = child.events.pop(0)
            if event.seq > self._newest_event:  # a restarted gateway sends past events again
                self._newest_event = event.seq
                self._health.events.add(event)
                self._on_event(event)
        while child.measurements:
            self._health.store(child.name, child.measurements.pop(0))

    def _forget(self, child: ChildProcess) -> None:
        while child.read_messages():
            pass
        self._pass_on(child)
        self._selector.unregister(child.pipe)
        os.close(child.pipe)
        del self._children[child.name]

    def _end(self) -> None:
        """End the loop first, so that the gateway and the recorder can report its end. Then end the other processes."""
        # First the loop ends, then the others by themselves, then the others after SIGTERM, then those that are killed.
        ends_within = self._loop_ends_within + 3.0 * END_WITHIN
        notify(f"STOPPING=1\nEXTEND_TIMEOUT_USEC={ends_within * 1e6:.0f}")
        self._health.end({name: self._running(name) for name in self._names})
        for child in self._children.values():
            if child.pid is None:
                child.kill()
        if loop := self._children.get("loop"):
            loop.send_signal(signal.SIGTERM)
            if not loop.wait(time.monotonic() + self._loop_ends_within):
                self._kill_unresponsive(loop)
            self._loop_has_run = self._loop_has_run or loop.ready_message is not None
        for name in ("planner", "drives"):  # killed, because they have no state and may be frozen or still starting
            if left := self._children.get(name):
                self._kill(left)
                self._forget(left)
        # Gateway and recorder end by themselves when the loop's messages have been published and written to disk. A
        # loop that has never run has sent no messages.
        by_itself = time.monotonic() + (END_WITHIN if self._loop_has_run else 0.0)
        asked = by_itself + END_WITHIN
        for child in list(self._children.values()):
            if not child.wait(by_itself):
                child.send_signal(signal.SIGTERM)
        for child in list(self._children.values()):
            if not child.wait(asked):
                self._kill_unresponsive(child)
                self._failed = True
            # During the start, SIGTERM may arrive before a process has installed its signal handler.
            up = self._loop_has_run and child.ready_message is not None
            self._failed = self._failed or (up and child.returncode != 0)
            self._forget(child)

    def _kill_unresponsive(self, child: ChildProcess) -> None:
        self._report(f"the {child.name} does not end: killing it", "warning")
        self._kill(child)

    def _kill(self, child: ChildProcess) -> None:
        child.kill()
        child.wait(time.monotonic() + END_WITHIN)


def _admission(config: Config) -> Admission | None:
    """Read the credentials of [zenoh.tls], if it is set. They are read once for all starts of the gateway.

    Raises ServiceError if the credentials are invalid, or if [zenoh] router is revoked.
    """
    zenoh = config.zenoh
    return Admission.read(Path(zenoh.tls.directory), zenoh.users, zenoh.router) if zenoh.tls is not None else None


@contextmanager
def _runtime_folder() -> Iterator[Path]:
    """Create a temporary folder for sockets, which exists within the context. Raises ServiceError on failure.

    The folder is not in XDG_RUNTIME_DIR, because systemd removes that folder when the user's last session ends. The
    service may continue, and its restarted processes need the sockets. systemd-tmpfiles does not clean this folder,
    because the folder is locked, tmpfiles.d(5).
    """
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(files.temporary_folder())
        except OSError as error:
            raise ServiceError(
                f"cannot make a folder for sockets in any folder for temporary files: {error.strerror}; set TMPDIR to "
                "a folder of this user"
            ) from error
        yield folder


def _listen(folder: Path) -> list[socket.socket]:
    """Listen on the sockets of the loop in a folder. Raises ServiceError if that is impossible."""
    try:
        return [links.listen(folder / name) for name in PORTS]
    except OSError as error:  # usually because the kernel allows only 107 bytes for the path of a socket
        raise ServiceError(
            f"cannot make sockets in {folder}: {error.strerror or error}; "
            "set TMPDIR to another folder of this user with a short path"
        ) from error


def _metrics_server(config: Config, health: Health) -> AbstractContextManager[object]:
    """Return a context within which metrics are served, if [telemetry] metrics_port is set."""
    if not config.telemetry.metrics_port:
        return nullcontext()
    from trirail.processes.metrics import MetricsServer

    return MetricsServer(config, health)
