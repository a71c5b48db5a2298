"""Any python-can interface: options handed on as they are, and what is missing named in one line."""

from __future__ import annotations

import os
import pty
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import can
import msgspec
import pytest
from drivers.real_time import cycle, cycle_until
from rigs import frame
from trirail.config import SIM, load
from trirail_drivers.config import Can, Simulated
from trirail_drivers.connection import opening
from trirail_drivers.errors import BusError
from trirail_drivers.interface import PowerState

ROOT = Path(__file__).parents[2]
SIMULATED = load(SIM)
DRIVES = msgspec.structs.replace(SIMULATED.drives, heartbeat=2.0, sdo_timeout=10.0)
"""A busy machine is no drive that is lost."""
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
    ],
    ids=lambda value: value.interface if isinstance(value, Can) else "",
)
def test_options_reach_python_can_as_they_are(
    section: Can, given: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[dict[str, object]] = []

    def opened(**keywords: object) -> can.BusABC:
        calls.append(keywords)
        raise can.CanInitializationError("no adapter here")

    monkeypatch.setattr(can, "Bus", opened)
    with pytest.raises(BusError):
        opening.open_bus(section, SIMULATED.drives)
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
    opened = opening.open_bus(section, SIMULATED.drives)
    try:
        opened.send(frame(0x602, b"\x40"))
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
        opening.open_bus(Can(interface=interface, channel="no-such-adapter"), SIMULATED.drives)
    assert interface in str(refused.value)
    assert "\n" not in str(refused.value)


@contextmanager
def imported_anew(interface: str) -> Iterator[None]:
    """Have python-can import an interface anew, and afterwards have what it had before."""

    def taken() -> dict[str, ModuleType]:
        names = [name for name in sys.modules if name.startswith(f"can.interfaces.{interface}")]
        return {name: sys.modules.pop(name) for name in names}

    before = taken()
    yield
    taken()
    sys.modules.update(before)


@pytest.mark.parametrize(
    ("interface", "modules", "remedy"),
    [
        ("slcan", ("serial",), "pip install 'python-can[serial]'"),
        ("udp_multicast", ("msgpack",), "pip install 'python-can[multicast]'"),
        ("gs_usb", ("gs_usb", "usb"), "pip install 'python-can[gs-usb]'"),
        ("kvaser", (), "Kvaser's CANlib (libcanlib.so), which is not installed; on Linux, these adapters"),
        ("pcan", (), "PEAK's PCAN-Basic (libpcanbasic.so), which is not installed; on Linux, these adapters"),
    ],
)  # fmt: skip
def test_a_missing_library_is_named_with_its_package(
    interface: str, modules: tuple[str, ...], remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)
    with imported_anew(interface), pytest.raises(BusError) as refused:
        opening.open_bus(Can(interface=interface, channel="0"), SIMULATED.drives)
    assert remedy in str(refused.value)


def slowly() -> float:
    """The driver's clock: on a busy machine a stall of a second is none of its time-outs."""
    return 0.1 * time.monotonic()


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


@pytest.mark.long
def test_drives_of_another_process_by_udp_multicast(tmp_path: Path) -> None:
    """python-can's own bus between processes: set-up by SDO, then setpoints and positions by PDO."""
    path = multicast(tmp_path)
    config = load(path)
    command = [sys.executable, str(ROOT / "tools/virtual_drives.py"), str(path), "--interface", config.can.interface,
               "--channel", config.can.channel]  # fmt: skip
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        assert served.stdout is not None
        assert "switch on disabled" in served.stdout.readline()
        drives = opening.connect(config.can, config.drives, slowly)
        try:
            drives.configure(config.period)
            cycle(drives)
            drives.enable()
            cycle_until(drives, lambda feedback: set(feedback.state) == {PowerState.OPERATION_ENABLED})
            cycle_until(drives, lambda feedback: min(feedback.position) > 0.9e-4, position=1e-4)
        finally:
            drives.close()
            served.terminate()


class SerialLineAdapter:
    """An adapter on a pseudo-terminal that speaks LAWICEL's protocol and answers each frame, with the drives behind it.

    Its manual: a frame is `t`, three digits of identifier, one of length and the data; CR tells that a command was
    taken, `z` and CR that a frame was.
    """

    def __init__(self, taken: bytes) -> None:
        self._taken = taken
        self._line, self._other = pty.openpty()  # the other end stays open, so that the line outlives its user
        self.channel = os.ttyname(self._other)
        self._told, self._tell = socket.socketpair()
        self._typed = bytearray()
        section = msgspec.structs.replace(SIMULATED.can, simulated=Simulated(missed_syncs=10_000))
        self._drives = opening.simulated_bus(section, DRIVES)
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> SerialLineAdapter:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._tell.send(b"!")
        self._thread.join()
        self._drives.shutdown()
        self._told.close()
        self._tell.close()
        os.close(self._line)
        os.close(self._other)

    def _serve(self) -> None:
        while True:
            readable, _, _ = select.select([self._line, self._told.fileno()], [], [], 0.01)
            if self._told.fileno() in readable:
                return
            if readable:
                self._typed += os.read(self._line, 4096)
                *commands, self._typed = self._typed.split(b"\r")
                for command in commands:
                    self._obey(bytes(command))
            while (answer := self._drives.recv(0)) is not None:
                line = f"t{answer.arbitration_id:03X}{len(answer.data)}{answer.data.hex().upper()}\r"
                os.write(self._line, line.encode())

    def _obey(self, command: bytes) -> None:
        if not command.startswith(b"t"):
            os.write(self._line, b"\r")
            return
        os.write(self._line, self._taken)
        self._drives.send(frame(int(command[1:4], 16), bytes.fromhex(command[5:].decode())))


@pytest.mark.long
@pytest.mark.parametrize("taken", [b"\r", b"z\r"])
def test_slcan_whose_adapter_acknowledges_every_frame(taken: bytes) -> None:
    """Set up, powered and led over 100 cycles: each hears the answers to its own SYNC, and no backlog grows."""
    with SerialLineAdapter(taken) as adapter:
        options: dict[str, bool | int | float | str] = {"tty_baudrate": 921_600, "sleep_after_open": 0, "timeout": 0}
        section = Can(interface="slcan", channel=adapter.channel, options=options)
        drives = opening.connect(section, DRIVES, slowly)
        try:
            drives.configure(0.01)
            cycle(drives)
            drives.enable()
            cycle_until(drives, lambda feedback: set(feedback.state) == {PowerState.OPERATION_ENABLED})
            for number in range(100):
                feedback = cycle(drives, number * 3e-6)
                assert (feedback.fault, feedback.age) == (None, (0, 0, 0)), number
            assert min(feedback.position) > 2e-4
        finally:
            drives.close()


def test_a_virtual_bus_ends_with_its_process() -> None:
    """python-can's "virtual" joins buses of one process, as drives and driver of one script."""
    section = Can(interface="virtual", channel="one-process", options={"preserve_timestamps": True})
    here, there = opening.open_bus(section, SIMULATED.drives), opening.open_bus(section, SIMULATED.drives)
    try:
        here.send(frame(0x080))
        heard = there.recv(1.0)
        assert heard is not None
        assert heard.arbitration_id == 0x080
    finally:
        here.shutdown()
        there.shutdown()
