"""Drives that others made, in a process of their own: python foreign_process.py CHANNEL MAKE NODE..."""

from __future__ import annotations

import sys
import time

from drivers.foreign import ForeignDrive, Truth
from trirail_drivers.bus.unixbus import UnixBus

COUNTS = 819_200.0
"""Counts per metre."""


def main(channel: str, make: str, *nodes: str) -> None:
    """Boot, and serve until killed."""
    truth = Truth(COUNTS, COUNTS, COUNTS)
    drives = [ForeignDrive(make, int(node), UnixBus(channel), time.monotonic, truth, 0.01) for node in nodes]
    for drive in drives:
        drive.boot()
    while True:
        for drive in drives:
            drive.pump(0.0005)


if __name__ == "__main__":
    main(*sys.argv[1:])
