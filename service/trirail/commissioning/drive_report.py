"""Text lines that describe an inspected drive: the drive's identity, and the values that the set-up changes."""

from __future__ import annotations

from typing import Any

from trirail import naming
from trirail.naming import Labels


def format_identity(drive: dict[str, Any], labels: Labels) -> list[str]:
    """Return lines with the identity, modes and units of a drive.

    `drive` is one of the entries that the `inspect` function of the drive's protocol returns.
    """
    lines = [f"{naming.drive(drive['name'], labels)}, node {drive['node']}"]
    if "device_type" in drive:
        numbers = ", ".join(f"{key} {drive[key]}" for key in ("vendor", "product", "revision", "serial"))
        lines += [
            f"  device type {drive['device_type']}h, {numbers}",
            f"  modes {drive['modes'] or 'not reported'}: {drive['way']}",
            f"  velocities in {drive['velocity_unit'] or '?'}, accelerations in {drive['acceleration_unit'] or '?'}",
        ]
    return lines


def format_differences(drive: dict[str, Any], *, applied: bool) -> list[str]:
    """Return lines with the values that the set-up changes, the objects that the drive lacks, and refusals.

    `drive` is an entry as in `format_identity`. `applied` is True if the set-up has written the values.
    """
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
