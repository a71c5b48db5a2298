"""Requirements of the emulated machine on the host: programs and a kernel with CAN, and their installation."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from hil_programs import Failed

BIN = Path(sys.executable).parent
SEARCH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
MODULES = (
    "drivers/net/can/sja1000/kvaser_pci",
    "net/can/can-raw",
    "drivers/net/can/vcan",
    "drivers/block/virtio_blk",
    "fs/squashfs/squashfs",
)
"""Kernel modules that the machine loads: drivers of the emulated cards, of CAN, and of its disk."""
DRIVERS = (*MODULES, "net/9p/9pnet_virtio", "fs/9p/9p")
"""Drivers that a kernel must have. The last two give the machine access to the host's folders."""
BUSYBOXES = ("busybox-static", "busybox.static", "busybox")
"""Names of busybox programs. One of them must be linked statically, because the machine boots without libraries."""
PT_INTERP = 3
"""Type of the segment of an ELF file that names its dynamic linker (elf(5))."""

PROGRAMS = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static", "modprobe": "kmod", "udevadm": "udev"}
PROGRAMS |= {"ip": "iproute2", "candump": "can-utils", "chrt": "util-linux", "mksquashfs": "squashfs-tools"}
PROGRAMS |= {"tshark": "tshark"}
"""Required programs, and the package of Debian and Ubuntu that contains each program."""
KERNELS = {"debian": "linux-image-amd64", "ubuntu": "linux-image-generic"}
"""For each distribution, the package of a kernel with CAN and its drivers."""


def lacking() -> tuple[str, ...]:
    """Return the packages that are missing on this host."""
    there = {program: shutil.which(program, path=SEARCH) for program in PROGRAMS} | {"busybox": busybox()}
    packages = [package for program, package in PROGRAMS.items() if there[program] is None]
    if not kernels():
        packages.append(KERNELS.get(_distribution(), KERNELS["debian"]))
    return tuple(packages)


def busybox() -> str | None:
    """Return the path of a statically linked busybox, or None. The busybox of initramfs-tools needs libraries."""
    paths = (shutil.which(name, path=folder) for name in BUSYBOXES for folder in SEARCH.split(":"))
    return next((path for path in paths if path is not None and is_static(Path(path))), None)


def is_static(file: Path) -> bool:
    """Return whether a file is an ELF program without a dynamic linker."""
    try:
        with file.open("rb") as opened:
            head = opened.read(64)
            if len(head) < 52 or head[:4] != b"\x7fELF" or head[4] not in (1, 2) or head[5] not in (1, 2):
                return False
            order, wide = "<>"[head[5] - 1], head[4] == 2
            (table,) = struct.unpack_from(f"{order}{'Q' if wide else 'I'}", head, 32 if wide else 28)
            size, number = struct.unpack_from(f"{order}HH", head, 54 if wide else 42)
            opened.seek(table)
            segments = opened.read(size * number)
            return bool(segments) and all(
                struct.unpack_from(f"{order}I", segments, size * n)[0] != PT_INTERP for n in range(number)
            )
    except (OSError, OverflowError, struct.error):
        return False


def has_drivers(modules: Path) -> bool:
    """Return whether a kernel has all DRIVERS, as modules in its folder or built in."""
    try:
        built_in = (modules / "modules.builtin").read_text().split()
    except OSError:
        built_in = []
    return all(f"kernel/{driver}.ko" in built_in or any(modules.glob(f"kernel/{driver}.ko*")) for driver in DRIVERS)


def kernels(boot: Path = Path("/boot"), modules: Path = Path("/lib/modules")) -> list[Path]:
    """Return the installed, readable kernels that have all DRIVERS, the newest last."""
    images = (
        image
        for image in boot.glob("vmlinuz-*")
        if os.access(image, os.R_OK) and has_drivers(modules / image.name.removeprefix("vmlinuz-"))
    )
    return sorted(images, key=lambda image: [int(number) for number in re.findall(r"\d+", image.name)])


def requirements() -> Path:
    """Return the kernel to boot. Raises Failed, which names the packages to install, if something is missing."""
    if packages := lacking():
        raise Failed(f"missing here: apt-get install {' '.join(packages)} (Debian, Ubuntu); or, as root: make hil")
    if not (BIN / "vng").exists():
        raise Failed(f"missing here: {BIN}/python -m pip install --group hil (virtme-ng, which boots the kernel)")
    return kernels()[-1]


def install(say: Callable[[str], None]) -> None:
    """Install missing packages if this runs as root and apt is available; otherwise `requirements` names them."""
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
    """Return the last lines of a text."""
    return "\n".join(text.splitlines()[-lines:])
