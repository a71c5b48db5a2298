"""Shipped configurations for tests on a busy machine."""

from __future__ import annotations

import re
from pathlib import Path

from trirail.client import own_service
from trirail.config import SIM

TABLES = {"gateway_timeout": "watchdogs", "missed_positions": "drives"}
"""Tables of the keys that a shipped configuration may lack."""


def write(folder: Path, name: str, locator: str) -> Path:
    """Write a shipped configuration that listens at a locator and tolerates stalls of a second; return its file."""
    text = SIM.with_name(name).read_text(encoding="utf-8")
    for key, value in {"listen": f'["{locator}"]', **own_service.PATIENT}.items():
        text, count = re.subn(rf"^{key} = [^#\n]*", f"{key} = {value} ", text, flags=re.MULTILINE)
        if not count:
            text = text.replace(f"\n[{TABLES[key]}]", f"\n[{TABLES[key]}]\n{key} = {value}", 1)
            assert f"{key} = {value}" in text
    path = folder / name
    path.write_text(text.replace("[telemetry]", "[telemetry]\nlive_port = 0"), encoding="utf-8")
    return path
