"""Opening a bus: each failure is one line that names the remedy."""

from __future__ import annotations

import errno
from pathlib import Path

import can
import msgspec
import pytest
from control_rig import CONFIG
from drivers.test_odrive import odrives
from rigs import alike
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Can, Drive, Drives
from trirail_drivers.connection import opening
from trirail_drivers.errors import BusError, DriveError
from trirail_drivers.odrive.drives import Odrive

DRIVES = Drives("cia402", *alike())


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


@pytest.mark.parametrize(("protocol", "of"), [("cia402", Cia402), ("odrive", Odrive)])
def test_connect_gives_the_drives_of_the_protocol_set_up_and_answering(protocol: str, of: type) -> None:
    drives = opening.connect(Can("simulated"), msgspec.structs.replace(DRIVES, protocol=protocol))
    assert isinstance(drives, of)
    try:
        drives.configure(0.001)
        assert drives.read().fault is None
        assert 0.7 < drives.bus_load < 1.0
    finally:
        drives.close()


def test_connect_leaves_no_bus_open_where_the_drives_are_impossible(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = StandInBus()
    monkeypatch.setattr(opening, "open_bus", lambda *given: opened)
    far = Drive(node=1, counts_per_metre=1e6, offset=1e6)
    with pytest.raises(DriveError, match="drive A"):
        opening.connect(Can(interface="virtual"), Drives(protocol="cia402", A=far, B=DRIVES.B, C=DRIVES.C))
    assert opened._is_shutdown


def test_unknown_interface_lists_the_known_ones() -> None:
    text = refusal(Can(interface="socketcn", channel="can0"))
    assert '"socketcn" is unknown' in text
    for known in ("simulated", "unix", "socketcan", "virtual"):
        assert known in text


def test_unix_bus_nobody_serves(tmp_path: Path) -> None:
    assert str(tmp_path / "bus") in refusal(Can(interface="unix", channel=str(tmp_path / "bus")))


BOUND = can.CanInitializationError("cannot bind")
BOUND.__cause__ = OSError(errno.ENODEV, "No such device")


@pytest.mark.parametrize(
    ("error", "section", "said"),
    [
        (
            OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol"),
            Can("socketcan", channel="can0"),
            ["modprobe can_raw"],
        ),
        (
            OSError(errno.ENODEV, "No such device"),
            Can("socketcan", channel="can0", bitrate=500_000),
            ['no CAN interface "can0"', "ip link set can0 up type can bitrate 500000"],
        ),
        (BOUND, Can("socketcan", channel="vcan0"), ["ip link add vcan0 type vcan && ip link set vcan0 up"]),
        (
            can.CanInitializationError("no such\nadapter"),
            Can("vector", channel="1"),
            ['cannot open CAN interface vector, channel "1": no such adapter'],
        ),
    ],
    ids=["no SocketCAN", "no interface", "no virtual interface", "python-can's reason"],
)
def test_what_cannot_be_opened_is_one_line_with_the_remedy(
    error: Exception, section: Can, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**kwargs: object) -> can.BusABC:
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    text = refusal(section)
    assert all(each in text for each in said)


@pytest.mark.parametrize(("up", "carrier"), [(True, "1"), (True, "0"), (False, "0")])
def test_can_interface_that_is_down(up: bool, carrier: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "can0").mkdir()
    (tmp_path / "can0" / "flags").write_text("0x40081\n" if up else "0x40080\n")
    (tmp_path / "can0" / "carrier").write_text(f"{carrier}\n")
    monkeypatch.setattr(opening, "NETWORK_INTERFACES", tmp_path)
    monkeypatch.setattr(can, "Bus", lambda **kwargs: StandInBus())
    section = Can(interface="socketcan", channel="can0")
    if up and carrier == "1":
        opening.open_bus(section, DRIVES).shutdown()
    elif up:
        assert "is in bus-off; check cable" in refusal(section)
    else:
        assert '"can0" is down; bring it up with: ip link set can0 up' in refusal(section)


@pytest.mark.parametrize("config", [DRIVES, odrives(CONFIG).drives], ids=["cia402", "odrive"])
@pytest.mark.parametrize(
    ("error", "section", "waits"),
    [
        (OSError(errno.ENODEV, "No such device"), Can("socketcan", channel="can0"), True),
        (OSError(errno.EAFNOSUPPORT, "not supported"), Can("socketcan", channel="can0"), True),
        (BOUND, Can("socketcan", channel="vcan0"), True),
        (can.CanInitializationError("no adapter"), Can("vector", channel="1"), True),
        (can.CanOperationError("unplugged"), Can("vector", channel="1"), True),
        (can.CanInterfaceNotImplementedError("no module"), Can("vector", channel="1"), False),
        (TypeError("unexpected option"), Can("vector", channel="1"), False),
        (NameError("canlib"), Can("kvaser", channel="0"), False),
        (None, Can("socketcn", channel="can0"), False),
    ],
)
def test_a_start_waits_for_a_bus_that_may_appear_and_for_no_other(
    error: Exception | None, section: Can, waits: bool, config: Drives, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(**kwargs: object) -> can.BusABC:
        assert error is not None
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    reason = refusal(section)
    if not waits:
        with pytest.raises(BusError):
            opening.connect(section, config, awaits=True)
        return
    drives = opening.connect(section, config, awaits=True)
    try:
        drives.configure(0.001, awaits=True)
        fault = drives.read().fault
        assert fault is not None
        assert fault.message == f"CAN bus {section.channel} is down: {reason}"
    finally:
        drives.close()
