"""What tools/hil.py needs of a machine, and the configuration it makes; the run itself is `make hil`."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import can
import hil
import hil_foreign
import hil_machine
import hil_needs
import hil_second
import pytest
from edsfiles import MAKES
from hil_needs import Failed
from trirail.config import load
from trirail_drivers.cia402 import setup
from trirail_drivers.config import Drive, Drives
from trirail_drivers.connection.opening import simulated_bus
from trirail_drivers.driver.scaling import scale_of
from trirail_drivers.errors import DriveError


def test_the_newest_kernel_with_the_cards_driver_is_taken(tmp_path: Path) -> None:
    boot, modules = tmp_path / "boot", tmp_path / "modules"
    boot.mkdir()
    for release, has_driver in {"6.1.0-9-amd64": True, "6.1.0-56-amd64": True, "6.1.0-99-cloud": False}.items():
        (boot / f"vmlinuz-{release}").touch()
        driver = modules / release / f"{hil_needs.CARD}.xz"
        driver.parent.mkdir(parents=True)
        if has_driver:
            driver.touch()
    assert [kernel.name for kernel in hil_needs.kernels(boot, modules)] == [
        "vmlinuz-6.1.0-9-amd64",
        "vmlinuz-6.1.0-56-amd64",
    ]


def test_what_is_missing_is_named_in_one_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil_needs, "SEARCH", "/nowhere")
    monkeypatch.setattr(hil_needs, "kernels", list)
    with pytest.raises(Failed) as failed:
        hil_needs.requirements()
    for package in (*hil_needs.PROGRAMS.values(), "linux-image"):
        assert package in str(failed.value)
    assert "\n" not in str(failed.value)


def test_the_machines_configuration_is_that_of_real_drives_but_slower(tmp_path: Path) -> None:
    config = hil.configure(tmp_path)
    assert (config.can.interface, config.can.channel) == ("socketcan", "can0")
    assert config.loop.rate_hz == 20
    assert config.telemetry.capture_can
    assert config.limits.slider.following_error < config.drives.following_error


def test_the_second_robot_has_another_rate_a_drive_to_home_and_one_that_others_made(tmp_path: Path) -> None:
    first = hil.configure(tmp_path)
    second = load(tmp_path / "second.toml")
    assert (second.can.interface, second.can.channel) == ("socketcan", "vcan0")
    assert second.loop.rate_hz != first.loop.rate_hz
    assert second.zenoh.listen != first.zenoh.listen
    assert second.telemetry.directory != first.telemetry.directory
    assert [drive.homing is not None for drive in second.drives.each] == [True, False, False]
    assert second.drives.C.revolutions_per_metre == hil_second.REVOLUTIONS
    assert second.limits.slider.following_error < second.drives.following_error
    assert hil_second.MAKE in MAKES
    with simulated_bus(second.can, second.drives) as bus:
        bus.faults.load(tmp_path / "second.faults")


def test_the_foreign_drive_says_its_units_and_what_it_lacks() -> None:
    """On a bus of this process: the driver's own thread is this one, the drive's another."""
    counts, turns = hil_second.COUNTS, hil_second.REVOLUTIONS
    a, b, c = (Drive(node=node, counts_per_metre=counts, revolutions_per_metre=turns) for node in (1, 2, 3))
    drives = Drives("cia402", a, b, c, sdo_timeout=0.2)  # A and B, which are not there, are waited for
    ends = [can.Bus("hil", interface="virtual") for _ in range(2)]
    said: list[str] = []
    over = threading.Event()
    node = drives.C.node
    thread = threading.Thread(
        target=hil_foreign.serve, args=(ends[1], node, said.append, lambda: not over.is_set()), daemon=True
    )
    thread.start()
    try:
        scales = scale_of("A", a), scale_of("B", b), scale_of("C", c)
        *_, looked = setup.look(ends[0], drives, scales, 0.1, time.monotonic)
        assert not isinstance(looked, DriveError), looked
        assert looked.lacking == ("1006",)
        assert looked.units.velocity_name == "rev/min"
    finally:
        over.set()
        thread.join()
        for end in ends:
            end.shutdown()
    assert said == ["C switch on disabled, 0.000 mm"]


def test_the_time_limit_says_what_was_heard_last() -> None:
    import queue

    lines: queue.Queue[str | None] = queue.Queue()
    lines.put("the machine is up")
    heard = hil_machine.heard(lines, 0.0)
    assert next(heard) == "the machine is up"
    with pytest.raises(Failed, match="the machine is up"):
        next(heard)
