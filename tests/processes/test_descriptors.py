"""A process without a free file descriptor: what it does periodically must not end it."""

from __future__ import annotations

import itertools
import math
import os
import resource
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from trirail.processes import sockets
from trirail.processes.memory_budget import HeapTrim
from trirail.processes.operating_system import notify
from trirail.telemetry.sinks import is_watched
from trirail.wire import links


@pytest.fixture
def use_up() -> Iterator[Callable[[], None]]:
    """Leave this process no free descriptor until the test ends."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken: list[int] = []

    def use() -> None:
        most = max(map(int, os.listdir("/proc/self/fd")))
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(soft, most + 8), hard))
        with pytest.raises(OSError, match="Too many open files"):
            taken.extend(os.dup(0) for _ in itertools.count())

    yield use
    for descriptor in taken:
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_the_heap_is_trimmed_again_later(use_up: Callable[[], None]) -> None:
    heap = HeapTrim()
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)
    use_up()
    heap._due = 0.0
    heap.poll()
    assert heap._due > 0.0
    before = heap._least
    resource.setrlimit(resource.RLIMIT_NOFILE, soft)
    heap._due = 0.0
    heap.poll()
    assert 0 < heap._least < math.inf
    assert before >= heap._least


def test_all_descriptors_count_as_used_where_the_kernel_does_not_count_them(
    use_up: Callable[[], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    use_up()
    monkeypatch.setattr(Path, "stat", lambda _: SimpleNamespace(st_size=0))
    assert sockets.descriptors_used() == sockets.descriptor_limit()


def test_connections_are_neither_counted_nor_ended(use_up: Callable[[], None]) -> None:
    use_up()
    assert sockets.connections({7447}) == []
    sockets.disconnect({("127.0.0.1", 7447)})


def test_systemd_is_not_notified(use_up: Callable[[], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    use_up()
    notify("WATCHDOG=1")


def test_a_live_view_counts_as_watched(use_up: Callable[[], None]) -> None:
    use_up()
    assert is_watched(9876)


def test_a_peer_of_the_loop_waits_for_a_descriptor(use_up: Callable[[], None], tmp_path: Path) -> None:
    port = links.Port(links.listen(tmp_path / "port"))
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    peer.connect(str(tmp_path / "port"))
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)
    use_up()
    assert not port.accept()
    resource.setrlimit(resource.RLIMIT_NOFILE, soft)
    assert port.accept()
    peer.close()
    port.close()
