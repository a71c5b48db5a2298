"""What `canopen` leaves out of an EDS, or a DCF, and a simulated drive needs."""

from __future__ import annotations

import configparser
from pathlib import Path

from trirail_drivers.cia402 import eds


def compact_arrays(file: Path) -> dict[int, int]:
    """How many sub-objects arrays have whose elements the file does not list one by one (CiA 306, CompactSubObj)."""
    sections = configparser.RawConfigParser(inline_comment_prefixes=(";",), strict=False)
    with eds.open_text(file) as text:
        sections.read_file(text)
    return {
        int(section, 16): int(sections.get(section, "CompactSubObj"), 0)
        for section in sections.sections()
        if sections.has_option(section, "CompactSubObj")
    }
