"""The checks of tools/bus_log.py: a right log passes, and each wrong thing in it is noticed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bus_log
import pytest
from bus_log import Frame
from hypothesis import given
from hypothesis import strategies as st
from trirail.config import SIM, load
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.timing import BusTiming

CONFIG = load(SIM.parent / "socketcan.toml")
PERIOD = CONFIG.period
COUNTS = 1e6
NODES = (1, 2, 3)
WORDS = {5: (0x06, 0x31), 10: (0x07, 0x33), 15: (0x0F, 0x37), 380: (0x00, 0x50)}
"""At some cycles the controlword, and the statusword that answers it a cycle later."""


def good_log() -> list[Frame]:
    """Powers up, moves with constant acceleration up and down again, and powers down."""
    acceleration = 0.5
    log = [Frame(0.0, layout.NMT, bytes((layout.NMT_START, node))) for node in NODES]
    position = velocity = 0.0
    for cycle in range(400):
        t = 1.0 + cycle * PERIOD
        log.append(Frame(t, layout.SYNC, b""))
        change = acceleration * PERIOD * ((50 <= cycle < 150) - (200 <= cycle < 300))
        position += (velocity + change / 2) * PERIOD
        velocity += change
        data = layout.SETPOINT.pack(round(position * COUNTS), round(velocity * COUNTS))
        for node in NODES:
            log.append(Frame(t + 2e-4, layout.RPDO2 + node, data))
            if cycle in WORDS:
                log.append(Frame(t + 3e-4, layout.RPDO1 + node, layout.CONTROLWORD.pack(WORDS[cycle][0])))
            if cycle == 0 or cycle - 1 in WORDS:
                status = WORDS[cycle - 1][1] if cycle else 0x50
                log.append(Frame(t + 4e-4, layout.TPDO1 + node, layout.STATUSWORD.pack(status)))
    return log


GOOD = good_log()


def problems(log: list[Frame], missed: int = 0, until: float = 9e9) -> list[str]:
    return bus_log.problems(log, CONFIG, missed, until)


def replaced(which: Callable[[Frame], bool], change: Callable[[Frame], Frame | None]) -> list[Frame]:
    """The right log with one frame changed, or left out."""
    index = next(number for number, frame in enumerate(GOOD) if which(frame))
    new = change(GOOD[index])
    return [*GOOD[:index], *([new] if new else []), *GOOD[index + 1 :]]


def setpoint(frame: Frame, position: float = 0.0, velocity: float = 0.0) -> Frame:
    """A setpoint changed by so much."""
    counts, rate = layout.SETPOINT.unpack(frame.data)
    data = layout.SETPOINT.pack(counts + round(position * COUNTS), rate + round(velocity * COUNTS))
    return frame._replace(data=data)


def test_a_right_log_has_no_problems() -> None:
    assert problems(GOOD) == []
    assert bus_log.differences(GOOD[100:-100], GOOD, 9e9) == []
    assert bus_log.statistics(GOOD, CONFIG, 9e9)["interval_median_ms"] == pytest.approx(PERIOD * 1e3)


@pytest.mark.parametrize("own", [[], [frame for frame in GOOD if frame.identifier != layout.SYNC]])
def test_a_log_of_the_service_without_its_frames_proves_nothing(own: list[Frame]) -> None:
    assert bus_log.differences(own, GOOD, 9e9) == ["the service's log has no SYNC: nothing was captured"]
    assert bus_log.differences(GOOD, GOOD, GOOD[0].t) != []  # all its frames are later


def moving(frame: Frame) -> bool:
    return frame.identifier == layout.RPDO2 + 2 and frame.t > 1.1


@pytest.mark.parametrize(
    ("which", "change", "said"),
    [
        (moving, lambda frame: setpoint(frame, position=2e-4), "step of"),
        (moving, lambda frame: setpoint(frame, position=1e-6 * 20), "its feed-forward says"),
        (moving, lambda frame: setpoint(frame, velocity=0.01), "feed-forward jumps"),
        (moving, lambda frame: setpoint(frame, velocity=0.2), "is above 0.1"),
        (moving, lambda frame: setpoint(frame, position=0.4), "is outside of"),
        (
            lambda frame: frame.identifier == layout.SYNC and frame.t > 1.2,
            lambda frame: None,
            "two setpoints between one SYNC and the next",
        ),
        (
            lambda frame: frame.identifier == layout.RPDO1 + 1 and frame.data == b"\x07\x00",
            lambda frame: None,
            "controlword 000F after 0006",
        ),
        (
            lambda frame: frame.identifier == layout.TPDO1 + 3 and frame.data == b"\x33\x00",
            lambda frame: None,
            "drive C: from ready to switch on to operation enabled",
        ),
        (
            lambda frame: frame.identifier == layout.TPDO1 + 3 and frame.data == b"\x33\x00",
            lambda frame: frame._replace(data=b"\x1f\x00"),
            "fault at",
        ),
        (
            lambda frame: frame.identifier == layout.RPDO1 + 1 and frame.data == b"\x00\x00",
            lambda frame: None,
            "which no controlword asked for",
        ),
        (lambda frame: frame.identifier == layout.NMT, lambda frame: None, "before NMT start"),
    ],
)
def test_each_wrong_thing_is_noticed(
    which: Callable[[Frame], bool], change: Callable[[Frame], Frame | None], said: str
) -> None:
    assert any(said in problem for problem in problems(replaced(which, change)))


def test_setpoints_come_before_power() -> None:
    late = [frame for frame in GOOD if frame.identifier != layout.RPDO2 + 1 or frame.t > 1.1]
    assert any("before there is a setpoint" in problem for problem in problems(late))


def test_a_drive_that_never_ran_is_noticed() -> None:
    assert any("never in operation enabled" in problem for problem in problems(GOOD, until=1.012))


def test_ticks_that_are_missed_must_be_told_of_and_never_caught_up() -> None:
    gap = [frame for frame in GOOD if not 1.1 < frame.t < 1.1 + 10.5 * PERIOD]
    assert any("10 of 399 ticks have none" in problem for problem in problems(gap))
    burst = [
        frame._replace(t=frame.t - 3 * PERIOD) if frame.identifier == layout.SYNC and frame.t > 1.2 else frame
        for frame in GOOD
    ]
    assert any("too early" in problem for problem in problems(burst))


def test_a_frame_that_the_service_did_not_send_is_noticed() -> None:
    other = replaced(moving, lambda frame: setpoint(frame, position=1e-6))
    (said,) = bus_log.differences(other, GOOD, 9e9)
    assert "identifier 302" in said


def test_the_format_is_candumps(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("(1.500000) can1 080#\n(1.500100) can1 301#0102030405060708\n")
    assert bus_log.read(tmp_path / "log") == [Frame(1.5, 0x080, b""), Frame(1.5001, 0x301, bytes(range(1, 9)))]


@pytest.mark.parametrize(
    ("data", "noticed"),
    [(layout.STATUSWORD_UPLOAD, True), (layout.CONTROLWORD_DOWNLOAD + bytes(4), False)],
)
def test_a_request_before_a_setpoint_of_its_cycle_is_noticed(data: bytes, noticed: bool) -> None:
    """A controlword that stops a drive may come first."""
    at = next(number for number, frame in enumerate(GOOD) if moving(frame))
    request = Frame(GOOD[at].t, layout.SDO_REQUEST + 2, data)
    assert any("precedes a setpoint" in line for line in problems([*GOOD[:at], request, *GOOD[at:]])) == noticed
    end = next(number for number, frame in enumerate(GOOD[at:], at) if frame.identifier == layout.SYNC)
    assert not any("precedes" in line for line in problems([*GOOD[:end], request, *GOOD[end:]]))


def with_frame(identifier: int, data: bytes, t: float) -> list[Frame]:
    return sorted([*GOOD, Frame(t, identifier, data)], key=lambda frame: frame.t)


def gaps(log: list[Frame]) -> list[str]:
    return list(bus_log.gap_problems(log, PERIOD, CONFIG.can.timing, CONFIG.drives.master_node))


BEFORE = 1.0 + 20 * PERIOD
"""A tick."""


@pytest.mark.parametrize(
    ("identifier", "data", "noticed"),
    [
        (layout.SDO_REQUEST + 1, layout.STATUSWORD_UPLOAD, True),
        (layout.RPDO1 + 2, layout.CONTROLWORD.pack(layout.DISABLE_VOLTAGE), True),
        (layout.RPDO1 + 2, layout.CONTROLWORD.pack(layout.QUICK_STOP), False),
        (layout.SDO_REQUEST + 2, layout.CONTROLWORD_DOWNLOAD + b"\2\0\0\0", False),
        (layout.SDO_REQUEST + 2, layout.CONTROLWORD_DOWNLOAD + b"\0\0\0\0", True),
        (layout.NMT, bytes((layout.NMT_START, 1)), True),
        (layout.RPDO3 + 1, bytes(4), True),
        (layout.HEARTBEAT + CONFIG.drives.master_node, b"\5", True),
        (layout.HEARTBEAT + 1, b"\5", False),
        (layout.TPDO2 + 1, bytes(4), False),
    ],
)
def test_a_frame_of_the_service_that_would_delay_a_sync_is_noticed(identifier: int, data: bytes, noticed: bool) -> None:
    assert gaps(GOOD) == []
    assert len(gaps(with_frame(identifier, data, BEFORE - 1.3e-4))) == noticed
    assert gaps(with_frame(identifier, data, BEFORE - 1.4e-4)) == []


def delayed(late: float) -> list[Frame]:
    """The right log, with one SYNC that is late, and its cycle with it."""
    return [each._replace(t=each.t + late) if BEFORE <= each.t < BEFORE + PERIOD / 2 else each for each in GOOD]


def test_a_late_tick_excuses_no_frame_before_its_sync() -> None:
    log = [*delayed(3e-4), Frame(BEFORE + 1e-4, layout.SDO_REQUEST + 1, layout.STATUSWORD_UPLOAD)]
    assert len(gaps(sorted(log, key=lambda frame: frame.t))) == 1
    assert gaps(delayed(3e-4)) == []


@given(late=st.floats(0.0, 0.95), stalled=st.integers(21, 378))
def test_one_stall_of_the_machine_moves_no_tick(late: float, stalled: int) -> None:
    """Not even by more than half a period, with which a SYNC seems to be early."""
    begins = 1.0 + stalled * PERIOD
    log = [
        frame._replace(t=frame.t + late * PERIOD) if begins - 1e-9 < frame.t < begins + PERIOD / 2 else frame
        for frame in GOOD
    ]
    for cycle in range(0, 400, 10):
        if cycle != stalled:
            request = Frame(1.0 + (cycle + 0.6) * PERIOD, layout.SDO_REQUEST + 1, layout.STATUSWORD_UPLOAD)
            log.append(request)
    assert gaps(sorted(log, key=lambda frame: frame.t)) == []


def test_a_cycle_with_late_setpoints_is_no_gap_that_was_missed() -> None:
    late = [
        each._replace(t=BEFORE - 5e-5) if each.identifier == layout.RPDO2 + 3 and 0 < BEFORE - each.t < PERIOD else each
        for each in GOOD
    ]
    request = Frame(BEFORE - 4e-5, layout.SDO_REQUEST + 1, layout.STATUSWORD_UPLOAD)
    assert gaps(sorted([*late, request], key=lambda frame: frame.t)) == []


def test_the_frame_time_is_that_of_the_bit_rate() -> None:
    log = with_frame(layout.SDO_REQUEST + 1, layout.STATUSWORD_UPLOAD, BEFORE - 2e-4)
    assert gaps(log) == []
    assert list(bus_log.gap_problems(log, PERIOD, BusTiming(500_000), CONFIG.drives.master_node))


def written(file: Path, log: list[Frame]) -> str:
    lines = (f"({frame.t:.6f}) can0 {frame.identifier:03X}#{frame.data.hex().upper()}\n" for frame in log)
    file.write_text("".join(lines), encoding="utf-8")
    return str(file)


def test_the_program_prints_the_problems_of_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = str(SIM.parent / "socketcan.toml")
    assert bus_log.main([written(tmp_path / "good.log", GOOD), config]) == 0
    assert capsys.readouterr().out == ""
    wrong = replaced(lambda frame: frame.identifier == layout.SYNC and frame.t > 1.2, lambda frame: None)
    wrong = [frame for frame in wrong if frame.identifier != layout.RPDO2 + 1]
    assert bus_log.main([written(tmp_path / "wrong.log", wrong), config]) == 1
    assert "drive A: no setpoint at all\n" in capsys.readouterr().out


@pytest.mark.parametrize("content", [None, "no frame\n", "a b c\n", "(1.0) can0 xyz\n"])
def test_the_program_refuses_what_is_no_log(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bus.log"
    if content is not None:
        file.write_text(content, encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        bus_log.main([str(file), str(SIM)])
    assert ended.value.code == 2
    assert str(file) in capsys.readouterr().err
