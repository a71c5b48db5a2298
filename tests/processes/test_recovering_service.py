"""A whole service whose drives are off when it starts, and lose their supply while it runs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import bus_log
import msgspec
import pytest
from trirail import RefusedError, Robot
from trirail.client import own_service
from trirail.wire.vocabulary import Mode
from trirail_drivers.cia402 import canopen_frames as layout
from trirail_drivers.interface import NAMES
from trirail_drivers.odrive.flat_endpoints import KNOWN_TABLES, Endpoint, Version
from trirail_drivers.odrive.protections import ABSOLUTE_SETPOINTS
from trirail_drivers.simulated.odrive import FIRMWARE, HARDWARE
from waiting import wait_until

VIRTUAL_DRIVES = Path(__file__).parents[2] / "tools/virtual_drives.py"
TURNS = "counts_per_metre = 25.0"
"""Unit of an ODrive's position: turns of a screw with 40 mm lead."""
Tell = Callable[[str], None]


def endpoints() -> bytes:
    """A simulated ODrive's flat_endpoints.json, also with the setting that says if its position survives a restart."""
    table = next(each for each in KNOWN_TABLES if each.matches(Version(HARDWARE, FIRMWARE)))
    whole = table.endpoints | {ABSOLUTE_SETPOINTS: Endpoint(900, "bool")}
    return msgspec.json.encode(msgspec.structs.replace(table, endpoints=whole))


@pytest.fixture(params=["cia402", "odrive"])
def drives(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Path, str, Tell]]:
    """Simulated drives of a process of their own: the service's configuration, its locator, what takes fault lines."""
    config, locator = own_service.private(tmp_path)
    bus = tmp_path / "bus"
    text = config.read_text()
    text = text.replace('interface = "simulated" ', f'interface = "unix"\nchannel = "{bus}" ')
    text = text.replace("live_port = 0", "live_port = 0\ncapture_can = true")
    text = text.replace("sdo_timeout = 5.0", "sdo_timeout = 1.0")  # the start waits for each silent drive
    assert "capture_can" in text
    if request.param == "odrive":
        text = text.replace('protocol = "cia402"', 'protocol = "odrive"').replace("counts_per_metre = 1e7", TURNS)
        for name in NAMES:
            text = text.replace(f"[drives.{name}]", f'[drives.{name}]\nendpoints = "a.json"')
        (tmp_path / "a.json").write_bytes(endpoints())
    config.write_text(text)
    given = [str(config), "--interface", "unix", "--channel", str(bus)]
    with subprocess.Popen([sys.executable, str(VIRTUAL_DRIVES), *given], stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        told = process.stdin

        def tell(line: str) -> None:
            told.write(f"{line}\n".encode())
            told.flush()

        try:
            wait_until(bus.exists)
            yield config, locator, tell
        finally:
            process.terminate()


def move(robot: Robot, x: float) -> None:
    # Slowly: the drives are a process without real-time rights, which a busy machine delays by some cycles.
    result = robot.move_to(x=x, y=0.0, phi=0.0, speed=0.1).wait(timeout=30)
    assert result.outcome == "done", (result, robot.state().faults)


def reset_once_configured(robot: Robot) -> None:
    """Send reset until it is accepted."""

    def accepted() -> bool:
        try:
            robot.reset()
        except RefusedError:
            return False
        return True

    wait_until(accepted)


@pytest.mark.alone  # its drives are a process without real-time rights
def test_a_service_recovers_without_a_restart(drives: tuple[Path, str, Tell], tmp_path: Path) -> None:
    config, locator, tell = drives
    tell("all silent")
    with own_service.service(config, tmp_path / "session.rrd"), Robot(connect=locator) as robot:
        assert robot.state().mode == Mode.FAULT
        wait_until(lambda: "drive C does not answer" in robot.state().faults)
        with pytest.raises(RefusedError, match="drive A does not answer"):
            robot.reset()
        tell("clear")
        reset_once_configured(robot)
        robot.enable()
        move(robot, 0.005)
        tell("all reboot for 2")
        wait_until(lambda: robot.state().mode == Mode.FAULT)
        wait_until(lambda: len(robot.state().faults) == 4)
        reset_once_configured(robot)
        assert robot.state().faults == ()
        robot.enable()
        move(robot, 0.0)
        tell("B reboot for 1")
        wait_until(lambda: robot.state().mode == Mode.FAULT)
        reset_once_configured(robot)
    (captured,) = tmp_path.glob("*.log")
    log = bus_log.read(captured)
    requests = [frame for frame in log if frame.identifier & ~0x7F == layout.SDO_REQUEST]
    assert requests or "odrive" in config.read_text()
    assert list(bus_log.order_problems(log)) == []


@pytest.mark.long
@pytest.mark.parametrize("drives", ["cia402"], indirect=True)
def test_an_end_that_leaves_a_drive_with_power_is_a_failure(drives: tuple[Path, str, Tell], tmp_path: Path) -> None:
    config, locator, tell = drives
    config.write_text(config.read_text().replace("stop_timeout = 1.0", "stop_timeout = 4.0"))
    with (tmp_path / "log").open("w+b") as log:
        process = own_service.start(config, log, "--record", str(tmp_path / "session.rrd"))
        with Robot(connect=locator) as robot:
            robot.enable()
        tell("A drop rpdo1 rpdo2 rpdo3 sdo-request nmt")
        assert own_service.end(process) == 1
        log.seek(0)
        said = log.read().decode()
    assert "trirail: the service has ended, but drive A is operation enabled according to the last statusword: " in said
    assert "drive A: is operation enabled 4 s after disable" in said
    assert "killing it" not in said  # it would be while it still removes the power


@pytest.mark.long
def test_a_service_that_starts_without_its_bus_is_in_fault_and_says_why(tmp_path: Path) -> None:
    config, locator = own_service.private(tmp_path)
    text = config.read_text()
    config.write_text(text.replace('interface = "simulated" ', 'interface = "socketcan"\nchannel = "can7" '))
    with own_service.service(config, tmp_path / "session.rrd"), Robot(connect=locator) as robot:
        (fault,) = robot.state().faults
        assert fault.startswith("CAN bus can7 is down: ")
        with pytest.raises(RefusedError, match="can7"):
            robot.reset()
