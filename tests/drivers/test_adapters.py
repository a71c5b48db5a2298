"""Any python-can interface: options handed on as they are, and what is missing named in one line."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from trirail.config import SIM, load
from trirail_drivers import bus
from trirail_drivers.config import Can
from trirail_drivers.errors import BusError
from trirail_drivers.interface import Drives, Feedback, PowerState

ROOT = Path(__file__).parents[2]
SIMULATED = load(SIM)
GROUP = "239.74.163.2"
"""A multicast group of the local scope (RFC 2365)."""
WITHIN = 30.0
"""How long a busy machine may take for anything [s]."""
KNOWN = sorted(can.VALID_INTERFACES - {"socketcan", "virtual", "udp_multicast"})


@pytest.mark.parametrize(
    ("section", "given"),
    [
        (
            Can(interface="gs_usb", options={"index": 0}),
            {"interface": "gs_usb", "channel": "", "bitrate": 1_000_000, "index": 0},
        ),
        (
            Can(interface="pcan", channel="PCAN_USBBUS2", bitrate=500_000, options={"auto_reset": True}),
            {"interface": "pcan", "channel": "PCAN_USBBUS2", "bitrate": 500_000, "auto_reset": True},
        ),
        (
            Can(interface="slcan", channel="/dev/ttyACM0", options={"tty_baudrate": 921_600, "sleep_after_open": 0.5}),
            {"interface": "slcan", "channel": "/dev/ttyACM0", "bitrate": 1_000_000, "tty_baudrate": 921_600,
             "sleep_after_open": 0.5},
        ),
    ],
    ids=lambda value: value.interface if isinstance(value, Can) else "",
)  # fmt: skip
def test_options_reach_python_can_as_they_are(
    section: Can, given: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[dict[str, object]] = []

    def opened(**keywords: object) -> can.BusABC:
        calls.append(keywords)
        raise can.CanInitializationError("no adapter here")

    monkeypatch.setattr(can, "Bus", opened)
    with pytest.raises(BusError):
        bus.open_bus(section, SIMULATED.drives)
    assert calls == [given | {"ignore_config": True}]


def socketcand(listening: socket.socket, heard: list[str]) -> None:
    """A daemon as github.com/linux-can/socketcand has it: a greeting, a bus opened, raw mode, one frame, one answer."""
    with listening, listening.accept()[0] as client:
        client.sendall(b"< hi >")
        for _ in range(2):
            heard.append(client.recv(1024).decode())
            client.sendall(b"< ok >")
        heard.append(client.recv(1024).decode())
        client.sendall(b"< frame 582 23.424242 4B000000 >")


def test_socketcand_by_host_and_port() -> None:
    listening = socket.create_server(("127.0.0.1", 0))
    heard: list[str] = []
    server = threading.Thread(target=socketcand, args=(listening, heard))
    server.start()
    section = Can(
        interface="socketcand", channel="can7", options={"host": "127.0.0.1", "port": listening.getsockname()[1]}
    )
    opened = bus.open_bus(section, SIMULATED.drives)
    try:
        opened.send(can.Message(arbitration_id=0x602, data=b"\x40", is_extended_id=False))
        answer = opened.recv(5.0)
    finally:
        opened.shutdown()
        server.join(5.0)
    assert heard == ["< open can7 >", "< rawmode >", "< send 602 1 40 >"]
    assert answer is not None
    assert (answer.arbitration_id, bytes(answer.data)) == (0x582, b"\x4b\0\0\0")


@pytest.mark.parametrize("interface", KNOWN)
def test_an_interface_that_this_machine_does_not_have_is_one_line(interface: str) -> None:
    """Whatever python-can or the maker's library raises: NameError, AttributeError, ImportError, OSError."""
    with pytest.raises(BusError) as refused:
        bus.open_bus(Can(interface=interface, channel="no-such-adapter"), SIMULATED.drives)
    assert interface in str(refused.value)
    assert "\n" not in str(refused.value)


def forget(interface: str) -> None:
    """Have python-can import an interface anew."""
    for name in [name for name in sys.modules if name.startswith(f"can.interfaces.{interface}")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("interface", "modules", "remedy"),
    [
        ("slcan", ("serial",), "pip install 'python-can[serial]'"),
        ("udp_multicast", ("msgpack",), "pip install 'python-can[multicast]'"),
        ("gs_usb", ("gs_usb", "usb"), "pip install 'python-can[gs-usb]'"),
        ("kvaser", (), "Kvaser's CANlib (libcanlib.so), which is not installed; Linux knows these adapters"),
        ("pcan", (), "PEAK's PCAN-Basic (libpcanbasic.so), which is not installed; Linux knows these adapters"),
    ],
)  # fmt: skip
def test_a_missing_library_is_named_with_its_package(
    interface: str, modules: tuple[str, ...], remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    forget(interface)
    with pytest.raises(BusError) as refused:
        bus.open_bus(Can(interface=interface, channel="0"), SIMULATED.drives)
    forget(interface)
    assert remedy in str(refused.value)


def cycle(drives: Drives, position: float = 0.0) -> Feedback:
    """One cycle, as slow as the answers to its SYNC."""
    drives.sync()
    deadline = time.monotonic() + WITHIN
    while True:
        feedback = drives.read()
        if feedback.age == (0, 0, 0) or feedback.fault or time.monotonic() > deadline:
            drives.write((position,) * 3, (0.0,) * 3)
            return feedback
        os.sched_yield()


def until(drives: Drives, condition: Callable[[Feedback], bool], position: float = 0.0) -> None:
    deadline = time.monotonic() + WITHIN
    while not condition(feedback := cycle(drives, position)):
        assert feedback.fault is None, feedback.fault
        assert time.monotonic() < deadline, feedback


def multicast(tmp_path: Path) -> Path:
    """A configuration whose bus is a multicast group that does not leave this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    section = f'interface = "udp_multicast"\nchannel = "{GROUP}"\noptions = {{ port = {port}, hop_limit = 0 }}'
    path = tmp_path / "multicast.toml"
    text = SIM.read_text().replace('interface = "simulated"', section).replace("heartbeat = 0.1", "heartbeat = 2.0")
    path.write_text(text.replace("missed_syncs = 150", "missed_syncs = 10_000"))
    return path


def test_drives_of_another_process_by_udp_multicast(tmp_path: Path) -> None:
    """python-can's own bus between processes: set-up by SDO, then setpoints and positions by PDO."""
    path = multicast(tmp_path)
    config = load(path)
    command = [sys.executable, str(ROOT / "tools/virtual_drives.py"), str(path), "--interface", config.can.interface,
               "--channel", config.can.channel]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        assert "switch on disabled" in served.stdout.readline()
        drives = bus.connect(config.can, config.drives)
        try:
            drives.configure(config.period)
            cycle(drives)
            drives.enable()
            until(drives, lambda feedback: set(feedback.state) == {PowerState.OPERATION_ENABLED})
            until(drives, lambda feedback: min(feedback.position) > 0.9e-4, position=1e-4)
        finally:
            drives.close()
            served.terminate()


def test_a_virtual_bus_ends_with_its_process() -> None:
    """python-can's "virtual" joins buses of one process, as drives and driver of one script."""
    section = Can(interface="virtual", channel="one-process", options={"preserve_timestamps": True})
    here, there = bus.open_bus(section, SIMULATED.drives), bus.open_bus(section, SIMULATED.drives)
    try:
        here.send(can.Message(arbitration_id=0x080, is_extended_id=False))
        heard = there.recv(1.0)
        assert heard is not None
        assert heard.arbitration_id == 0x080
    finally:
        here.shutdown()
        there.shutdown()
