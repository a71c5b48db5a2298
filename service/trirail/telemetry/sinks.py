"""Sinks of a recording: a file that receives all data, and a live view that may be slow, frozen or absent.

Rerun's sinks do not report failures. After a failure, a sink accepts no more data and blocks every sender forever. This
module never waits long for a sink, and counts the data that does not reach a sink.
"""

from __future__ import annotations

import math
import os
import shutil
import socket
import stat
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk

from trirail.errors import ServiceError
from trirail.telemetry.columns import GOAL
from trirail.telemetry.journal import EVENTS

LOOPBACK = "127.0.0.1"
BACKLOG = 20
"""Maximum number of batches that wait for the live view, which is the data of about 2 s."""
LASTING = EVENTS, GOAL
"""Entities of which the view needs every chunk: a lost line of the log or change of a goal would never be shown."""
MAX_LASTING = 1000
"""Maximum number of chunks of such entities that wait for the live view in addition to the batches."""
RESERVE = 64 << 20
"""Space that is left free on the disk [bytes]. Rerun's file sink never recovers from a full disk."""
DISK_TIMEOUT_S = 2.0
"""Maximum time to wait for the disk, or for a thread to end [s]."""


def free_space(directory: Path) -> float:
    """Return the free space of a folder's disk [bytes]; inf if it cannot be read."""
    try:
        return shutil.disk_usage(directory).free
    except OSError:
        return math.inf


def disk_shortage(directory: Path, reserve: int) -> str:
    """Return "" if more than `reserve` bytes are free on a folder's disk; otherwise return an error message."""
    try:
        free = shutil.disk_usage(directory).free
    except OSError as error:
        return f"{directory}: {error.strerror}"
    if free > reserve:
        return ""
    return f"{directory} is full: {free / 1e6:.0f} MB are free, {reserve / 1e6:.0f} MB are reserved"


def identity(path: Path) -> tuple[int, int] | None:
    """Return the device and inode of a file, which distinguish it from a later file with the same name.

    Return None if there is no file.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


_unfinished: list[rr.RecordingStream] = []
"""Streams whose disk did not respond when they were closed. They are never destroyed, which would wait for the disk."""


class Archive:
    """Writer of a recording file.

    Each batch is passed to the operating system before the next batch is written. Nothing is written while fewer than
    `reserve` bytes are free on the disk.
    """

    def __init__(self, stream: rr.RecordingStream, path: Path, reserve: int = RESERVE) -> None:
        self.lost = 0
        """Number of batches that could not be written."""
        self.trouble = ""
        """Reason why the last batch could not be written; empty if it was written."""
        self._stream = stream
        self._reserve = reserve
        self._path = path
        self._directory = path.parent
        self._identity = identity(path)
        self._stuck = False
        self._late: set[str] = set()
        """Ids of the chunks of lost batches that were passed to Rerun. A slow disk writes them later."""

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Write a batch without waiting long for the disk; if writing fails, count the batch as lost.

        A chunk of a lost batch may be given again in a later batch, and is not written twice.
        """
        self.trouble = self._write(chunks)
        self.lost += bool(self.trouble)

    @property
    def gone(self) -> bool:
        """True if the file has been deleted or moved. Data written to the open file would then be lost."""
        return identity(self._path) != self._identity

    @property
    def stuck(self) -> bool:
        """True if the file accepted no data in the last attempt. Rerun's sink does not recover from a disk failure."""
        return self._stuck

    def close(self) -> None:
        """Finish the file, unless the disk does not respond."""
        if self._flushed(DISK_TIMEOUT_S):
            self._stream.disconnect()
        else:
            _unfinished.append(self._stream)

    def _write(self, chunks: list[Chunk]) -> str:
        """Write a batch; return the reason for a failure, or "" on success."""
        if self.gone:
            return f"{self._path} was deleted or moved, and no other file can be created there"
        if full := disk_shortage(self._directory, self._reserve):
            return full
        if not self._stuck or self._flushed(0.01):
            self._stream.send_chunks([chunk for chunk in chunks if chunk.id not in self._late])
            if not self._flushed(DISK_TIMEOUT_S):
                self._late.update(chunk.id for chunk in chunks)
        return f"{self._directory} cannot be written: disk failing or read-only, or a quota" if self._stuck else ""

    def _flushed(self, within: float) -> bool:
        try:
            self._stream.flush(timeout_sec=within)
        except RuntimeError:  # not written in time, which is the only sign of a failing disk
            self._stuck = True
        else:
            self._stuck = False
        return not self._stuck


class Relay:
    """Thread that passes batches to a receiver.

    If BACKLOG batches are waiting when another batch arrives, the waiting batches are dropped, except their events and
    goals.
    """

    def __init__(self, deliver: Callable[[list[Chunk]], None], finish: Callable[[], None]) -> None:
        self.skipped = 0
        """Number of batches that were dropped because the receiver was too slow."""
        self._deliver = deliver
        self._finish = finish
        self._waiting: deque[list[Chunk]] = deque()
        self._lasting: deque[Chunk] = deque(maxlen=MAX_LASTING)
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def write_chunks(self, chunks: list[Chunk]) -> None:
        """Add a batch to the queue without blocking."""
        with self._changed:
            if len(self._waiting) == BACKLOG:
                self.skipped += BACKLOG
                dropped = (chunk for batch in self._waiting for chunk in batch)
                self._lasting.extend(chunk for chunk in dropped if chunk.entity_path.endswith(LASTING))
                self._waiting.clear()
            self._waiting.append(chunks)
            self._changed.notify()

    def close(self) -> None:
        """Deliver the waiting batches and end the thread; give up after DISK_TIMEOUT_S."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(DISK_TIMEOUT_S)

    def _run(self) -> None:
        while (chunks := self._next()) is not None:
            self._deliver(chunks)
        self._finish()

    def _next(self) -> list[Chunk] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            if not self._waiting:
                return None
            chunks = [*self._lasting, *self._waiting.popleft()]
            self._lasting.clear()
            return chunks


def free_port() -> int:
    """Return an unused port on the loopback interface."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port


def is_watched(port: int) -> bool:
    """Return True if any client is connected to a port on which this process listens."""
    try:
        names = os.listdir("/dev/fd")
    except OSError:  # clients use all descriptors
        return True
    return any(_serves(int(name), port) for name in names)


def _serves(descriptor: int, port: int) -> bool:
    """Return True if a file descriptor is a connection to a port of this process."""
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return False
        with socket.socket(fileno=os.dup(descriptor)) as connection:
            connection.getpeername()  # raises for the listening socket, which has no peer
            return connection.family == socket.AF_INET and connection.getsockname()[1] == port
    except OSError:  # the descriptor was closed in the meantime, or is the listening socket
        return False


def live_server(port: int, memory_mb: float) -> rr.GrpcServerSink:
    """Return a server for viewers on this machine.

    The server stores up to `memory_mb` megabytes of past data for viewers that connect later. A viewer receives the
    newest data first, and therefore shows the present state immediately. Raises ServiceError if the port is in use.
    """
    with socket.socket() as probe:  # if the port were in use, the sink would only log an error and discard all data
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ServiceError(
                f"live view: cannot listen on {LOOPBACK}:{port}: {error.strerror}; "
                "set telemetry.live_port to a free port, or to 0 for no live view"
            ) from error
    return rr.GrpcServerSink(LOOPBACK, port, server_memory_limit=f"{memory_mb:.0f}MB", newest_first=True)


def live_relay(stream: rr.RecordingStream) -> Relay:
    """Return a relay that sends batches to a stream, and therefore to the viewers of the stream."""

    def deliver(chunks: list[Chunk]) -> None:
        stream.send_chunks(chunks)
        stream.flush()  # wait here for a slow viewer, because Rerun's own queues would fill the memory

    return Relay(deliver, stream.disconnect)
