"""The unit, as it is shipped, under a real systemd: up when it says so, started again, stopped in a controlled way.

That systemd is a user's, with a /run and a control group of its own: it manages nothing else of the machine.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from processes.test_ends import outcomes
from trirail import Robot
from trirail.client import own_service
from trirail.processes.operating_system import child
from trirail.telemetry.reading import read
from trirail.wire.vocabulary import MODES, Mode

UNIT = Path(__file__).parents[2] / "configs" / "trirail.service"
CAN_UNIT = UNIT.with_name("trirail-can@.service")
SYSTEM_USER = UNIT.with_name("trirail-user.conf")
UP_WITHIN = 60.0
BOOT = """\
mount --bind {folder}/ip $(command -v ip)
mount -t tmpfs tmpfs /run
mkdir -p /run/systemd/system /run/systemd/inaccessible/dir
touch /run/systemd/inaccessible/reg
mount -t cgroup2 cgroup2 /sys/fs/cgroup
own=/sys/fs/cgroup/trirail-unit.$$
mkdir $own
sh -ec "echo \\$\\$ >$own/cgroup.procs; exec unshare --cgroup --mount sh -ec '
    umount /sys/fs/cgroup
    mount -t cgroup2 cgroup2 /sys/fs/cgroup
    exec /lib/systemd/systemd --user --unit=basic.target'" || true
find $own -depth -type d -exec rmdir {} +
"""
"""What the system's own systemd would have made in /run, without which a user's does not begin; and a control group of
its own, all that it sees: it takes whatever stands in the root of those that it sees into groups of its own, where
nothing gets a real-time priority."""
HERE = """\
[Service]
ExecStart=
ExecStart={python} -P -m trirail run {config}
User=
WorkingDirectory={folder}
ReadWritePaths={folder} {checkout}
ProtectHome=false
Environment=NUMBA_CACHE_DIR=
"""
"""The paths, which who installs the unit sets; here the installation may be at home, and keeps what it has compiled.
And in a user's systemd nobody is another user."""


def _can() -> bool:
    programs = all(map(shutil.which, ("systemctl", "unshare"))) and Path("/lib/systemd/systemd").exists()
    return programs and subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not _can(), reason="needs root, for a /run of its own, and systemd: .ci/packages installs it"),
]


class Systemd:
    """A manager of one unit."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        units = folder / "units"
        (units / "trirail.service.d").mkdir(parents=True)
        shutil.copy(UNIT, units)
        self.config, self.locator = own_service.private(folder)
        here = HERE.format(python=sys.executable, config=self.config, folder=folder, checkout=UNIT.parents[1])
        (units / "trirail.service.d/here.conf").write_text(here)
        self._environment = os.environ | {
            "XDG_RUNTIME_DIR": str(folder),
            "SYSTEMD_UNIT_PATH": f"{units}:",
            "XDG_CONFIG_HOME": str(folder / "config"),
            "XDG_CACHE_HOME": str(folder / "cache"),
        }
        self.commands = folder / "commands"
        (folder / "ip").write_text(f'#!/bin/sh\necho "ip $*" >>{self.commands}\n')
        (folder / "ip").chmod(0o755)
        # A user's systemd knows no devices: the unit is started as when the interface is there.
        can_unit = CAN_UNIT.read_text(encoding="utf-8").splitlines(keepends=True)
        (units / CAN_UNIT.name).write_text("".join(line for line in can_unit if ".device" not in line))
        self._manager = subprocess.Popen(
            ["unshare", "--mount", "sh", "-ec", BOOT.replace("{folder}", str(folder))],
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def ctl(self, *words: str) -> str:
        """Call systemctl; return what it prints."""
        command = ["systemctl", "--user", "--no-pager", *words]
        done = subprocess.run(command, env=self._environment, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    def shows(self, **wanted: str) -> Callable[[], bool]:
        return lambda: all(f"{name}={value}" in self.shown().split() for name, value in wanted.items())

    def shown(self) -> str:
        return self.ctl("show", "trirail", "-p", "ActiveState,SubState,Result,NRestarts,MainPID")

    @property
    def main_pid(self) -> int:
        return int(self.ctl("show", "trirail", "-p", "MainPID", "--value"))

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + UP_WITHIN
        while not condition():
            assert time.monotonic() < deadline, self.ctl("status", "trirail")
            time.sleep(0.05)

    def end(self) -> None:
        self.ctl("exit")  # which ends what it has started
        self._manager.wait(UP_WITHIN)


@pytest.fixture
def systemd() -> Iterator[Systemd]:
    with tempfile.TemporaryDirectory(dir="/var/lib", prefix="u") as folder:  # /tmp is the unit's own
        groups = Path("/proc/self/cgroup").read_text()
        systemd = Systemd(Path(folder))
        try:
            systemd.until(systemd.shows(ActiveState="inactive"))
            yield systemd
        finally:
            systemd.end()
        assert Path("/proc/self/cgroup").read_text() == groups


def test_it_is_up_when_it_says_so_comes_back_disabled_and_stops_in_a_controlled_way(systemd: Systemd) -> None:
    systemd.ctl("start", "trirail")  # which waits until it is up
    assert systemd.shows(ActiveState="active", SubState="running")(), systemd.ctl("status", "trirail")
    with Robot("demo", systemd.locator) as robot:
        robot.enable()
        robot.move_to(x=0.01, y=0.0, phi=0.0).wait(timeout=10.0)
        systemd.ctl("kill", "--signal=KILL", "trirail")
    systemd.until(systemd.shows(ActiveState="active", NRestarts="1"))
    with Robot("demo", systemd.locator) as robot:
        assert robot.state().mode == "disabled"
        robot.enable()
        robot.move_to(x=0.02, y=0.0, phi=0.0)
        systemd.ctl("stop", "trirail")
    assert systemd.shows(ActiveState="inactive", Result="success")(), systemd.ctl("status", "trirail")


def score(pid: int) -> int:
    return int(Path(f"/proc/{pid}/oom_score_adj").read_text())


@pytest.mark.parametrize("harm", ["KILL", "STOP"])
def test_the_loop_stops_the_robot_when_the_supervisor_is_lost(systemd: Systemd, harm: str) -> None:
    """A stopped supervisor is lost when the watchdog says so; what it has started is not killed with it."""
    (systemd.folder / "units/trirail.service.d/watchdog.conf").write_text("[Service]\nWatchdogSec=3\n")
    systemd.ctl("daemon-reload")
    systemd.ctl("start", "trirail")
    with Robot("demo", systemd.locator) as robot:
        robot.enable()
        robot.move_to(x=0.15, y=0.0, phi=0.0, speed=0.03)
        loop, gateway, recorder = (child(systemd.main_pid, name) for name in ("loop", "gateway", "recorder"))
        systemd.until(
            lambda: score(recorder) == min(score(loop) + 500, 1000)
        )  # if memory runs out, the recorder ends first
        assert score(loop) == score(gateway)
        systemd.ctl("kill", "--kill-whom=main", f"--signal={harm}", "trirail")
    systemd.until(systemd.shows(ActiveState="active", NRestarts="1"))
    recorded = read(min(systemd.folder.rglob("*.rrd"), key=lambda file: file.stat().st_ctime_ns))
    records = recorded.records
    assert outcomes(recorded)[0][1] == "stopped"
    assert MODES[records["mode"][-1]] is Mode.DISABLED
    assert np.abs(records["commanded_velocity"][-1]).max() == 0.0


def test_the_can_interface_comes_up_with_bitrate_and_queue(systemd: Systemd) -> None:
    systemd.ctl("start", "trirail-can@can0")
    systemd.ctl("stop", "trirail-can@can0")
    assert systemd.commands.read_text().splitlines() == [
        "ip link set can0 txqueuelen 100",
        "ip link set can0 type can restart-ms 100",
        "ip link set can0 up type can bitrate 1000000",
        "ip link set can0 down",
    ]


def test_the_can_interface_comes_up_with_can_fd(systemd: Systemd) -> None:
    systemd.ctl("set-environment", "FD=dbitrate 5000000 fd on")
    systemd.ctl("start", "trirail-can@can0")
    assert "ip link set can0 up type can bitrate 1000000 dbitrate 5000000 fd on" in systemd.commands.read_text()


@pytest.mark.parametrize("unit", [UNIT, CAN_UNIT])
def test_systemd_finds_nothing_wrong_with_what_is_shipped(unit: Path, tmp_path: Path) -> None:
    text = unit.read_text(encoding="utf-8").replace("/opt/trirail/.venv/bin/trirail", sys.executable)
    file = tmp_path / unit.name.replace("@", "@can0")
    file.write_text(text, encoding="utf-8")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(file)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_service_has_a_user_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    subprocess.run(["systemd-sysusers", f"--root={tmp_path}", str(SYSTEM_USER)], capture_output=True, check=True)
    name, *_, home, shell = (tmp_path / "etc/passwd").read_text().splitlines()[-1].split(":")
    assert (name, home, shell) == ("trirail", "/var/lib/trirail", "/usr/sbin/nologin")
    assert f"User={name}\n" in UNIT.read_text(encoding="utf-8")
    assert f"WorkingDirectory={home}\n" in UNIT.read_text(encoding="utf-8")
