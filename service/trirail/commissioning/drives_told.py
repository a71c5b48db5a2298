"""What a drive has told of itself, and what its set-up would change: lines for people."""

from __future__ import annotations

from typing import Any

from trirail import naming
from trirail.naming import Labels


def identity(drive: dict[str, Any], labels: Labels) -> list[str]:
    """Return who a drive says it is, its modes and units; `drive` is one of what a protocol's `inspect` returns."""
    lines = [f"{naming.drive(drive['name'], labels)}, node {drive['node']}"]
    if "device_type" in drive:
        who = ", ".join(f"{key} {drive[key]}" for key in ("vendor", "product", "revision", "serial"))
        lines += [
            f"  device type {drive['device_type']}h, {who}",
            f"  modes {drive['modes'] or 'not told'}: {drive['way']}",
            f"  velocities in {drive['velocity_unit'] or '?'}, accelerations in {drive['acceleration_unit'] or '?'}",
        ]
    return lines


def differences(drive: dict[str, Any], *, applied: bool) -> list[str]:
    """Return what its set-up has changed, or would, what it lacks, and why it is refused."""
    lines = []
    if "device_type" in drive:
        verb = "written" if applied else "would be written"
        lines += [
            f"  {verb}: {each['object']} {each['name']}: {each['found'] or '?'} -> {each['wanted']}, for {each['why']}"
            for each in drive["differences"]
        ] or ["  nothing differs"]
        lines += [f"  lacks {each}" for each in drive["lacking"]]
        lines += [f"  {note}" for note in drive["notes"]]
    if drive["refused"]:
        lines.append(f"  refused: {drive['refused']}")
    return lines
