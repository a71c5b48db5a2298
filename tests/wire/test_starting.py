"""A service that starts is seen by clients on its machine, until it is up or its process has gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st
from trirail.client.client import Robot
from trirail.errors import ServiceError
from trirail.wire.starting import Starting, is_starting

NUMBERS = count(1)
PORTS = st.integers(17_350, 17_360)
LISTENED = st.sampled_from(["tcp/127.0.0.1:{}", "tls/0.0.0.0:{}", "tcp/[::1]:{}", "unixsock-stream//nowhere/{}"])


@given(listened=st.lists(st.tuples(LISTENED, PORTS), unique_by=lambda each: each[1], max_size=4), asked=PORTS)
def test_it_is_seen_at_its_ports_and_files_on_this_machine_and_nowhere_else(
    listened: list[tuple[str, int]], asked: int
) -> None:
    own = f"{os.getpid()}{next(NUMBERS)}"  # files of no other test

    def endpoint(form: str, port: int) -> str:
        return form.format(f"{own}-{port}" if form.startswith("unix") else port)

    starting = Starting([endpoint(form, port) for form, port in listened])
    try:
        by_port = {port for form, port in listened if not form.startswith("unix")}
        for _ in range(20):  # however many ask
            assert is_starting(f"tcp/127.0.0.1:{asked}") is (asked in by_port)
            assert is_starting(f"tls/localhost:{asked}") is (asked in by_port)
        by_file = {port for form, port in listened if form.startswith("unix")}
        assert is_starting(endpoint("unixsock-stream//nowhere/{}", asked)) is (asked in by_file)
        assert not is_starting(f"tcp/192.0.2.7:{asked}")
    finally:
        starting.up()
    assert not any(is_starting(endpoint(form, port)) for form, port in listened)


@pytest.mark.parametrize("endpoint", ["", "tcp", "tcp/", "tcp/localhost", "tcp/localhost:x", "nonsense/1"])
def test_what_is_no_endpoint_is_starting_nowhere(endpoint: str) -> None:
    assert not is_starting(endpoint)


@pytest.mark.long
def test_a_client_says_so_and_one_that_was_killed_is_starting_no_more() -> None:
    endpoint = "tcp/127.0.0.1:17361"
    program = f"from trirail.wire.starting import Starting; s = Starting([{endpoint!r}]); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(ServiceError, match="the service is starting"):
            Robot("demo", endpoint)
        process.send_signal(signal.SIGKILL)
    with pytest.raises(ServiceError, match="connection refused"):
        Robot("demo", endpoint)
