"""Opening a bus: each failure is one line that names the remedy."""

from __future__ import annotations

import errno
from pathlib import Path

import can
import msgspec
import pytest
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Can, Drive, Drives
from trirail_drivers.connection import opening
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.odrive.drives import Odrive

DRIVES = Drives(
    protocol="cia402",
    A=Drive(node=1, counts_per_metre=1e6),
    B=Drive(node=2, counts_per_metre=1e6),
    C=Drive(node=3, counts_per_metre=1e6),
)


class StandInBus(can.BusABC):
    """What python-can gives for an interface that this machine does not have."""

    def __init__(self) -> None:
        self.channel_info = "stand-in"
        super().__init__(channel="stand-in")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise AssertionError("nothing is sent here")


def refusal(section: Can) -> str:
    with pytest.raises(BusError) as caught:
        opening.open_bus(section, DRIVES)
    text = str(caught.value)
    assert "\n" not in text
    return text


def failing_with(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**kwargs: object) -> can.BusABC:
        raise error

    monkeypatch.setattr(can, "Bus", fail)


def test_simulated_drives_answer() -> None:
    opened = opening.open_bus(Can(interface="simulated"), DRIVES)
    try:
        opened.send(can.Message(arbitration_id=0x602, data=b"\x40\0\x10\0\0\0\0\0", is_extended_id=False))
        answers = []
        while (message := opened.recv(0)) is not None:
            answers.append(message.arbitration_id)
        assert 0x582 in answers
    finally:
        opened.shutdown()


def test_connect_gives_drives_that_can_be_configured() -> None:
    drives = opening.connect(Can(interface="simulated"), DRIVES)
    assert isinstance(drives, Cia402)
    try:
        drives.configure(0.001)
        assert 0.7 < drives.bus_load < 0.8
    finally:
        drives.close()


def test_connect_gives_the_drives_of_the_protocol() -> None:
    section = msgspec.structs.replace(DRIVES, protocol="odrive")
    drives = opening.connect(Can(interface="simulated"), section)
    assert isinstance(drives, Odrive)
    try:
        drives.configure(0.001)
        assert drives.read().fault is None
    finally:
        drives.close()


def test_connect_leaves_no_bus_open_where_the_drives_are_impossible(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = StandInBus()
    monkeypatch.setattr(opening, "open_bus", lambda *given: opened)
    far = Drive(node=1, counts_per_metre=1e6, offset=1e6)
    with pytest.raises(DriveError, match="drive A"):
        opening.connect(Can(interface="virtual"), Drives(protocol="cia402", A=far, B=DRIVES.B, C=DRIVES.C))
    assert opened._is_shutdown


def test_any_python_can_interface_opens() -> None:
    opened = opening.open_bus(Can(interface="virtual", channel="test-bus"), DRIVES)
    assert opened.recv(0) is None
    opened.shutdown()


def test_unknown_interface_lists_the_known_ones() -> None:
    text = refusal(Can(interface="socketcn", channel="can0"))
    assert '"socketcn" is unknown' in text
    for known in ("simulated", "unix", "socketcan", "virtual"):
        assert known in text


def test_unix_bus_nobody_serves(tmp_path: Path) -> None:
    assert str(tmp_path / "bus") in refusal(Can(interface="unix", channel=str(tmp_path / "bus")))


def test_kernel_without_socketcan(monkeypatch: pytest.MonkeyPatch) -> None:
    failing_with(OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol"), monkeypatch)
    assert "modprobe can_raw" in refusal(Can(interface="socketcan", channel="can0"))


def test_missing_can_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    failing_with(OSError(errno.ENODEV, "No such device"), monkeypatch)
    text = refusal(Can(interface="socketcan", channel="can0", bitrate=500_000))
    assert 'no CAN interface "can0"' in text
    assert "ip link set can0 up type can bitrate 500000" in text


def test_missing_virtual_can_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    error = can.CanInitializationError("cannot bind")
    error.__cause__ = OSError(errno.ENODEV, "No such device")
    failing_with(error, monkeypatch)
    text = refusal(Can(interface="socketcan", channel="vcan0"))
    assert "ip link add vcan0 type vcan && ip link set vcan0 up" in text


@pytest.mark.parametrize("up", [True, False])
def test_can_interface_that_is_down(up: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "can0").mkdir()
    (tmp_path / "can0" / "flags").write_text("0x40081\n" if up else "0x40080\n")
    monkeypatch.setattr(opening, "NETWORK_INTERFACES", tmp_path)
    monkeypatch.setattr(can, "Bus", lambda **kwargs: StandInBus())
    section = Can(interface="socketcan", channel="can0")
    if up:
        opening.open_bus(section, DRIVES).shutdown()
    else:
        assert '"can0" is down; bring it up with: ip link set can0 up' in refusal(section)


def test_other_failures_keep_python_cans_reason_on_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    failing_with(can.CanInitializationError("no such\nadapter"), monkeypatch)
    text = refusal(Can(interface="vector", channel="1"))
    assert text == 'cannot open CAN interface vector, channel "1": no such adapter'
