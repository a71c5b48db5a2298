"""Sources of marks for `trirail align`, and their options: a program, a folder of pictures, or cameras via OpenCV."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import select
import shlex
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar, cast

import msgspec
from cyclopts import Parameter
from trirail_drivers.errors import TrirailError

from trirail.alignment.code_family import CodeFamily
from trirail.cli import notation
from trirail.wire.decoding import decoded, prepare

if TYPE_CHECKING:
    from trirail.alignment.camera_calibration import Marks
    from trirail.alignment.shapes import MarkShape

T = TypeVar("T")
Look = Callable[[], "Marks"]
LINE = dict[str, tuple[float, float]]
prepare(LINE)
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
PICTURE_TIMEOUT_S, WRITE_TIMEOUT_S, POLL_S = 30.0, 1.0, 0.02
"""Maximum wait for a line or a newer picture, maximum time to write a picture, and polling interval [s]."""
EXIT_TIMEOUT_S = 5.0
"""Maximum time that a program and its children may take to exit after SIGTERM [s]."""
PIPE_BYTES = 65536
"""Maximum size of one read from a program [bytes]."""
INSTALL = "pip install 'trirail[vision]'"
BUFFERED_S, MAX_BUFFERED = 0.002, 16
"""Reading time below which a picture counts as buffered by the driver [s], and maximum number of buffered pictures."""


class MarkWindow(NamedTuple):
    """Part of a picture in which to search for a mark [pixel]; the whole picture if the width is 0."""

    picture: str
    u: int = 0
    v: int = 0
    width: int = 0
    height: int = 0


NO_WINDOWS: Mapping[str, MarkWindow] = {}


class Source(NamedTuple):
    """Function that returns the marks, and the view of each mark: marks of one fixed camera share a view."""

    look: Look
    views: Mapping[str, str] | None = None
    """Name of the view of each mark; None if unknown, or if each mark has its own camera."""


@contextlib.contextmanager
def program(command: str) -> Iterator[Source]:
    """Run a program that prints a line of JSON, {"mark": [u, v], …} [pixel], for each line that it reads.

    Raises TrirailError if the program cannot be run, exits, prints anything else, also if it was not asked, or prints
    nothing within PICTURE_TIMEOUT_S.
    """
    try:
        # The program gets its own process group: Ctrl-C goes to trirail, which ends the program.
        process = subprocess.Popen(shlex.split(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0)
        stdin, stdout = cast(IO[bytes], process.stdin), cast(IO[bytes], process.stdout)
    except (OSError, ValueError) as error:
        raise TrirailError(
            f"cannot run {command!r}: {error}; the program must print one line of JSON for each look"
        ) from error

    def find_marks() -> Marks:
        if select.select([stdout], [], [], 0.0)[0] and (early := os.read(stdout.fileno(), PIPE_BYTES)):
            raise TrirailError(  # each later look would get the answer to the look before, from before the motion
                f"{command!r} printed {_excerpt(early)!r} without being asked; expected one line for each line that it "
                "reads"
            )
        with contextlib.suppress(BrokenPipeError):  # it has exited; its last line may still be in the pipe
            stdin.write(b"look\n")
            stdin.flush()
        deadline, line = time.monotonic() + PICTURE_TIMEOUT_S, b""
        while not line.endswith(b"\n"):
            if not select.select([stdout], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TrirailError(
                    f"{command!r} has printed no line in {PICTURE_TIMEOUT_S:g} s; check that it flushes its output"
                )
            if not (part := os.read(stdout.fileno(), PIPE_BYTES)):
                break
            line += part
        if not line:
            code = process.wait(EXIT_TIMEOUT_S)
            raise TrirailError(
                f"{command!r} has ended with exit code {code}: it must print one line for each line that it reads"
            )
        try:
            marks: Marks = decoded(line, LINE)
        except (msgspec.MsgspecError, ValueError) as error:
            wanted = 'expected {"mark": [u, v], …} in pixels'
            raise TrirailError(f"{command!r} printed {_excerpt(line)!r}: {error}; {wanted}") from error
        return marks

    try:
        yield Source(find_marks)
    finally:
        _end_group(process)
        for pipe in (stdin, stdout):
            with contextlib.suppress(OSError):  # unsent data is of no use any more
                pipe.close()


def _excerpt(printed: bytes) -> str:
    return printed.decode(errors="replace").strip()[:80]


def _end_group(process: subprocess.Popen[bytes]) -> None:
    """End a process and its children, which could keep a camera open."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # no process is left, or it belongs to another user
        os.killpg(process.pid, signal.SIGTERM)
        deadline = time.monotonic() + EXIT_TIMEOUT_S
        while time.monotonic() < deadline:
            process.poll()
            os.killpg(process.pid, 0)
            time.sleep(POLL_S)
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextlib.contextmanager
def folder(
    path: Path,
    shape: MarkShape,
    turn: float,
    windows: Mapping[str, MarkWindow] = NO_WINDOWS,
    family: CodeFamily | None = None,
) -> Iterator[Source]:
    """Find marks in the newest pictures of a folder, such as the mark left in left.png.

    With `windows`, each mark is searched for in its window instead. With a `family`, the codes in all pictures are
    found and named by their numbers. Another program overwrites the pictures. Each look except the first waits until
    all pictures have been written again, because older ones may show the robot in motion. Raises TrirailError if a look
    fails or if this wait exceeds PICTURE_TIMEOUT_S.
    """
    cv2 = _opencv()
    if not path.is_dir():
        raise TrirailError(f"{path}: not a folder; expected a folder with a picture of each mark, such as left.png")

    used: set[Path] = set()

    def find_marks() -> Marks:
        deadline = time.monotonic() + PICTURE_TIMEOUT_S
        asked = {each: _written(each) for each in used}
        while any(_written(each) in (0, at) for each, at in asked.items()):
            if time.monotonic() > deadline:
                raise TrirailError(
                    f"{path}: no newer pictures within {PICTURE_TIMEOUT_S:g} s; check that the program that takes them "
                    "runs"
                )
            time.sleep(POLL_S)
        pictures = {each.stem: each for each in sorted(path.glob("[!.]*")) if each.suffix.lower() in PICTURES}
        if not pictures:
            raise TrirailError(
                f"{path}: the folder has no picture; expected one picture of each mark, such as left.png"
            )
        wanted = windows or {name: MarkWindow(name) for name in pictures}
        marks: dict[str, tuple[float, float]] = {}
        codes = None if family is None else Codes(family)
        for name, window in wanted.items():
            if (file := pictures.get(window.picture)) is None:
                raise TrirailError(
                    f"{path}: no picture {window.picture} for mark {name}; there are {', '.join(pictures)}"
                )
            whole_by = time.monotonic() + WRITE_TIMEOUT_S
            while (grey := cv2.imread(str(file), cv2.IMREAD_ANYDEPTH)) is None:
                if time.monotonic() > whole_by:
                    raise TrirailError(
                        f"{file}: OpenCV cannot read this picture; write it as .{file.name}, then rename it"
                    )
                time.sleep(POLL_S)
            used.add(file)
            if codes is not None:
                codes.add(name, grey)
            else:
                marks.update(_marks(name, grey, window, shape, turn))
        if codes is not None:
            views.update(codes.views)
            return codes.marks
        return marks

    views = {name: window.picture for name, window in windows.items()}
    yield Source(find_marks, views if views or family is not None else None)


class Codes:
    """Positions of the codes that are found in all pictures taken for one look.

    The name of each code is its number. A code must not appear in two pictures.
    """

    def __init__(self, family: CodeFamily) -> None:
        self._family = family
        self.marks: dict[str, tuple[float, float]] = {}
        self.views: dict[str, str] = {}

    def add(self, picture: str, grey: Any) -> None:
        """Find the codes in a picture. Raises TrirailError if a code is also in an earlier picture."""
        from trirail.alignment.coded_marks import find_codes

        for code in find_codes(grey, self._family):
            name = str(code.number)
            if name in self.marks:
                both = f"{self.views[name]} and {picture}"
                raise TrirailError(f"code {name} is in the pictures {both}: give each mark its own number")
            self.marks[name], self.views[name] = (code.mark.u, code.mark.v), picture


@contextlib.contextmanager
def cameras(
    devices: dict[str, str],
    shape: MarkShape,
    turn: float,
    windows: Mapping[str, MarkWindow] = NO_WINDOWS,
    family: CodeFamily | None = None,
) -> Iterator[Source]:
    """Open cameras through OpenCV and find a mark in a picture of each.

    `devices` maps each mark to a device, given by its number or address. With a `family`, any number of codes is found
    in each picture, and the codes are named by their numbers. Marks of the same device are found in one picture, each
    in its window. Raises TrirailError if a camera or a mark fails.
    """
    cv2 = _opencv()
    shown = Counter(devices.values())
    for name, device in devices.items():
        if shown[device] > 1 and name not in windows:
            raise TrirailError(f"camera {device} shows several marks: give each a --window, such as {name}=0,0,640,960")
    if unknown := ", ".join(set(windows) - set(devices)):
        raise TrirailError(f"--window of {unknown}: no --camera shows that mark")
    with contextlib.ExitStack() as opened:
        captures = {}
        for device in dict.fromkeys(devices.values()):
            capture = cv2.VideoCapture(int(device) if device.isdigit() else device)
            opened.callback(capture.release)
            if not capture.isOpened():
                names = ", ".join(name for name in devices if devices[name] == device)
                raise TrirailError(
                    f"cannot open camera {device} of {names}; check that it is plugged in, and that you may read it"
                )
            captures[device] = capture

        def find_marks() -> Marks:
            marks: dict[str, tuple[float, float]] = {}
            codes = None if family is None else Codes(family)
            for device, capture in captures.items():
                frame = newest(capture, cv2.CAP_PROP_FRAME_COUNT)
                if frame is None:
                    raise TrirailError(f"camera {device} no longer delivers pictures")
                grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                for name, its in devices.items():
                    if its == device and codes is not None:
                        codes.add(name, grey)
                    elif its == device:
                        marks.update(_marks(name, grey, windows.get(name, MarkWindow(name)), shape, turn))
            if codes is not None:
                views.update(codes.views)
                return codes.marks
            return marks

        views = {name: f"camera {device}" for name, device in devices.items()} if windows else {}
        yield Source(find_marks, views if windows or family is not None else None)


def newest(capture: Any, frame_count: int, clock: Callable[[], float] = time.monotonic) -> Any:
    """Return a picture whose exposure started after the call, or None if there is none.

    From a film, the function returns the picture after the next one.
    A camera's driver buffers unread pictures and returns them without delay. The exposure of the first picture that is
    not from the buffer may have started before the call.
    """
    film = capture.get(frame_count) > 0
    for _ in range(0 if film else MAX_BUFFERED):
        asked = clock()
        if not capture.grab() or clock() - asked > BUFFERED_S:
            break
    if film:
        capture.grab()
    read, frame = capture.read()
    return frame if read else None


def _written(file: Path) -> int:
    """Return the time of the last write to a file [ns]; 0 if it does not exist.

    A later write may have an earlier time, if the clock was set or the time is that of another machine.
    """
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return 0


def _marks(name: str, grey: Any, window: MarkWindow, shape: MarkShape, turn: float) -> dict[str, tuple[float, float]]:
    from trirail.alignment.finding import find

    rows, columns = grey.shape
    if window.width and (window.u + window.width > columns or window.v + window.height > rows):
        raise TrirailError(f"the window of {name} extends beyond its picture of {columns} × {rows} pixels")
    bottom, right = (window.v + window.height, window.u + window.width) if window.width else (rows, columns)
    mark = find(grey[window.v : bottom, window.u : right], shape, turn)
    return {} if mark is None else {name: (mark.u + window.u, mark.v + window.v)}


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise TrirailError(f"reading pictures needs OpenCV, which is not installed: {INSTALL}") from error


@Parameter(name="*")
@dataclass(frozen=True)
class MarkSource:
    """Options for the source of mark positions (--program, --pictures or --camera) and for the detection of marks."""

    program: str | None = None
    'A program that prints a line of JSON, {"mark": [u, v], …} in pixels, for each line that it reads.'
    pictures: Path | None = None
    "A folder with the newest picture for each mark, such as left.png."
    camera: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    "MARK=DEVICE, a camera's number or address for OpenCV, such as left=0; may be repeated for other marks."
    window: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = ()
    """MARK=U,V,WIDTH,HEIGHT, the part of the picture that contains the mark, in pixels, if one picture shows several
    marks; with --pictures, MARK=PICTURE:U,V,WIDTH,HEIGHT."""
    shape: Literal["cross", "disc", "corner", "code"] = "cross"
    "Shape of the marks in pictures; codes are named by their numbers, regardless of their position."
    family: CodeFamily = "4x4_50"
    "Family of the codes, ArUco or AprilTag."
    size: float = 100.0
    "Size of a mark in pixels: the diameter of a disc, the bars of a cross, or the sides of a corner."
    turn: float = 0.0
    "Rotation of a mark in the picture, from u to v, in degrees."
    looks: int = 1
    "Number of pictures per measurement, or at each place."
    wait: float = 0.0
    "Latency of the cameras [s]."
    speed: notation.Share = 1.0
    "Fraction of full speed, above 0 and up to 1."

    @contextlib.contextmanager
    def open_source(self) -> Iterator[Source]:
        """Open the source of the marks. Raises TrirailError."""
        from trirail.alignment.shapes import MarkShape

        selected = [self.program is not None, self.pictures is not None, bool(self.camera)]
        if sum(selected) != 1:
            raise TrirailError("marks have one source: give exactly one of --program, --pictures and --camera")
        if not 0.0 < self.size < math.inf:
            raise TrirailError(f"--size {self.size:g}: expected a number of pixels above 0")
        if not math.isfinite(self.turn):
            raise TrirailError(f"--turn {self.turn:g}: expected a finite number of degrees")
        shape, turn = MarkShape(self.shape, self.size), math.radians(self.turn)
        family = self.family if self.shape == "code" else None
        if family is not None and self.window:
            raise TrirailError("--window cannot be used with codes, which are identified by their numbers")
        if self.window and self.program is not None:
            raise TrirailError("--window is only for pictures: a program reports the positions of its marks itself")
        windows = _by_name("--window", map(_window, self.window))
        with contextlib.ExitStack() as stack:
            if self.program is not None:
                yield stack.enter_context(program(self.program))
            elif self.pictures is not None:
                yield stack.enter_context(folder(self.pictures, shape, turn, windows, family))
            else:
                devices = _by_name("--camera", map(_device, self.camera))
                yield stack.enter_context(cameras(devices, shape, turn, windows, family))


def _by_name(option: str, pairs: Iterable[tuple[str, T]]) -> dict[str, T]:
    named: dict[str, T] = {}
    for name, value in pairs:
        if name in named:
            raise TrirailError(f"{option}: mark {name} is given twice; give each mark its own name")
        named[name] = value
    return named


def _device(text: str) -> tuple[str, str]:
    name, equals, device = text.partition("=")
    if not (name and equals and device):
        raise TrirailError(f"--camera {text}: expected MARK=DEVICE, such as left=0")
    return name, device


def _window(text: str) -> tuple[str, MarkWindow]:
    name, equals, rest = text.partition("=")
    picture, _, numbers = rest.rpartition(":")
    try:
        u, v, width, height = map(int, numbers.split(","))
        if not (name and equals and min(u, v) >= 0 and min(width, height) > 0):
            raise ValueError  # noqa: TRY301 - the message is made below
    except ValueError:
        right = "expected MARK=U,V,WIDTH,HEIGHT in whole pixels from the upper left corner, such as left=0,0,640,960"
        raise TrirailError(f"--window {text}: {right}") from None
    return name, MarkWindow(picture or name, u, v, width, height)
