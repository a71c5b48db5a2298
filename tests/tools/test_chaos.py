"""The kill matrix itself: whole, and able to see what it is there to see; the matrix is run by `make chaos`."""

from __future__ import annotations

import contextlib
import threading

import can
import numpy as np
import pytest
from chaos import CASES, HARM, MODES
from chaos_rig import NODES, PROCESSES, Failed, Rig
from trirail.config import SIM, load
from trirail.wire import vocabulary
from trirail_drivers.bus.frames import Frame
from trirail_drivers.cia402 import canopen_frames


def test_it_has_every_mode_process_and_harm() -> None:
    assert len(set(CASES)) == len(MODES) * len(PROCESSES) * len(HARM) == 180
    assert set(MODES) == {*map(str, vocabulary.MODES)} - {"homing"}  # its drives have absolute encoders


def heard(setpoints: list[float], told: int = canopen_frames.ENABLE_OPERATION) -> Rig:
    """A rig that has heard these setpoints [m]."""
    rig = Rig.__new__(Rig)
    config = load(SIM)
    rig.period, rig.limits, rig.counts = 0.01, config.limits.slider, 1e7
    rig._lock = threading.Lock()
    rig._heard = []
    for node in NODES:
        rig._heard.append(Frame(canopen_frames.RPDO1 + node, canopen_frames.CONTROLWORD.pack(told)).message())
        for position in setpoints:
            content = canopen_frames.SETPOINT.pack(round(position * 1e7), 0)
            rig._heard.append(
                can.Message(arbitration_id=canopen_frames.RPDO2 + node, data=content, is_extended_id=False)
            )
    return rig


SMOOTH = [float(5.0 * (0.01 * k) ** 2) for k in range(8)]


@pytest.mark.parametrize(
    ("setpoints", "told", "said"),
    [
        (SMOOTH, canopen_frames.ENABLE_OPERATION, None),
        ([0.0, 0.0, 0.02, 0.04], canopen_frames.ENABLE_OPERATION, "a setpoint steps by 20.00 mm"),
        ([0.0, 0.0, 0.003, 0.006], canopen_frames.ENABLE_OPERATION, r"the velocity of setpoints steps by 0\.300 m/s"),
        ([0.0, 0.0, 0.02, 0.04], canopen_frames.QUICK_STOP, None),  # nobody follows these
    ],
)
def test_a_jump_of_what_is_followed_is_seen(setpoints: list[float], told: int, said: str | None) -> None:
    assert np.ptp(setpoints) > 0.0
    with pytest.raises(Failed, match=said) if said else contextlib.nullcontext():
        heard(setpoints, told).check_setpoints()
