"""Stamp the guides' pictures with a digest of their sources: python tools/picture_stamps.py, for make screenshots.

A stamp is a digest of the files that determine a picture, and is stored in a text chunk of the PNG. A test compares
each stamp with the present digest. If they differ, the picture may be older than its subject.
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
"""Sources of each picture: patterns of files, relative to the checkout."""


def digest(name: str) -> str:
    """Return the digest of a picture's source files. Raises FileNotFoundError for a pattern without files."""
    result = hashlib.sha256()
    for file in _files(name):
        result.update(file.relative_to(ROOT).as_posix().encode() + b"\0")
        result.update(hashlib.sha256(file.read_bytes()).digest())
    return result.hexdigest()


def stamp(name: str) -> str | None:
    """Return the digest that is stamped into a picture; None if the picture has no stamp."""
    with Image.open(PICTURES / f"{name}.png") as picture:
        keyword: str | None = picture.info.get(KEYWORD)
        return keyword


def main() -> int:
    """Stamp all pictures, or the named ones; return the exit code."""
    for name in sys.argv[1:] or SOURCES:
        note = PngInfo()
        note.add_text(KEYWORD, digest(name))
        with Image.open(PICTURES / f"{name}.png") as picture:
            picture.save(PICTURES / f"{name}.png", pnginfo=note, optimize=True)
    return 0


def _files(name: str) -> Iterator[Path]:
    for pattern in SOURCES[name]:
        files = sorted(ROOT.glob(pattern))
        if not files:
            raise FileNotFoundError(f"{pattern}, of which {name}.png is drawn")
        yield from files


if __name__ == "__main__":
    sys.exit(main())
