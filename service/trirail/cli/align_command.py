"""`trirail align`: cameras calibrated by moves of the stage, a part laid right, and a look alone."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import App, Parameter

from trirail.cli import mark_source, terminal, units
from trirail.cli.options import HERE, Flag, Service
from trirail.errors import TrirailError

if TYPE_CHECKING:
    from trirail.alignment.calibration import CameraCalibration
    from trirail.alignment.procedure import Alignment, Measurement
    from trirail.client.calibration_file import CalibrationFile

app = App(name="align", help="Lay a part right by marks in cameras: calibrate once, then run for each part.")
FILE = Path("camera.json")
ARCSECONDS = 3600.0 * 180.0 / math.pi


@Parameter(name="*")
@dataclass(frozen=True)
class MarkSource:
    """Where the marks are from: one of --program, --pictures and --camera."""

    program: str | None = None
    'A program that prints a line of JSON, {"mark": [u, v], …} in pixels, for each line that it reads.'
    pictures: Path | None = None
    "A folder with the newest picture for each mark, as left.png."
    camera: Annotated[tuple[str, ...], Parameter(negative="")] = ()
    "MARK=DEVICE, a camera's number or address for OpenCV, as left=0; again for another mark."
    shape: Literal["cross", "disc", "corner"] = "cross"
    "What is looked for in pictures."
    size: float = 100.0
    "Its size in pixels: a disc's diameter, a cross's bars, a corner's sides."
    turn: float = 0.0
    "By what angle it is turned in the picture, from u to v, in degrees."

    @contextlib.contextmanager
    def opened(self) -> Iterator[mark_source.Look]:
        """Open it. Raises TrirailError."""
        from trirail.alignment.shapes import MarkShape

        given = [self.program is not None, self.pictures is not None, bool(self.camera)]
        if sum(given) != 1:
            raise TrirailError("marks are from one of --program, --pictures and --camera; give one of them")
        shape, turn = MarkShape(self.shape, self.size), math.radians(self.turn)
        with contextlib.ExitStack() as stack:
            if self.program is not None:
                yield stack.enter_context(mark_source.program(self.program))
            elif self.pictures is not None:
                yield stack.enter_context(mark_source.folder(self.pictures, shape, turn))
            else:
                yield stack.enter_context(mark_source.cameras(dict(map(_device, self.camera)), shape, turn))


def _device(text: str) -> tuple[str, str]:
    name, equals, device = text.partition("=")
    if not (name and equals and device):
        raise TrirailError(f"--camera {text}: MARK=DEVICE is wanted, as left=0")
    return name, device


PROGRAM = MarkSource()


@app.command
def calibrate(
    file: Path = FILE,
    /,
    *,
    by: units.Length = 1e-3,
    angle: units.Angle = "1deg",
    one_camera: Annotated[bool, Flag] = False,
    looks: int = 1,
    wait: float = 0.0,
    speed: units.Share = 1.0,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Find how the cameras show the table, by six moves of the stage, and keep it with the marks as they lie now.

    The robot is enabled, and its marks in the pictures, also after the moves. The file's targets are where the marks
    were seen at the beginning: lay a part right for it, or edit them.

    Parameters
    ----------
    file
        Where to keep it.
    by
        How far to move along x and y, each both ways.
    angle
        How far to turn, both ways.
    one_camera
        One camera sees all marks; else each mark has a camera, or a place of one, of its own.
    looks
        Pictures at each place.
    wait
        How long the cameras take to show what is [s].
    speed
        Fraction of full speed, above 0 and up to 1.
    """
    from trirail.alignment.procedure import MOVES
    from trirail.client import calibration_file
    from trirail.client.client import Robot

    turn = units.radians(angle, False)
    moves = [(x / 1e-3 * by, y / 1e-3 * by, math.copysign(turn, phi) if phi else 0.0) for x, y, phi in MOVES]
    with source.opened() as look, Robot(service.robot, service.connect, tls=service.tls) as robot:
        told = _telling(look, service, len(moves) + 1)
        views = dict.fromkeys(look(), "camera") if one_camera else None
        found = robot.calibrate_camera(told, moves, views=views, looks=looks, wait=wait, speed=speed)
        targets = dict(look())
    calibration_file.write(file, service.robot, found, targets)
    if service.json:
        terminal.json({"file": str(file), "targets": targets, "calibration": msgspec.to_builtins(found)})
    else:
        _print_calibration(found, file)
    return 0


@app.command
def run(
    file: Path = FILE,
    /,
    *,
    tolerance: units.Length = 1e-6,
    angle: units.Angle = "24urad",
    corrections: int = 3,
    distance_ppm: float = 1000.0,
    looks: int = 1,
    wait: float = 0.0,
    speed: units.Share = 1.0,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Move the part until its marks are at their targets; exit 1 where they are not within the tolerance.

    Parameters
    ----------
    file
        The calibration, from `trirail align calibrate`.
    tolerance
        How far a mark may be from its target.
    angle
        By what angle the part may be turned; 24 µrad are 5 arcsec.
    corrections
        How many may be made.
    distance_ppm
        By how much the marks' distance may differ from their targets'.
    looks
        Pictures a measurement.
    wait
        How long the cameras take to show what is [s].
    speed
        Fraction of full speed, above 0 and up to 1.
    """
    from trirail.client import calibration_file
    from trirail.client.client import Robot

    kept = _kept(file, service)
    with source.opened() as look, Robot(service.robot, service.connect, tls=service.tls) as robot:
        found = robot.align(
            _telling(look, service, None),
            kept.targets,
            kept.calibration,
            tolerance=tolerance,
            angle=units.radians(angle, False),
            corrections=corrections,
            distance=distance_ppm * 1e-6,
            looks=looks,
            wait=wait,
            speed=speed,
        )
    if found.confirmed != kept.calibration.confirmed:
        known = msgspec.structs.replace(kept.calibration, confirmed=found.confirmed)
        calibration_file.write(file, kept.robot, known, kept.targets, kept.made)
    if service.json:
        terminal.json({"reached": found.reached} | msgspec.to_builtins(found))
    else:
        _print_alignment(found)
    return 0 if found.reached else 1


@app.command
def check(
    file: Path = FILE,
    /,
    *,
    distance_ppm: float = 1000.0,
    looks: int = 1,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Look once, say how the part lies, and move nothing.

    Parameters
    ----------
    file
        The calibration, from `trirail align calibrate`.
    distance_ppm
        By how much the marks' distance may differ from their targets'.
    looks
        Pictures of the measurement.
    """
    from trirail.alignment.procedure import Task, look_only
    from trirail.client.alignment import drive
    from trirail.client.client import Robot

    kept = _kept(file, service)
    task = Task(kept.calibration, kept.targets, distance=distance_ppm * 1e-6, looks=looks)
    with source.opened() as look, Robot(service.robot, service.connect, tls=service.tls) as robot:
        found = drive(robot, look, look_only(task), 1.0, 0.0)
    if service.json:
        terminal.json(msgspec.to_builtins(found))
    else:
        terminal.say(_measured(found))
    return 0


def _kept(file: Path, service: Service) -> CalibrationFile:
    from trirail.client import calibration_file

    kept = calibration_file.read(file)
    if kept.robot != service.robot:
        raise TrirailError(f"{file} is of robot {kept.robot}, not of {service.robot}: calibrate this one")
    return kept


def _telling(look: mark_source.Look, service: Service, total: int | None) -> mark_source.Look:
    """Return the look that also tells a person which one it is."""
    taken = 0

    def told() -> dict[str, tuple[float, float]]:
        nonlocal taken
        taken += 1
        seen = dict(look())
        if not service.json:
            of = "" if total is None else f" of {total}"
            marks = ", ".join(f"{name} ({u:.2f}, {v:.2f})" for name, (u, v) in seen.items()) or "no marks"
            terminal.say(f"look {taken}{of}: {marks}")
        return seen

    return told


def _print_calibration(found: CameraCalibration, file: Path) -> None:
    for name, view in found.views.items():
        mirrored = ", mirrored" if view.mirrored else ""
        terminal.say(f"view {name}: {1e6 / view.scale:.3f} µm a pixel{mirrored}")
    for name, mark in found.marks.items():
        (x, y), (dx, dy) = mark.place, mark.deviation
        terminal.say(f"mark {name}: x {x * 1e3:.3f} ± {dx * 1e3:.3f} mm, y {y * 1e3:.3f} ± {dy * 1e3:.3f} mm")
    terminal.say(f"residual {found.noise:.3f} pixel; kept in {file}")


def _measured(found: Measurement) -> str:
    x, y = found.shift
    return (
        f"to go: x {x * 1e6:.2f} µm, y {y * 1e6:.2f} µm, φ {found.turn * ARCSECONDS:.2f} arcsec; "
        f"a mark {found.worst * 1e6:.2f} µm at most; distance {found.distance * 1e6:+.0f} ppm"
    )


def _print_alignment(found: Alignment) -> None:
    for measurement in found.measurements:
        terminal.say(_measured(measurement))
    reasons = {
        "reached": "the part lies right",
        "corrections": "no correction is left: raise --corrections or --tolerance, or look at backlash and noise",
        "growing": "the error grew: the calibration is not of these cameras as they stand; calibrate anew",
    }
    made = terminal.counted(len(found.corrections), "correction")
    terminal.say(f"{made} in {found.seconds:.2f} s: {reasons[found.why]}")
