"""Faults on demand: their language, when they come, what they do to frames, and the program that takes them."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from rigs import frame
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402 import canopen_frames
from trirail_drivers.errors import DriveError
from trirail_drivers.interface import PowerState
from trirail_drivers.protocols import CIA402, ODRIVE, PROTOCOLS
from trirail_drivers.simulated import Servo, SimulatedBus, SimulatedDrive
from trirail_drivers.simulated.faultlines import HELP, Condition, FaultSyntaxError, parse
from trirail_drivers.simulated.faults import Faults

ROOT = Path(__file__).parents[2]
WAIT = 20.0
SCALE = 1e6


class Rig:
    """Three drives that send a heartbeat every 10 ms, on a bus whose clock the tests turn."""

    def __init__(self) -> None:
        self.now = 100.0
        servo = (Servo(0.0, time_constant=0.0, max_velocity=2e6, max_acceleration=1e9) for _ in range(3))
        drives = [SimulatedDrive(node, each) for node, each in enumerate(servo, start=1)]
        self.said: list[str] = []
        self.faults = Faults(drives, [SCALE, -SCALE, SCALE], CIA402.fault_frames, seed=7, announce=self.said.append)
        self.drives = drives
        self.bus = SimulatedBus(drives, lambda: self.now, self.faults)
        for drive in drives:
            drive.objects[0x1017, 0].write(10)
        self.take()

    def take(self) -> list[tuple[int, bytes]]:
        taken = []
        while (message := self.bus.recv(0)) is not None:
            taken.append((message.arbitration_id, bytes(message.data)))
        return taken

    def wait(self, seconds: float) -> list[tuple[int, bytes]]:
        taken = []
        for _ in range(round(seconds * 1000)):
            self.now += 0.001
            taken += self.take()
        return taken

    def heartbeats(self, seconds: float) -> list[int]:
        """How many of each drive."""
        heard = [can_id for can_id, _ in self.wait(seconds)]
        return [heard.count(canopen_frames.HEARTBEAT + node) for node in (1, 2, 3)]

    def upload(self, node: int) -> list[bytes]:
        """Ask a drive for its device type."""
        self.bus.send(frame(0x600 + node, b"\x40\0\x10\0\0\0\0\0"))
        return [data for can_id, data in self.take() if can_id == 0x580 + node]


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.bus.shutdown()


def test_a_line_with_everything() -> None:
    fault = parse("at 2.5 when B moving with 0.25 all delay 0.002 tpdo2 0x7F for 3 frames", CIA402.fault_frames)
    assert (fault.name, fault.drives, fault.value) == ("delay", (0, 1, 2), 0.002)
    assert (fault.delay, fault.condition, fault.chance) == (2.5, Condition(1, "moving"), 0.25)
    assert (fault.duration, fault.number) == (math.inf, 3)
    assert [each.match(False, 0x282, 2) for each in fault.frames] == [True, False]
    assert [each.match(True, 0x07F, 2) for each in fault.frames] == [False, True]


def test_frames_of_odrives_have_the_names_of_their_manual() -> None:
    chosen = parse("B drop set_input_pos heartbeat position-request", ODRIVE.fault_frames).frames
    sent = [(True, 0xEC), (False, 0xE1), (True, 0xE9), (False, 0xE9), (True, 0xE1), (True, 0x0C)]
    assert [[each.match(*frame, 7) for each in chosen] for frame in sent] == [
        [True, False, False],
        [False, True, False],
        [False, False, True],
        *[[False, False, False]] * 3,
    ]
    with pytest.raises(FaultSyntaxError, match='unknown frames "sync"; known are set_axis_state, '):
        parse("B drop sync", ODRIVE.fault_frames)


@pytest.mark.parametrize("line", ["B emcy 4310", "B fault 4310", "B reboot"])
def test_what_happens_in_a_moment_lasts_only_if_told_to(line: str) -> None:
    assert parse(line, CIA402.fault_frames).duration == 0.0
    assert parse(f"{line} for 2", CIA402.fault_frames).duration == 2.0
    assert parse("B silent", CIA402.fault_frames).duration == math.inf


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("", "expected a fault at the end, such as: A silent; known faults are drop, "),
        ("A", "expected a fault"),
        ("A slient", 'unknown fault "slient"; did you mean silent?'),
        ("D silent", 'unknown fault "D"; known are .*, A, B, C, all'),
        ("silent", "silent is a fault of a drive: name the drive, as in: A silent"),
        ("A bus-off", "bus-off is a fault of the bus: do not name a drive"),
        ("at A silent", "at A: at must be followed by seconds, as in: at 2.5 A silent"),
        ("at -1 A silent", "at must be followed by seconds"),
        ("at nan A silent", "at must be followed by seconds"),
        ("with 0 A drop", "with 0: with must be followed by a chance above 0, at most 1"),
        ("with 1.1 A drop", "a chance above 0, at most 1"),
        ("when D moving A silent", "when must be followed by A, B, C or any"),
        ("when A flying A silent", 'unknown condition "flying"; known are enabled, moving, stopping, fault'),
        ("A emcy", "emcy must be followed by an error code, four hexadecimal digits, as in: A emcy 4310"),
        ("A emcy 0", "an error code"),
        ("A emcy 10000", "an error code"),
        ("A dlc 9", "dlc must be followed by a length from 0 to 8"),
        ("babble 800", "babble must be followed by an identifier, hexadecimal"),
        ("A drop tpdo9", 'unknown frames "tpdo9"; did you mean tpdo'),
        ("A drop 0x800", 'unknown frames "0x800"'),
        ("A silent tpdo2", '"tpdo2" after silent: only "for" may follow, as in: A silent for 0.5'),
        ("A silent for", "for must be followed by seconds"),
        ("A silent for 3 frames", '"frames" after for 3: the line must end as in: for 0.5'),
        ("A drop for 1.5 frames", "for 0.5, or for 3 frames"),
        ("A drop for 0 frames", "for 0.5, or for 3 frames"),
        ("A drop for 1 later", '"later" after for 1: the line must end as in'),
    ],
)
def test_a_wrong_line_is_answered_with_what_would_be_right(line: str, right: str) -> None:
    with pytest.raises(FaultSyntaxError) as caught:
        parse(line, CIA402.fault_frames)
    text = str(caught.value)
    assert "\n" not in text
    assert re.search(right.replace("?", r"\?"), text)


def test_help_names_every_word() -> None:
    from trirail_drivers.simulated import faultlines

    names = [*faultlines.EITHER, *(name for each in PROTOCOLS.values() for name in each.fault_frames)]
    for word in (*faultlines._KINDS, *names, *faultlines.CONDITIONS, "at", "when", "with", "for"):
        assert re.search(rf"(?<![\w-]){re.escape(word)}(?![\w-])", HELP), word


def test_a_file_has_comments_and_is_refused_with_its_line(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "faults.txt"
    path.write_text("# first\n\nat 1 A silent  # then\nB drop tpdo2\n")
    rig.faults.load(path)
    assert rig.faults.lines() == ["at 1 A silent  (to come)", "B drop tpdo2  (to come)"]
    path.write_text("A silent\nB slient\n")
    with pytest.raises(FaultSyntaxError, match=r"faults\.txt:2: unknown fault"):
        rig.faults.load(path)
    with pytest.raises(DriveError, match="cannot read faults"):
        rig.faults.load(tmp_path / "none")


def test_a_fault_comes_at_its_time_and_goes_after_its_time(rig: Rig) -> None:
    rig.faults.add("at 0.5 B silent for 0.2")
    assert rig.heartbeats(0.495) == [49, 49, 49]
    rig.wait(0.010)
    assert rig.heartbeats(0.18) == [18, 0, 18]
    rig.wait(0.020)
    assert rig.heartbeats(0.1) == [10, 10, 10]
    assert rig.said == ["begins: at 0.5 B silent for 0.2", "is over: at 0.5 B silent for 0.2"]
    assert rig.faults.idle


def test_a_fault_waits_for_its_condition(rig: Rig) -> None:
    rig.faults.add("when A fault C silent")
    assert rig.heartbeats(0.1)[2] == 10
    rig.bus.drives[0].fail(0x4310)
    rig.wait(0.010)
    assert rig.heartbeats(0.1)[2] == 0


def test_clear_ends_what_is_and_what_is_to_come(rig: Rig) -> None:
    for line in ("A silent", "B stuck", "C lag 0.1", "at 0.5 B silent", "B emcy 4310 for 9"):
        rig.faults.add(line)
    rig.wait(0.1)
    rig.faults.clear()
    assert rig.faults.lines() == []
    assert rig.heartbeats(1.0) == [100, 100, 100]
    assert not rig.drives[1].errors
    assert [(d.servo.forced_velocity, d.servo.lag) for d in rig.bus.drives] == [(None, None)] * 3


def test_drop_strikes_the_frames_it_names_and_no_others(rig: Rig) -> None:
    rig.faults.add("B drop heartbeat for 3 frames")
    assert rig.heartbeats(0.1) == [10, 7, 10]
    assert rig.said[-1] == "is over: B drop heartbeat for 3 frames (3 frames)"
    rig.faults.add("B drop sdo-request")
    rig.wait(0.002)
    assert rig.upload(2) == []
    assert len(rig.upload(1)) == 1
    assert rig.heartbeats(0.1) == [10, 10, 10]


def test_duplicate_and_dlc(rig: Rig) -> None:
    rig.faults.add("A duplicate sdo-answer")
    rig.faults.add("B dlc 3 sdo-answer")
    rig.wait(0.002)
    assert rig.upload(1) == [b"\x43\0\x10\0\x92\x01\x02\0"] * 2
    assert rig.upload(2) == [b"\x43\0\x10"]


def test_delay_holds_a_frame_back_for_its_time(rig: Rig) -> None:
    rig.faults.add("C delay 0.0045 sdo-answer")
    rig.wait(0.002)
    assert rig.upload(3) == []
    assert not any(can_id == 0x583 for can_id, _ in rig.wait(0.004))
    assert any(can_id == 0x583 for can_id, _ in rig.wait(0.001))


def test_corrupt_turns_one_bit_round(rig: Rig) -> None:
    sound = rig.upload(1)[0]
    rig.faults.add("A corrupt sdo-answer")
    rig.wait(0.002)
    for _ in range(20):
        (struck,) = rig.upload(1)
        difference = int.from_bytes(sound) ^ int.from_bytes(struck)
        assert difference.bit_count() == 1


def test_chance_is_a_matter_of_the_seed() -> None:
    heard = []
    for seed in (1, 1, 2):
        rig = Rig()
        rig.faults.seed(seed)
        rig.faults.add("with 0.3 all drop heartbeat")
        heard.append([can_id for can_id, _ in rig.wait(2.0)])
        rig.bus.shutdown()
    assert heard[0] == heard[1] != heard[2]
    assert 600 * 0.6 < len(heard[0]) < 600 * 0.8


def test_a_drives_fault_by_chance_comes_again_and_again(rig: Rig) -> None:
    rig.faults.add("with 0.5 A silent for 0.1")
    rig.wait(60.0)
    assert 10 < sum(said.startswith("begins") for said in rig.said) < 60


def test_runaway_is_in_metres_whichever_way_counts_go(rig: Rig) -> None:
    rig.faults.add("all runaway 0.2")
    rig.wait(0.002)
    assert [drive.servo.forced_velocity for drive in rig.bus.drives] == [0.2 * SCALE, -0.2 * SCALE, 0.2 * SCALE]


def test_a_rebooting_drive_is_away_and_tells_of_its_return(rig: Rig) -> None:
    rig.faults.add("B reboot for 0.1")
    rig.wait(0.001)
    assert rig.heartbeats(0.09)[1] == 0
    assert (canopen_frames.HEARTBEAT + 2, b"\0") in rig.wait(0.02)
    assert rig.drives[1].objects[0x1017, 0].value == 0  # its set-up is gone
    assert rig.bus.drives[1].state is PowerState.SWITCH_ON_DISABLED


def test_a_fault_that_lasts_comes_back_after_a_fault_reset(rig: Rig) -> None:
    rig.faults.add("A fault 4310 for 0.1")
    rig.wait(0.01)
    for word in (0x00, 0x80):
        rig.drives[0].objects[0x6040, 0].write(word)
    rig.wait(0.01)
    assert rig.bus.drives[0].state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE)


def test_bus_off_lets_nothing_through_and_is_told_by_error_frames(rig: Rig) -> None:
    rig.faults.add("bus-off for 0.1")
    rig.now += 0.001
    told = rig.bus.recv(0)
    assert told is not None
    assert (told.is_error_frame, told.arbitration_id) == (True, 0x040)
    with pytest.raises(can.CanOperationError, match="No buffer space"):
        rig.bus.send(canopen_frames.nmt(canopen_frames.NMT_START, 1).message())
    assert rig.heartbeats(0.09) == [0, 0, 0]
    rig.wait(0.02)
    assert rig.upload(1)


def test_a_babbling_node_is_all_that_is_heard(rig: Rig) -> None:
    rig.faults.add("babble 100")
    rig.wait(0.002)
    heard = rig.wait(0.1)
    assert {can_id for can_id, _ in heard} == {0x100}
    assert len(heard) == 700
    assert rig.upload(1) == []


def virtual_drives(bus: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "tools/virtual_drives.py", "configs/sim.toml", "--interface", "unix"]
    command += ["--channel", str(bus), *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT, text=True)


@pytest.mark.parametrize("how", ["file", "typed"])
def test_virtual_drives_serve_a_bus_take_faults_and_leave_on_sigterm(how: str, tmp_path: Path) -> None:
    bus, typed = tmp_path / "can", how == "typed"
    lines = "B emcy 4310\nB slient\n" if typed else "B emcy 4310\n"
    (tmp_path / "faults").write_text(lines)
    with virtual_drives(bus, "--seed", "3", *([] if typed else ["--faults", str(tmp_path / "faults")])) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        if typed:
            assert program.stdout.readline() == "A switch on disabled, 0.000 mm\n"
            with UnixBus(str(bus)) as user:
                user.send(frame(0x602, b"\x40\0\x10\0\0\0\0\0"))
                heard = [user.recv(WAIT)]  # now they know of each other
                program.stdin.write(lines)
                program.stdin.flush()
                heard.append(user.recv(WAIT))
                assert [(one.arbitration_id, bytes(one.data[:2])) for one in heard if one] == [
                    (0x582, b"\x43\0"),
                    (0x082, b"\x10\x43"),
                ]
        said = ""
        while not said.startswith('unknown fault "slient"' if typed else "is over: B emcy 4310"):
            said = program.stdout.readline()
            assert said
        program.send_signal(signal.SIGTERM)
        assert program.wait(WAIT) == 0
    assert not bus.exists()


def test_virtual_drives_refuse_a_wrong_file_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "faults").write_text("A slient\n")
    with virtual_drives(tmp_path / "can", "--faults", str(tmp_path / "faults")) as program:
        said, _ = program.communicate(timeout=WAIT)
    assert program.returncode == 1
    assert said == f'virtual_drives: {tmp_path}/faults:1: unknown fault "slient"; did you mean silent?\n'
