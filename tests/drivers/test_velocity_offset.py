"""Setpoints with and without the velocity offset 60B1h: chosen by the load that they put on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import can
import msgspec
import pytest
from drivers.test_look import OWN
from edsfiles import eds
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rigs import START, STEP, Closing, alike, ideal_servo
from trirail_drivers.bus.load import HIGH_LOAD
from trirail_drivers.cia402 import canopen_frames, inspection
from trirail_drivers.cia402.eds import SERVO
from trirail_drivers.cia402.process_data import plan_traffic
from trirail_drivers.config import NO_IO, DigitalIo, Drive, Drives
from trirail_drivers.errors import BusError
from trirail_drivers.interface import PowerState
from trirail_drivers.simulated import SimulatedDrive
from trirail_drivers.timing import DEFAULT_TIMING, BusTiming

from drivers import test_cia402

MAPPABLE, LACKING, FIXED_4, FIXED_8 = "mappable", "lacking", "fixed at 4 bytes", "fixed at 8 bytes"
KINDS: Final = (MAPPABLE, LACKING, FIXED_4, FIXED_8)
"""How a drive's dictionary treats the velocity offset."""
TARGET, OFFSET = 0x607A0020, 0x60B10020
RATES: Final = (100, 250, 500, 625, 800, 1000, 1250, 1600, 2000)
BITRATES: Final = (250_000, 500_000, 800_000, 1_000_000)
FAST: Final = 1250
"""Rate at which setpoints of 8 bytes use 94 % of 1 Mbit/s, and setpoints of 4 bytes 79 % [Hz]."""


def _files(folder: Path) -> dict[str, Path]:
    """Write an EDS for every kind of drive."""
    found = {MAPPABLE: SERVO}
    for kind, entries in ((LACKING, None), (FIXED_4, (TARGET,)), (FIXED_8, (TARGET, OFFSET))):
        rows = OWN if entries else [row for row in OWN if row[0] != 0x60B1]
        values = {}
        if entries:
            rows = [(*row[:3], "ro", *row[4:]) if row[0] == 0x1601 or row[:2] == (0x1401, 1) else row for row in rows]
            values = {(0x1601, 0): len(entries), (0x1601, 2): 0, (0x1401, 1): 0x301}
            values |= {(0x1601, number): entry for number, entry in enumerate(entries, start=1)}
        found[kind] = folder / f"{kind}.eds"
        found[kind].write_text(eds(rows, values))
    return found


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return _files(tmp_path_factory.mktemp("eds"))


class Rig(test_cia402.Rig):
    """Three drives of given kinds, and every frame of the bus."""

    def __init__(
        self, files: dict[str, Path], kinds: Sequence[str] = (MAPPABLE,) * 3, bitrate: int = 1_000_000, **keys: Any
    ) -> None:
        self._files, self._kinds = files, kinds
        io = keys.pop("io", NO_IO)
        a, b, c = alike()
        super().__init__(Drives("cia402", a, b, c, sdo_timeout=0.01, **keys), io)
        self.drives._timing = BusTiming(bitrate)

    def device(self, drive: Drive, counts: float) -> SimulatedDrive:
        path = self._files[self._kinds[drive.node - 1]]
        return SimulatedDrive(drive.node, ideal_servo(drive, round(counts)), eds=path)

    def lengths(self, base: int) -> list[set[int]]:
        """Lengths of the frames that each drive was sent on one service."""
        return [{len(data) for data in each} for each in self.sent_to(base)]

    def powered(self, rate: int) -> Rig:
        """Set up and enable the drives."""
        self.period = 1.0 / rate
        self.drives.configure(self.period)
        self.drives.enable()
        feedback = self.cycles(40, START)
        assert feedback.fault is None
        assert set(feedback.state) == {PowerState.OPERATION_ENABLED}
        return self


def bits(length: int) -> int:
    """Worst-case length of a frame: every stuffed field counted bit by bit, as in ISO 11898-1."""
    stuffed = 1 + 11 + 1 + 1 + 1 + 4 + 8 * length + 15  # SOF, identifier, RTR, IDE, r0, DLC, data, CRC
    run, extra, left = 0, 0, stuffed
    while left:
        run, left = run + 1, left - 1
        if run == 5:  # the stuff bit begins the next run
            extra, run = extra + 1, 1
    return stuffed + extra + 1 + 2 + 7 + 3  # CRC delimiter, ACK with delimiter, EOF, interframe space


def share(setpoints: Sequence[int], rate: int, bitrate: int, heartbeat: float) -> float:
    """Load of the bus by hand: a SYNC, setpoints and positions per cycle; statuswords and heartbeats in between."""
    cycle = bits(0) + sum(map(bits, setpoints)) + 3 * bits(4)
    return (rate * cycle + 3 * bits(2) / 0.1 + 4 * bits(1) / heartbeat) / bitrate


def test_the_count_by_hand_agrees_with_published_numbers() -> None:
    assert bits(0) + 3 * bits(8) + 3 * bits(4) == 745
    assert bits(0) + 6 * bits(4) == 625


# ---------------------------------------------------------------------- the choice


@settings(max_examples=60, deadline=None)
@example(rate=FAST, bitrate=1_000_000, heartbeat=0.1, setting="auto", kinds=(MAPPABLE,) * 3)
@example(rate=FAST, bitrate=1_000_000, heartbeat=0.1, setting="always", kinds=(MAPPABLE, LACKING, FIXED_4))
@example(rate=1000, bitrate=1_000_000, heartbeat=0.1, setting="never", kinds=(FIXED_8, MAPPABLE, LACKING))
@example(rate=FAST, bitrate=1_000_000, heartbeat=0.1, setting="auto", kinds=(FIXED_8,) * 3)
@given(
    rate=st.sampled_from(RATES),
    bitrate=st.sampled_from(BITRATES),
    heartbeat=st.sampled_from((0.05, 0.1, 0.5)),
    setting=st.sampled_from(("auto", "always", "never")),
    kinds=st.tuples(*[st.sampled_from(KINDS)] * 3),
)
def test_the_budget_of_the_bus_decides_and_the_drive_has_the_last_word(
    files: dict[str, Path], rate: int, bitrate: int, heartbeat: float, setting: str, kinds: tuple[str, str, str]
) -> None:
    full = share((8, 8, 8), rate, bitrate, heartbeat)
    wanted = setting == "always" or (setting == "auto" and full <= HIGH_LOAD)
    planned = full if wanted else share((4, 4, 4), rate, bitrate, heartbeat)
    lengths = [8 if kind == FIXED_8 or (wanted and kind == MAPPABLE) else 4 for kind in kinds]
    actual = share(lengths, rate, bitrate, heartbeat)
    rig = Rig(files, kinds, bitrate, heartbeat=heartbeat, velocity_offset=setting)
    try:
        if planned > 1.0 or actual > 1.0:
            with pytest.raises(BusError, match=r"takes \d+% of the bus at \d+ bit/s; the highest rate that fits"):
                rig.drives.configure(1.0 / rate)
            return
        rig.powered(rate)
        assert rig.lengths(canopen_frames.RPDO2) == [{length} for length in lengths]
        assert rig.drives.bus_load == pytest.approx(actual, rel=1e-12)
    finally:
        rig.drives.close()


def test_the_choice_does_not_depend_on_the_drives_that_answer(files: dict[str, Path]) -> None:
    """At 1190 Hz, one drive with the offset would keep the budget: a drive that comes later might have it as well."""
    rig = Rig(files, (MAPPABLE, LACKING, LACKING))
    assert share((8, 4, 4), 1190, 1_000_000, 0.1) < HIGH_LOAD < share((8, 8, 8), 1190, 1_000_000, 0.1)
    plan = plan_traffic(rig.config, NO_IO, 1190, DEFAULT_TIMING)
    assert (plan.velocity_offset, plan.setpoint_bytes) == (False, 4)
    assert plan.full_load == pytest.approx(share((8, 8, 8), 1190, 1_000_000, 0.1))
    rig.drives.close()


@pytest.mark.parametrize(("outputs", "length"), [(0, 8), (1, 4), (2, 4), (3, 4)])
def test_digital_outputs_count(closing: Closing, files: dict[str, Path], outputs: int, length: int) -> None:
    each = [DigitalIo(1 << 16)] * outputs + [DigitalIo()] * (3 - outputs)
    rig = closing(Rig(files, io=tuple(each))).powered(1000)
    assert rig.lengths(canopen_frames.RPDO2) == [{length}] * 3
    load = share((length,) * 3, 1000, 1_000_000, 0.1) + outputs * bits(4) * 1000 / 1e6
    assert rig.drives.bus_load == pytest.approx(load)


# ---------------------------------------------------------------------- what is said


def warnings_of(rig: Rig) -> list[str]:
    rig.drives.configure(1.0 / FAST)
    return list(rig.drives.read().warnings)


def test_an_offset_that_is_left_out_is_said_once(closing: Closing, files: dict[str, Path]) -> None:
    assert warnings_of(closing(Rig(files))) == [
        "CAN bus: 1.25 kHz uses 79 % of the bus: setpoints without velocity offset (4 bytes), because 8 bytes would "
        "use 94 %; the drives follow with more lag"
    ]


def test_an_offset_that_nobody_wants_is_not_said(closing: Closing, files: dict[str, Path]) -> None:
    assert warnings_of(closing(Rig(files, velocity_offset="never"))) == []


def test_an_offset_that_is_always_wanted_is_mapped_up_to_a_full_bus(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files, velocity_offset="always"))
    assert warnings_of(rig) == ["CAN bus: 1250 Hz takes up to 94% of the bus; keep the load below 80%"]
    assert rig.drives.bus_load == pytest.approx(share((8, 8, 8), FAST, 1_000_000, 0.1))


def test_an_offset_that_does_not_fit_is_refused_with_the_way_out(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files, bitrate=850_000, velocity_offset="always"))
    with pytest.raises(
        BusError,
        match=r"^1250 Hz takes 110% of the bus at 850000 bit/s; the highest rate that fits is 1134 Hz; "
        r'drives\.velocity_offset = "auto" uses 92 %, or CAN FD \(can\.fd = true\), if the drives and the adapter have '
        r"it, uses 49 %$",
    ):
        rig.drives.configure(1.0 / FAST)
    assert not rig.bus.sent, "no drive has been contacted"


def test_no_way_out_is_named_that_does_not_fit_either(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files, bitrate=250_000, velocity_offset="always"))
    with pytest.raises(BusError, match=r"the highest rate that fits is 329 Hz$"):
        rig.drives.configure(1.0 / FAST)


def test_a_fixed_mapping_with_the_offset_stays_and_is_said(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files, (FIXED_8, MAPPABLE, MAPPABLE), velocity_offset="never"))
    said = "\n".join(warnings_of(rig))
    assert "drive A: the fixed mapping of its setpoints contains the velocity offset, which stays in use" in said
    assert "PDO 1401 is used as it is mapped, for setpoints 607A" in said


# ---------------------------------------------------------------------- frames


def test_setpoints_of_four_bytes_move_the_sliders(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files)).powered(FAST)
    goal = (START[0] + 2e-4, START[1] - 2e-4, START[2] + 1e-4)
    rig.bus.sent.clear()
    for _ in range(20):
        feedback = rig.cycle(goal, (0.1, -0.1, 0.05))
    assert feedback.position == pytest.approx(goal, abs=1e-6)
    sent = rig.sent_to(canopen_frames.RPDO2)
    assert [each[-1] for each in sent] == [round(1e6 * at).to_bytes(4, "little", signed=True) for at in goal]
    assert [len(each) for each in sent] == [20] * 3


def test_setpoints_of_eight_bytes_are_those_of_every_robot_that_fits(closing: Closing, files: dict[str, Path]) -> None:
    rigs = [closing(Rig(files, velocity_offset=setting)) for setting in ("auto", "always")]
    for rig in rigs:
        rig.powered(1000).cycle(START, (0.1, 0.0, -0.1))
    auto, always = (rig.bus.sent for rig in rigs)
    assert auto == always, "the set-up and every cycle are the same to the last bit"
    assert {length for each in rigs[0].lengths(canopen_frames.RPDO2) for length in each} == {8}


def test_the_mapping_of_the_drives_is_that_of_the_frames(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files)).powered(FAST)
    for device in rig.devices:
        held = {key: device.objects[key].value for key in ((0x1601, 0), (0x1601, 1), (0x1401, 2), (0x1A01, 0))}
        assert held == {(0x1601, 0): 1, (0x1601, 1): TARGET, (0x1401, 2): 1, (0x1A01, 0): 1}


@pytest.mark.parametrize("rate", [500, FAST])
@pytest.mark.parametrize("lacks", [(), (0x60B0,), (0x60B1,), (0x60B2,), (0x60B0, 0x60B1, 0x60B2)])
def test_a_drive_adds_no_offset_that_another_program_has_left(
    closing: Closing, tmp_path: Path, rate: int, lacks: tuple[int, ...]
) -> None:
    """A service that died in a motion leaves its last offset in a drive that keeps its supply."""
    path = tmp_path / "offsets.eds"
    path.write_text(eds([*OWN, (0x60B0, 0, 4, "rw", 0, True), (0x60B2, 0, 3, "rw", 0, True)], lacks=lacks))
    rig = closing(Rig({MAPPABLE: path}))
    there = {0x60B0, 0x60B1, 0x60B2} - {*lacks}
    for device in rig.devices:
        for index in there:
            device.objects[index, 0].value = 5000
    rig.powered(rate)
    assert [device.objects[index, 0].value for device in rig.devices for index in there] == [0] * 3 * len(there)
    assert rig.cycles(50, START).position == pytest.approx(START, abs=1e-6)


def test_positions_take_four_bytes_and_statuswords_come_on_change(
    closing: Closing, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """TPDO2 is the position alone; TPDO1 comes when the statusword changes, and every 100 ms."""
    for setting in ("auto", "always"):
        rig = closing(Rig(files, velocity_offset=setting))
        heard: list[tuple[int, bytes]] = []
        receive = rig.bus.recv

        def recv(timeout: float | None = None, *, receive: Any = receive, heard: Any = heard) -> can.Message | None:
            message: can.Message | None = receive(timeout)
            if message is not None:
                heard.append((message.arbitration_id, bytes(message.data)))
            return message

        monkeypatch.setattr(rig.bus, "recv", recv)
        rig.powered(1000)
        heard.clear()
        rig.cycles(1000, START)
        for node in (1, 2, 3):
            positions = [data for can_id, data in heard if can_id == canopen_frames.TPDO2 + node]
            assert {len(data) for data in positions} == {4}
            assert len(positions) == 1000
            statuses = [data for can_id, data in heard if can_id == canopen_frames.TPDO1 + node]
            assert {len(data) for data in statuses} == {2}
            assert 9 <= len(statuses) <= 11, "unchanged, it is repeated every 100 ms only"
        heard.clear()
        rig.drives.quick_stop()
        rig.cycles(20, START)
        assert sum(can_id == canopen_frames.TPDO1 + 1 for can_id, _ in heard) >= 1, "a change is sent within 20 ms"


def test_a_drive_that_comes_back_is_set_up_like_the_others(closing: Closing, files: dict[str, Path]) -> None:
    rig = closing(Rig(files)).powered(FAST)
    for _ in range(20):
        rig.cycle(START)
    device = rig.devices[1]
    device.objects[0x1601, 0].value = 2
    device.receive(canopen_frames.NMT, canopen_frames.NMT_COMMAND.pack(0x81, device.node), rig.clock.now)
    for _ in range(4000):
        feedback = rig.cycle(START)
    assert feedback.unready == (None, None, None)
    assert device.objects[0x1601, 0].value == 1
    assert rig.lengths(canopen_frames.RPDO2) == [{4}] * 3


def test_an_inspection_shows_the_mapping_of_the_set_up(closing: Closing, files: dict[str, Path]) -> None:
    for kinds, lengths in (((MAPPABLE,) * 3, [4] * 3), ((MAPPABLE, FIXED_8, LACKING), [4, 8, 4])):
        rig = closing(Rig(files, kinds))
        for apply in (False, True):
            shown = inspection.inspect(rig.bus, rig.config, 1.0 / FAST, rig.clock, apply=apply)
            assert [each["setpoint_bytes"] for each in shown] == lengths
            load = share(lengths, FAST, 1_000_000, 0.1)
            assert [each["bus_load"] for each in shown] == pytest.approx([load] * 3)


def test_the_period_of_the_rigs_keeps_the_offset() -> None:
    config = msgspec.structs.replace(test_cia402.CONFIG)
    assert plan_traffic(config, NO_IO, 1.0 / STEP, DEFAULT_TIMING).velocity_offset
