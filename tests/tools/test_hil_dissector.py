"""Frames as Wireshark's CANopen dissector reads them: what `make hil` says of a log, wrong ones among them."""

from __future__ import annotations

import shutil
from pathlib import Path

import hil_dissector
import pytest

pytestmark = pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")

SOUND = """
(1.000) can1 702#00
(1.010) can1 602#4041600000000000
(1.020) can1 582#4B41600040020000
(1.030) can1 000#0102
(1.040) can1 702#05
(1.050) can1 080#
(1.060) can1 182#4002
(1.070) can1 302#00000000
"""


def problems(tmp_path: Path, more: str = "", until: float = 9.0) -> list[str]:
    log = tmp_path / "bus.log"
    log.write_text((SOUND + more).lstrip())
    return hil_dissector.problems(hil_dissector.dissect(log), until)


def test_a_sound_log_has_no_problem_and_is_counted(tmp_path: Path) -> None:
    assert problems(tmp_path) == []
    counted = hil_dissector.statistics(hil_dissector.dissect(tmp_path / "bus.log"))
    assert counted == {"NMT": 1, "PDO": 2, "SDO": 2, "SYNC and EMCY": 1, "heartbeat": 2}


@pytest.mark.parametrize(
    ("frames", "problem"),
    [
        ("(2.0) can1 602#4060600000000000\n", "node 2 leaves 6060:00 without an answer"),
        ("(2.0) can1 602#4060600000000000\n(2.1) can1 582#4F61600008000000\n", "node 2 is asked for 6060:00 and"),
        ("(2.0) can1 702#7F\n", "node 2 is operational no more but 7F"),
        ("(2.0) can1 000#8003\n(2.1) can1 702#7F\n", "node 2 is operational no more but 7F"),
        ("(2.0) can1 082#8130110000000000\n", "node 2 sends EMCY 3081"),
        ("(2.0) can1 602#40\n", "malformed"),
        ("(2.0) can1 18DAF110#0102\n", "1 of 9 frames are not CANopen"),
    ],
)
def test_what_is_wrong_is_told(tmp_path: Path, frames: str, problem: str) -> None:
    (found,) = problems(tmp_path, frames)
    assert problem in found


def test_frames_that_are_not_decoded_prove_nothing(tmp_path: Path) -> None:
    assert hil_dissector.problems([], 9.0) == ["0 of 0 frames are not CANopen, says Wireshark"]
    (tmp_path / "bus.log").write_text(SOUND.lstrip())
    frames = [frame._replace(function=None) for frame in hil_dissector.dissect(tmp_path / "bus.log")]
    assert hil_dissector.problems(frames, 9.0) == ["8 of 8 frames are not CANopen, says Wireshark"]


@pytest.mark.parametrize("command", ["8002", "8000", "0202", "8102"])
def test_a_node_that_was_told_to_leave_operational_has_not_fallen(tmp_path: Path, command: str) -> None:
    """As when a second session of a service sets the drives up again."""
    assert problems(tmp_path, f"(2.0) can1 000#{command}\n(2.1) can1 702#7F\n") == []


def test_what_comes_of_a_disturbance_is_no_problem(tmp_path: Path) -> None:
    assert problems(tmp_path, "(2.0) can1 702#7F\n(2.1) can1 082#8130110000000000\n", until=1.5) == []


def test_switches_are_pdos_that_change_an_output(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text(
        "(1.00) can1 080#\n(1.01) can1 403#00000000\n(2.00) can1 080#\n(2.01) can1 403#00000100\n"
        "(2.02) can1 402#00000000\n(3.00) can1 080#\n(3.01) can1 403#00000300\n(4.00) can1 080#\n"
        "(4.01) can1 403#00000200\n(4.02) can1 083#3081000000000000\n(5.00) can1 080#\n"
    )
    found = hil_dissector.switches(hil_dissector.dissect(log), 3, 1 << 16)
    assert found == [(2, True, 3.0), (4, False, 5.0)]
