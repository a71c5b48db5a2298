"""Ports of the tests: no two workers pick the same one, nor one that is a door for stops of another's service."""

from hypothesis import given
from hypothesis import strategies as st
from ports import FIRST, PORTS, port
from trirail.wire.stop_protocol import PORT_OFFSET


@given(workers=st.integers(1, 65), seed=st.integers(0, 2**22))
def test_workers_pick_different_ports(workers: int, seed: int) -> None:
    each = PORTS // workers
    picked = [port(worker, workers, seed + number) for worker in range(workers) for number in range(each)]
    doors = {number + PORT_OFFSET for number in picked}
    assert len(set(picked)) == len(picked) == workers * each
    assert doors.isdisjoint(picked)
    assert min(picked) >= FIRST
    assert max(doors) < 32_768
