"""Where `trirail align` has its marks from: a program's lines, a folder of pictures, or a camera by OpenCV."""

from __future__ import annotations

import contextlib
import importlib
import shlex
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import msgspec
from trirail_drivers.errors import TrirailError

from trirail.wire.decoding import decoded, prepare

if TYPE_CHECKING:
    from trirail.alignment.calibration import Marks
    from trirail.alignment.shapes import MarkShape

Look = Callable[[], "Marks"]
LINE = dict[str, tuple[float, float]]
prepare(LINE)
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
NEWER_WITHIN, POLL = 30.0, 0.02
"""How long newer pictures are waited for, and how often it is looked [s]."""
ENDS_WITHIN = 5.0
"""How long a program may take to end when it is told to [s]."""
INSTALL = "pip install 'trirail[vision]'"


@contextlib.contextmanager
def program(command: str) -> Iterator[Look]:
    """Run a program that prints a line of JSON, {"mark": [u, v], …} [pixel], for each line that it reads.

    Raises TrirailError where it cannot be run, ends, or prints something else.
    """
    try:
        process = subprocess.Popen(shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        stdin, stdout = cast(IO[str], process.stdin), cast(IO[str], process.stdout)
    except (OSError, ValueError) as error:
        raise TrirailError(f"cannot run {command!r}: {error}; it is to print one line of JSON for each look") from error

    def look() -> Marks:
        with contextlib.suppress(BrokenPipeError):  # it has ended, and may have said something before
            stdin.write("look\n")
            stdin.flush()
        line = stdout.readline()
        if not line:
            code = process.wait(ENDS_WITHIN)
            raise TrirailError(f"{command!r} has ended with exit code {code}: it is to print a line for each it reads")
        try:
            marks: Marks = decoded(line, LINE)
        except (msgspec.MsgspecError, ValueError) as error:
            wanted = 'wanted is {"mark": [u, v], …} in pixels'
            raise TrirailError(f"{command!r} printed {line.strip()[:80]!r}: {error}; {wanted}") from error
        return marks

    try:
        yield look
    finally:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(ENDS_WITHIN)
        process.kill()
        process.wait()
        for pipe in (stdin, stdout):
            with contextlib.suppress(OSError):  # what was still in it goes nowhere
                pipe.close()


@contextlib.contextmanager
def folder(path: Path, shape: MarkShape, turn: float) -> Iterator[Look]:
    """Find a mark in each of the newest pictures of a folder: of each mark the picture named after it, as left.png.

    What takes the pictures replaces them: each look but the first waits until all are newer than at the one before.
    Raises TrirailError, also where none comes within NEWER_WITHIN seconds.
    """
    cv2 = _opencv()
    if not path.is_dir():
        raise TrirailError(f"{path}: no folder; one is wanted with a picture for each mark, as left.png")

    seen: dict[Path, int] = {}

    def look() -> Marks:
        deadline = time.monotonic() + NEWER_WITHIN
        while seen and any(each.exists() and each.stat().st_mtime_ns <= at for each, at in seen.items()):
            if time.monotonic() > deadline:
                raise TrirailError(f"{path}: no newer pictures within {NEWER_WITHIN:g} s: does what takes them run?")
            time.sleep(POLL)
        pictures = sorted(each for each in path.iterdir() if each.suffix.lower() in PICTURES)
        if not pictures:
            raise TrirailError(f"{path}: no picture in it; wanted is one for each mark, as left.png")
        marks: dict[str, tuple[float, float]] = {}
        for each in pictures:
            grey = cv2.imread(str(each), cv2.IMREAD_GRAYSCALE)
            if grey is None:
                raise TrirailError(f"{each}: no picture that OpenCV reads; is it written while it is read?")
            seen[each] = each.stat().st_mtime_ns
            marks.update(_marks(each.stem, grey, shape, turn))
        return marks

    yield look


@contextlib.contextmanager
def cameras(devices: dict[str, str], shape: MarkShape, turn: float) -> Iterator[Look]:
    """Open cameras through OpenCV, {mark: device}, a number or an address, and find a mark in a picture of each.

    Raises TrirailError.
    """
    cv2 = _opencv()
    with contextlib.ExitStack() as opened:
        captures = {}
        for name, device in devices.items():
            capture = cv2.VideoCapture(int(device) if device.isdigit() else device)
            opened.callback(capture.release)
            if not capture.isOpened():
                raise TrirailError(f"cannot open camera {device} of {name}: is it plugged in, and may you read it?")
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            captures[name] = capture

        def look() -> Marks:
            marks: dict[str, tuple[float, float]] = {}
            for name, capture in captures.items():
                capture.grab()  # the one that was waiting is older than this look
                read, frame = capture.read()
                if not read:
                    raise TrirailError(f"camera {devices[name]} of {name} gives no picture any more")
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                marks.update(_marks(name, grey, shape, turn))
            return marks

        yield look


def _marks(name: str, grey: Any, shape: MarkShape, turn: float) -> dict[str, tuple[float, float]]:
    from trirail.alignment.finding import find

    found = find(grey, shape, turn)
    return {} if found is None else {name: (found.u, found.v)}


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise TrirailError(f"pictures are read by OpenCV, which is not installed: {INSTALL}") from error
