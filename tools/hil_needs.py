"""What the emulated machine needs of this one: programs, a kernel with CAN; how to install them."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

BIN = Path(sys.executable).parent
SEARCH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
CARD = "kernel/drivers/net/can/sja1000/kvaser_pci.ko"
"""The driver of the emulated cards, by which a kernel is known to be one that will do."""

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "modprobe": "kmod", "udevadm": "udev"}
PROGRAMS |= {"ip": "iproute2", "candump": "can-utils", "chrt": "util-linux", "mksquashfs": "squashfs-tools"}
PROGRAMS |= {"tshark": "tshark"}
"""Each program that is needed, and the package of Debian and Ubuntu that has it."""
KERNELS = {"debian": "linux-image-amd64", "ubuntu": "linux-image-generic"}
"""The package of a kernel with CAN and its drivers."""


class Failed(Exception):
    """What is missing or wrong, with the remedy or the log that tells more."""


def lacking() -> tuple[str, ...]:
    """The Debian packages that are missing on this machine."""
    packages = [package for program, package in PROGRAMS.items() if shutil.which(program, path=SEARCH) is None]
    if not kernels():
        packages.append(KERNELS.get(_distribution(), KERNELS["debian"]))
    return tuple(packages)


def kernels(boot: Path = Path("/boot"), modules: Path = Path("/lib/modules")) -> list[Path]:
    """Installed kernels that have the cards' driver and can be read, the newest last."""
    found = (
        image
        for image in boot.glob("vmlinuz-*")
        if os.access(image, os.R_OK) and any((modules / image.name.removeprefix("vmlinuz-")).glob(f"{CARD}*"))
    )
    return sorted(found, key=lambda image: [int(number) for number in re.findall(r"\d+", image.name)])


def requirements() -> Path:
    """The kernel to boot. Raises Failed with what to install."""
    if packages := lacking():
        raise Failed(f"missing here: apt-get install {' '.join(packages)} (Debian, Ubuntu); or, as root: make hil")
    if not (BIN / "vng").exists():
        raise Failed(f"missing here: {BIN}/python -m pip install --group hil (virtme-ng, which boots the kernel)")
    return kernels()[-1]


def install(say: Callable[[str], None]) -> None:
    """Install missing packages, as root where there is apt; else they are named by `requirements`."""
    packages = lacking()
    if not packages or os.geteuid() != 0 or shutil.which("apt-get") is None:
        return
    say(f"installing {' '.join(packages)}")
    for command in (("update",), ("install", "--yes", "--no-install-recommends", *packages)):
        done = subprocess.run(
            ("apt-get", "-q", *command),
            env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode != 0:
            raise Failed(f"apt-get {command[0]} failed:\n{last(done.stdout + done.stderr)}")


def _distribution() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/etc/os-release").read_text().splitlines():
            if line.startswith("ID="):
                return line.removeprefix("ID=").strip('"')
    return ""


def last(text: str, lines: int = 30) -> str:
    """Return the end of a text."""
    return "\n".join(text.splitlines()[-lines:])
