"""`trirail align`: calibrate the cameras by moves of the stage, align a part, or only check its position."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import msgspec
from cyclopts import App

from trirail.cli import alignment_lines, notation, terminal
from trirail.cli.align_geometry import geometry
from trirail.cli.alignment_targets import observe_targets
from trirail.cli.mark_source import MarkSource
from trirail.cli.options import HERE, Flag, Service
from trirail.errors import TrirailError

if TYPE_CHECKING:
    from trirail.alignment.camera_calibration import CameraCalibration
    from trirail.alignment.procedure import AlignmentRequest, Observation
    from trirail.client.calibration_file import CalibrationFile

app = App(name="align", help="Lay a part right by marks in cameras, calibrated once.")
FILE = Path("camera.json")
T = TypeVar("T")
PROGRAM = MarkSource()
app.command(geometry)


@app.command
def calibrate(
    file: Path = FILE,
    /,
    *,
    by: notation.Length = 1e-3,
    angle: notation.Angle = "1deg",
    one_camera: Annotated[bool, Flag] = False,
    lens: Literal["affine", "perspective", "radial"] = "affine",
    centre: Annotated[tuple[float, float] | None, Flag] = None,
    approach: notation.PoseWay = notation.AT_REST,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Calibrate the cameras by six moves of the stage, and save the calibration with the marks' present positions.

    Enable the robot first. All marks must be in the pictures before and after each move. The targets in the file are
    the marks' positions after the last move, so align a part before you calibrate, or edit the targets.

    Parameters
    ----------
    file
        Calibration to write; an existing file is saved as FILE.old.
    by
        Distance of the moves along x and y, in both directions [m], or with a unit: 0.5mm.
    angle
        Angle of the rotations, in both directions [rad], or with a unit.
    one_camera
        One camera sees all marks of the program. Otherwise each mark has its own camera, or its own camera position.
    lens
        Model of the lens. The perspective and radial models need four more moves, into the corners.
    centre
        Pixel U V on the axis of a radial lens, which is the middle of the picture for most lenses.
    approach
        Distance X Y PHI [m, rad] to go beyond each place first, so that backlash is always on the same side.
    """
    from trirail.alignment.procedure import calibrate_by_moves, calibration_moves
    from trirail.client import calibration_file
    from trirail.client.alignment import drive
    from trirail.client.stage_geometry import geometry_id

    if lens == "radial" and centre is None:
        raise TrirailError(
            "--lens radial needs --centre U V, the pixel on the optical axis: usually the centre of the picture"
        )
    calibration_file.check_replaceable(file)
    moves = calibration_moves(lens, by, notation.radians(angle, False))
    with source.open_source() as (look, known), service.open() as robot:
        views, made_with = dict.fromkeys(look(), "camera") if one_camera else known, geometry_id(robot.info())
        requests = calibrate_by_moves(moves, views, lens, centre, source.looks, _approach(approach))
        calibration = drive(robot, look, _with_progress(requests, service, len(moves) + 1), source.speed, source.wait)
        targets, failures = observe_targets(robot, look, source, calibration)
    old, is_written = None, False
    try:
        old = calibration_file.keep_old(file)
        calibration_file.write(file, service.robot, calibration, targets, geometry=made_with)
        is_written = True
    except TrirailError as error:
        failures.append(error)
    if is_written and not service.json:
        alignment_lines.show_calibration(calibration, file)
        if old is not None:
            terminal.print_line(f"the previous file is now {old}")
    else:
        terminal.json(
            {
                "file": str(file) if is_written else None,
                "old": str(old) if old else None,
                "targets": targets,
                "calibration": msgspec.to_builtins(calibration),
                "errors": [str(each) for each in failures],
            }
        )
    for failure in failures:
        terminal.print_error(str(failure))
    return 1 if failures else 0


@app.command
def run(
    file: Path = FILE,
    /,
    *,
    tolerance: notation.Length = 1e-6,
    angle: notation.Angle = "24urad",
    corrections: int = 3,
    distance_ppm: float = 1000.0,
    approach: notation.PoseWay = notation.AT_REST,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Move the part until its marks are at their targets; exit 1 if they are not within the tolerance.

    Parameters
    ----------
    file
        Calibration, from `trirail align calibrate`.
    tolerance
        Maximum distance of a mark from its target [m], or with a unit: 2um.
    angle
        Maximum angle between the part and its target [rad], or with a unit; 24 µrad are 5 arcsec.
    corrections
        Maximum number of corrections.
    distance_ppm
        Maximum difference between the distance of the marks and the distance of their targets [ppm].
    approach
        Distance X Y PHI to go beyond each place first, as in the calibration.
    """
    from trirail.alignment.procedure import AlignmentTask, align
    from trirail.client import calibration_file
    from trirail.client.alignment import drive
    from trirail.client.stage_geometry import geometry_id

    kept = _load_calibration(file, service)
    with source.open_source() as (look, _), service.open() as robot:
        known = _checked_calibration(kept, file, now := geometry_id(robot.info()))
        task = AlignmentTask(
            known,
            kept.targets,
            tolerance,
            notation.radians(angle, False),
            corrections,
            distance_ppm * 1e-6,
            source.looks,
            _approach(approach),
        )
        result = drive(robot, look, _with_progress(align(task), service), source.speed, source.wait)
    if service.json:
        terminal.json({"reached": result.reached} | msgspec.to_builtins(result))
    else:
        alignment_lines.show_alignment(result)
    if result.confirmed != known.confirmed:
        known = msgspec.structs.replace(known, confirmed=result.confirmed)
        try:
            calibration_file.write(file, kept.robot, known, kept.targets, kept.made, now)
        except TrirailError as error:  # the result is already printed, and a program expects one object of JSON
            terminal.print_error(str(error))
            return 1
    return 0 if result.reached else 1


@app.command
def check(
    file: Path = FILE,
    /,
    *,
    distance_ppm: float = 1000.0,
    moves: Annotated[bool, Flag] = False,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Measure the part once without moving it; with --moves, check instead that no camera has moved.

    Exit 1 if a camera has been shifted or turned, or if it shows none of its marks.

    Parameters
    ----------
    file
        Calibration, from `trirail align calibrate`.
    distance_ppm
        Maximum difference between the distance of the marks and the distance of their targets [ppm].
    moves
        Move to the poses of the calibration and back, with any part, and compare the cameras with their state at that
        time.
    """
    from trirail.alignment.calibration_diff import compare_views, find_missing_views
    from trirail.alignment.procedure import AlignmentTask, measure_part, poses_within, repeat_calibration
    from trirail.client.alignment import drive
    from trirail.client.stage_geometry import geometry_id
    from trirail.config import room
    from trirail.telemetry.drawn_robot import DrawnRobot

    kept = _load_calibration(file, service)
    task = AlignmentTask(kept.calibration, kept.targets, distance=distance_ppm * 1e-6, looks=source.looks)
    with source.open_source() as (look, _), service.open() as robot:
        _checked_calibration(kept, file, geometry_id(robot.info()))
        if moves:
            stage = DrawnRobot.from_info(robot.info())
            poses = poses_within(room(stage.planned_limits), stage.geometry, kept.calibration)
            again = repeat_calibration(kept.calibration, source.looks, poses)
            progress = _with_progress(again, service, len(poses))
            now = drive(robot, look, progress, source.speed, source.wait)
            changes, missing = compare_views(kept.calibration, now), find_missing_views(kept.calibration, now)
        else:
            measurement = drive(robot, look, measure_part(task), source.speed, source.wait)
    if moves:
        if service.json:
            views = [msgspec.to_builtins(each) | {"changed": each.is_changed} for each in changes]
            terminal.json({"views": views, "missing": missing})
        else:
            alignment_lines.show_changes(changes, missing)
        return 1 if missing or any(each.is_changed for each in changes) else 0
    if service.json:
        terminal.json(msgspec.to_builtins(measurement))
    else:
        terminal.print_line(alignment_lines.format_measurement(measurement))
    return 0


def _approach(way: tuple[float, float, str]) -> tuple[float, float, float] | None:
    x, y, phi = way[0], way[1], notation.radians(way[2], False)
    return (x, y, phi) if any((x, y, phi)) else None


def _load_calibration(file: Path, service: Service) -> CalibrationFile:
    from trirail.client import calibration_file

    kept = calibration_file.read(file)
    if kept.robot != service.robot:
        raise TrirailError(f"{file} is for robot {kept.robot}, not for robot {service.robot}: calibrate this robot")
    return kept


def _checked_calibration(kept: CalibrationFile, file: Path, geometry: str) -> CameraCalibration:
    """Return the calibration; if it was made with another geometry, mark it unconfirmed and print a warning."""
    if kept.is_of_geometry(geometry):
        return kept.calibration
    terminal.print_error(
        f"{file} was made with another geometry of the stage: calibrate again, or let an alignment confirm the "
        "calibration; until then, a correction moves no mark farther than twice the moves of the calibration"
    )
    return msgspec.structs.replace(kept.calibration, confirmed=False)


def _with_progress(
    requests: Generator[AlignmentRequest, Observation, T], service: Service, looks: int | None = None
) -> Generator[AlignmentRequest, Observation, T]:
    """Return a generator of the same requests that also prints each look, unless the output is JSON."""
    return requests if service.json else alignment_lines.print_looks(requests, looks)
