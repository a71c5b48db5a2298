"""Stamps the guides' pictures with what they were drawn from: python tools/picture_stamps.py, for make screenshots.

A stamp is a digest of the files that decide how a picture looks, in a text chunk of the PNG. A test compares: where
it differs, the picture is older than what it shows.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "tools/pictures"
KEYWORD = "drawn-from"
SOURCES: dict[str, tuple[str, ...]] = {
    "panel": ("service/trirail/panel/page/*", "tools/panel_picture.py"),
    "frames": ("tools/frames_picture.py", "service/trirail/workspace/part_positions.py"),
    "workspace": ("service/trirail/workspace/plots.py", "service/trirail/workspace/part_positions.py"),
    "demo": ("service/trirail/telemetry/blueprint.py", "service/trirail/telemetry/scene.py",
             "service/trirail/telemetry/curves.py", "service/trirail/telemetry/palette.py", "tools/screenshot.py"),
    "paper": ("tools/paper_figures.py", "tools/paper_motions.py"),
}  # fmt: skip
"""Of each picture: patterns of files, below the checkout."""


def digest(name: str) -> str:
    """Return that of the files from which a picture is drawn. Raises FileNotFoundError for a pattern without any."""
    found = hashlib.sha256()
    for file in _files(name):
        found.update(file.relative_to(ROOT).as_posix().encode() + b"\0")
        found.update(hashlib.sha256(file.read_bytes()).digest())
    return found.hexdigest()


def stamp(name: str) -> str | None:
    """Return the digest with which a picture was stamped; None where it was not."""
    with Image.open(PICTURES / f"{name}.png") as picture:
        said: str | None = picture.info.get(KEYWORD)
        return said


def main() -> int:
    """Stamp all, or those that are named; return the exit code."""
    for name in sys.argv[1:] or SOURCES:
        note = PngInfo()
        note.add_text(KEYWORD, digest(name))
        with Image.open(PICTURES / f"{name}.png") as picture:
            picture.save(PICTURES / f"{name}.png", pnginfo=note, optimize=True)
    return 0


def _files(name: str) -> Iterator[Path]:
    for pattern in SOURCES[name]:
        found = sorted(ROOT.glob(pattern))
        if not found:
            raise FileNotFoundError(f"{pattern}, of which {name}.png is drawn")
        yield from found


if __name__ == "__main__":
    sys.exit(main())
