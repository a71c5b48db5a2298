"""Options of `trirail align` that say where marks are from, and how they are looked at."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from trirail.cli import mark_source, notation
from trirail.errors import TrirailError


@Parameter(name="*")
@dataclass(frozen=True)
class MarkSource:
    """Where the marks are from, one of --program, --pictures and --camera, and how they are looked at."""

    program: str | None = None
    'A program that prints a line of JSON, {"mark": [u, v], …} in pixels, for each line that it reads.'
    pictures: Path | None = None
    "A folder with the newest picture for each mark, as left.png."
    camera: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    "MARK=DEVICE, a camera's number or address for OpenCV, as left=0; again for another mark."
    window: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    """MARK=U,V,WIDTH,HEIGHT, the part of its picture in which a mark is, in pixels, where one picture shows several;
    with --pictures as MARK=PICTURE:U,V,WIDTH,HEIGHT."""
    shape: Literal["cross", "disc", "corner"] = "cross"
    "What is looked for in pictures."
    size: float = 100.0
    "Its size in pixels: a disc's diameter, a cross's bars, a corner's sides."
    turn: float = 0.0
    "By what angle it is turned in the picture, from u to v, in degrees."
    looks: int = 1
    "Pictures of a measurement, or at each place."
    wait: float = 0.0
    "How long the cameras take to show what is [s]."
    speed: notation.Share = 1.0
    "Fraction of full speed, above 0 and up to 1."

    @contextlib.contextmanager
    def open_source(self) -> Iterator[mark_source.Source]:
        """Open it. Raises TrirailError."""
        from trirail.alignment.shapes import MarkShape

        given = [self.program is not None, self.pictures is not None, bool(self.camera)]
        if sum(given) != 1:
            raise TrirailError("marks are from one of --program, --pictures and --camera; give one of them")
        shape, turn = MarkShape(self.shape, self.size), math.radians(self.turn)
        if self.window and self.program is not None:
            raise TrirailError("--window is for pictures: a program tells where its marks are")
        windows = dict(map(_window, self.window))
        with contextlib.ExitStack() as stack:
            if self.program is not None:
                yield stack.enter_context(mark_source.program(self.program))
            elif self.pictures is not None:
                yield stack.enter_context(mark_source.folder(self.pictures, shape, turn, windows))
            else:
                devices = dict(map(_device, self.camera))
                yield stack.enter_context(mark_source.cameras(devices, shape, turn, windows))


def _device(text: str) -> tuple[str, str]:
    name, equals, device = text.partition("=")
    if not (name and equals and device):
        raise TrirailError(f"--camera {text}: MARK=DEVICE is wanted, as left=0")
    return name, device


def _window(text: str) -> tuple[str, mark_source.MarkWindow]:
    name, equals, rest = text.partition("=")
    picture, _, numbers = rest.rpartition(":")
    try:
        u, v, width, height = map(int, numbers.split(","))
        if not (name and equals and min(u, v) >= 0 and min(width, height) > 0):
            raise ValueError  # noqa: TRY301 - what is wrong with it is said below
    except ValueError:
        right = "MARK=U,V,WIDTH,HEIGHT is wanted, whole pixels from the corner above on the left, as left=0,0,640,960"
        raise TrirailError(f"--window {text}: {right}") from None
    return name, mark_source.MarkWindow(picture or name, u, v, width, height)
