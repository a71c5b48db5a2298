"""The driver on a bus between processes and on the kernel's virtual one, with the simulated drives behind it.

Frames go both ways that they can: by python-can, and on the bus's own socket.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import carriers
import pytest
from carriers import NAME, ip, on_vcan
from drivers.real_time import cycle, cycle_until
from rigs import alike
from trirail_drivers.bus import wire as wires
from trirail_drivers.bus.frame_io import SocketFrames, frame_io
from trirail_drivers.bus.frames import Frame, is_fd
from trirail_drivers.bus.unixbus import UnixBus
from trirail_drivers.cia402.drives import Cia402
from trirail_drivers.config import Can, Drives, Simulated
from trirail_drivers.connection import opening
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.connection.serving import serve
from trirail_drivers.errors import BusError
from trirail_drivers.interface import PowerState
from waiting import wait_until

SIMULATED = Simulated(missed_syncs=1000)
VCAN = Can(interface="socketcan", channel=NAME, simulated=SIMULATED)
DRIVES = Drives("cia402", *alike(), heartbeat=2.0, sdo_timeout=10.0)
"""A machine that is emulated, or busy, is no drive that is lost."""
PERIOD = 0.02
SERVED = "served"
"""Drives by trirail_drivers.connection.serving, which have one master."""
WITHIN = 60.0
"""How long a slow machine may take for anything [s]."""

# python-can leaves its socket to the garbage collector where there is no such interface.
pytestmark = pytest.mark.filterwarnings(
    r"ignore:Exception ignored in. <socket\.socket.*family=29:pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture
def interface() -> Iterator[str]:
    """A virtual bus that is up."""
    with carriers.vcan() as name:
        yield name


@pytest.fixture(params=["unix", SERVED, pytest.param("vcan", marks=carriers.NEEDS_VCAN)])
def section(request: pytest.FixtureRequest) -> Can:
    """A bus that is there."""
    if request.param == "vcan":
        request.getfixturevalue("interface")
        return VCAN
    folder = request.getfixturevalue("tmp_path")
    return Can(interface="unix", channel=str(folder / request.param), simulated=SIMULATED)


@pytest.fixture
def drives(section: Can) -> Iterator[None]:
    """The simulated drives on it."""
    if section.channel.endswith(SERVED):
        yield from served(Path(section.channel), section)
        return
    over, running = socket.socketpair()
    simulated = simulated_bus(section, DRIVES)
    wire = UnixBus(section.channel, listen=True) if section.interface == "unix" else opening.open_bus(section, DRIVES)

    def serve() -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(wire, selectors.EVENT_READ)
            selector.register(running, selectors.EVENT_READ)
            while not any(key.fileobj is running for key, _ in selector.select(PERIOD / 5)):
                with contextlib.suppress(can.CanError):  # the interface may be down
                    while (frame := wire.recv(0)) is not None:
                        simulated.send(frame)
                while (answer := simulated.recv(0.0)) is not None:
                    with contextlib.suppress(can.CanError):
                        wire.send(answer)

    thread = threading.Thread(target=serve)
    thread.start()
    yield
    over.send(b"!")
    thread.join()
    for part in (wire, simulated, over, running):
        part.shutdown() if isinstance(part, can.BusABC) else part.close()


def served(path: Path, section: Can) -> Iterator[None]:
    """The simulated drives as the service has them: they end when the driver has gone."""
    thread = threading.Thread(target=serve, args=(path, section, DRIVES, lambda: None, lambda: None))
    thread.start()
    wait_until(path.exists)
    yield
    thread.join(WITHIN)
    assert not thread.is_alive()


@pytest.fixture(params=carriers.WAYS)
def driver(
    section: Can, drives: None, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Cia402]:
    """The driver, whose frames go by python-can, and on the bus's own socket."""
    monkeypatch.setattr(wires, "frame_io", carriers.WAYS[request.param])
    connected = opening.connect(section, DRIVES)
    assert isinstance(connected, Cia402)
    yield connected
    connected.close()


@on_vcan
def test_frames_pass_between_two_sockets(interface: str) -> None:
    with opening.open_bus(VCAN, DRIVES) as one, opening.open_bus(VCAN, DRIVES) as other:
        one.send(Frame(0x123, b"\x01\x02").message())
        arrived = other.recv(WITHIN)
        assert arrived is not None
        assert (arrived.arbitration_id, bytes(arrived.data)) == (0x123, b"\x01\x02")
        assert one.recv(0) is None, "a socket hears what it sent itself"


@on_vcan
def test_an_interface_that_is_not_there_is_named_with_its_remedy() -> None:
    with pytest.raises(BusError, match=f"ip link add {NAME} type vcan"):
        opening.open_bus(VCAN, DRIVES)


@on_vcan
def test_an_interface_that_is_down_is_named_with_its_remedy(interface: str) -> None:
    ip("link", "set", NAME, "down")
    with pytest.raises(BusError, match="is down"):
        opening.open_bus(VCAN, DRIVES)


def test_drives_are_set_up_powered_moved_and_left_without_power(driver: Cia402) -> None:
    driver.configure(PERIOD)
    cycle(driver)
    driver.enable()
    cycle_until(driver, lambda feedback: set(feedback.state) == {PowerState.OPERATION_ENABLED})
    cycle_until(driver, lambda feedback: min(feedback.position) > 0.9e-4, position=1e-4)
    driver.disable()
    cycle_until(driver, lambda feedback: set(feedback.state) == {PowerState.SWITCH_ON_DISABLED}, position=1e-4)


@pytest.mark.parametrize("section", [pytest.param("vcan", marks=carriers.NEEDS_VCAN)], indirect=True)
def test_an_interface_that_goes_down_is_a_fault_of_the_bus(driver: Cia402) -> None:
    driver.configure(PERIOD)
    cycle(driver)
    driver.enable()
    cycle_until(driver, lambda feedback: set(feedback.state) == {PowerState.OPERATION_ENABLED})
    ip("link", "set", NAME, "down")
    cycle(driver, heard=False)
    fault = driver.read().fault
    assert fault is not None
    assert fault.cause == "bus"
    assert "CAN bus" in fault.message


@on_vcan
def test_frames_of_can_fd_pass_between_two_sockets_of_the_kernel() -> None:
    section = Can("socketcan", channel=NAME, fd=True)
    with carriers.vcan(), opening.open_bus(section, DRIVES) as one, opening.open_bus(section, DRIVES) as other:
        assert is_fd(one)
        frames = frame_io(other)
        assert isinstance(frames, SocketFrames)
        frames.set_identifiers({0x123})
        one.send(Frame(0x123, b"\1\2").message())
        assert frames.receive(60.0) == (0x123, bytearray(b"\1\2"))
        frames.send(Frame(0x124, b"\3"))
        arrived = one.recv(60.0)
        assert arrived is not None
        assert (arrived.is_fd, arrived.bitrate_switch, bytes(arrived.data)) == (True, True, b"\3")


@on_vcan
def test_an_interface_of_the_kernel_without_can_fd_is_refused() -> None:
    section = Can("socketcan", channel=NAME, fd=True)
    with carriers.vcan():
        ip("link", "set", NAME, "down")
        ip("link", "set", NAME, "mtu", "16", "up")
        with pytest.raises(BusError, match=r"for classical CAN only \(MTU 16\)"):
            opening.open_bus(section, DRIVES)
