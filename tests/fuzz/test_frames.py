"""Frames that no drive should send, and frames that no master should: the cycle goes on, and so do the devices."""

from __future__ import annotations

import can
import pytest
from conftest import Rig
from control_rig import CONFIG
from hypothesis import given, settings
from hypothesis import strategies as st
from trirail.config import SIM, Config, parse
from trirail.wire.vocabulary import Mode

_CHANGES = {'protocol = "cia402"': 'protocol = "odrive"', "counts_per_metre = 1e7": "counts_per_metre = 25.0"}
_TEXT = SIM.read_text(encoding="utf-8")
for before, after in _CHANGES.items():
    _TEXT = _TEXT.replace(before, after)
ODRIVE = parse(_TEXT)

known = st.sampled_from((0x000, 0x080, 0x700)) | st.builds(
    int.__or__, st.sampled_from((0x80, 0x180, 0x280, 0x380, 0x580, 0x600, 0x700)), st.integers(1, 3)
)
odrives = st.builds(lambda node, command: node << 5 | command, st.integers(1, 3), st.integers(0, 31))
frames = st.builds(
    lambda number, data, remote, error, long: can.Message(
        arbitration_id=number | (1 << 20 if long else 0),
        data=b"" if remote else data,
        dlc=len(data),
        is_remote_frame=remote,
        is_error_frame=error,
        is_extended_id=long,
    ),
    known | odrives | st.integers(0, 0x7FF),
    st.binary(max_size=8),
    st.booleans(),
    st.sampled_from((False, False, False, True)),
    st.sampled_from((False, False, False, True)),
)


@pytest.mark.parametrize("config", [CONFIG, ODRIVE], ids=["cia402", "odrive"])
@settings(max_examples=25)
@given(heard=st.lists(frames, max_size=12), sent=st.lists(frames, max_size=12))
def test_any_frames_leave_the_cycle_turning(config: Config, heard: list[can.Message], sent: list[can.Message]) -> None:
    rig = Rig(config)
    rig.enable()
    receive = rig.bus.recv
    pending = list(heard)
    rig.bus.recv = lambda timeout=None: pending.pop() if pending else receive(timeout)  # type: ignore[method-assign]
    for frame in sent:  # by another master, to the drives
        rig._send(frame)
    rig.cycles(50)
    assert not pending
    assert rig.mode in (Mode.HOLDING, Mode.FAULT)
    assert "internal" not in (rig.control.fault or "")
    rig.bus.shutdown()
