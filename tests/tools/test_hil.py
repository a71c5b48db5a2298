"""What tools/hil.py needs of a machine, and the configuration it makes; the run itself is `make hil`."""

from __future__ import annotations

from pathlib import Path

import hil
import hil_machine
import hil_needs
import pytest
from hil_needs import Failed


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


def test_the_time_limit_says_what_was_heard_last() -> None:
    import queue

    lines: queue.Queue[str | None] = queue.Queue()
    lines.put("the machine is up")
    heard = hil_machine.heard(lines, 0.0)
    assert next(heard) == "the machine is up"
    with pytest.raises(Failed, match="the machine is up"):
        next(heard)
