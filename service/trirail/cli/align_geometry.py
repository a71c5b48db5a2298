"""`trirail align geometry`: measure the stage's geometry with its cameras and propose a new configuration."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from cyclopts import Parameter
from trirail_drivers import files

from trirail.cli import alignment_lines, notation, terminal
from trirail.cli.alignment_targets import observe_targets
from trirail.cli.mark_source import MarkSource
from trirail.cli.options import HERE, Flag, Service
from trirail.errors import ConfigError, TrirailError

if TYPE_CHECKING:
    from trirail.alignment.camera_calibration import Marks
    from trirail.alignment.geometry_calibration import GeometryCalibration
    from trirail.client.client import Robot
    from trirail.config import Config
    from trirail.config.as_built import AsBuilt

PROGRAM = MarkSource()


class _Written(NamedTuple):
    """Files that were written; None for each file that was not requested."""

    config: Path | None = None
    cameras: Path | None = None
    old_cameras: Path | None = None
    map: Path | None = None


def geometry(
    config: Path,
    /,
    *,
    field: Annotated[tuple[int, int], Parameter(negative="")],
    out: Path | None = None,
    calibration: Path | None = None,
    poses: int = 30,
    one_camera: Annotated[bool, Flag] = False,
    lens: Literal["affine", "perspective", "radial"] = "radial",
    approach: notation.PoseWay = notation.AT_REST,
    yes: Annotated[bool, Flag] = False,
    source: MarkSource = PROGRAM,
    service: Service = HERE,
) -> int:
    """Measure the stage's rails, pivots, scales and cameras by moves over its whole travel, and propose the results.

    The robot must be enabled, and the marks of a part must be in the pictures. Nothing is written unless you answer
    yes. Corrections that do not clearly exceed their uncertainty are not written. CONFIG is never changed. The new
    configuration takes effect when you start the service with it.

    Parameters
    ----------
    config
        Configuration with which the service runs.
    field
        Size of the pictures, COLUMNS ROWS in pixels. Poses are planned so that the marks stay in the pictures.
    out
        Configuration to write. If absent, it gets an unused name beside CONFIG.
    calibration
        Camera calibration to write, for `trirail align run`; an existing file is saved as FILE.old. If absent, it is
        camera.json beside the new configuration.
    poses
        Number of looks to take, 12 or more.
    one_camera
        One camera sees all marks of the program. Otherwise each mark has its own camera.
    lens
        Model of the lens.
    approach
        Distance X Y PHI [m, rad] to go beyond each pose first, so that backlash is always on the same side.
    yes
        Write the files without asking.
    """
    from trirail.client import calibration_file
    from trirail.client.alignment import drive
    from trirail.client.stage_geometry import geometry_task
    from trirail.commissioning import config_edit
    from trirail.config import load

    settings = load(config)
    if out is not None:
        config_edit.check_new_file(out)
    calibration = calibration or (out or config).with_name("camera.json")
    calibration_file.check_replaceable(calibration)
    way = approach[0], approach[1], notation.radians(approach[2], False)
    with source.open_source() as (look, known), service.open() as robot:
        _check_same(settings, config, robot)
        views = dict.fromkeys(look(), "camera") if one_camera else known
        task = geometry_task(robot.info(), field, views, lens, poses, source.looks, way if any(way) else None)
        taught = sorted(name for name, pose in robot.poses().items() if pose.taught)
        from trirail.alignment.geometry_calibration import calibrate_geometry

        wishes = calibrate_geometry(task)
        shown = wishes if service.json else alignment_lines.print_looks(wishes, poses)
        result = drive(robot, look, shown, source.speed, source.wait)
        targets, failures = observe_targets(robot, look, source, result.cameras)
    if not service.json:
        alignment_lines.show_geometry(result, settings.geometry.labels)
    asks = not yes and not service.json
    usable = _usable_map(result, settings, quiet=service.json)
    written = _Written()
    if result.is_significant:
        question = "Write a new configuration with these values?"
    else:
        question = "Write the calibration of the cameras for the configured geometry?"
    # The cameras were fitted without the configured map, with which the service would continue.
    needless = not result.is_significant and usable is None and settings.correction.map is not None
    if not needless and (yes or (asks and _answers_yes(question))):
        if asks and usable is not None and not _answers_yes("Write the map too, as [correction] map?"):
            usable = None
        written, unwritten = _write(result, config, settings, out, calibration, targets, usable)
        failures += unwritten
    remarks = _remarks(settings, taught) if written.config is not None else []
    if service.json:
        files = {name: None if path is None else str(path) for name, path in written._asdict().items()}
        errors = [str(each) for each in failures]
        terminal.json(_content(result) | {"made_before": remarks, "written": files, "errors": errors})
    elif any(written):
        _report(written, config, remarks)
    else:
        terminal.print_line("nothing is written")
    if failures and not service.json:
        if written.config is None:
            terminal.json(_content(result))  # with all digits, so that the values can be entered by hand
        for failure in failures:
            terminal.print_error(str(failure))
    return 1 if failures else 0


def _check_same(settings: Config, path: Path, robot: Robot) -> None:
    """Raise ConfigError if the configuration file is not the one with which the service runs."""
    from trirail import config
    from trirail.client.stage_geometry import geometry_id
    from trirail.config.as_built import geometry_of

    if settings.robot.name != robot.name:
        raise ConfigError(
            f"{path} is for robot {settings.robot.name}, not for robot {robot.name}: select the robot with --robot"
        )
    if geometry_of(config.geometry(settings.geometry)) != geometry_id(robot.info()):
        raise ConfigError(
            f"{path}: [geometry] differs from that of the running service; give the file with which the service runs"
        )


def _usable_map(result: GeometryCalibration, settings: Config, *, quiet: bool) -> AsBuilt | None:
    """Return the map of the remaining errors if it helps and the limits allow it; print its effect unless `quiet`."""
    from trirail import config
    from trirail.config import as_built

    if result.map is None or not result.map.helps:
        return None
    before, after = result.map.before, result.map.after
    words = (
        f"A map of the remaining errors lowers them at held-out looks from {before[0] * 1e6:.2f} to "
        f"{after[0] * 1e6:.2f} µm, and from {before[1] * 1e6:.2f} to {after[1] * 1e6:.2f} µrad"
    )
    made = None
    try:
        made = as_built.measured_today(result.map.correction, result.geometry)
        config.check_as_built(made, result.geometry, settings.limits)
    except ConfigError as error:
        made, words = None, f"{words}, but it is refused: {error}"
    if not quiet:
        terminal.print_line(words)
    return made


def _answers_yes(question: str) -> bool:
    """Ask a question; read the answer from the terminal or from a script. The end of the input counts as no."""
    terminal.out.print(f"{terminal.plain(question)} \\[y/N] ", end="")
    try:
        return input().strip().lower() in ("y", "yes")
    except EOFError:
        terminal.print_line("")
        return False


def _write(
    result: GeometryCalibration,
    path: Path,
    settings: Config,
    out: Path | None,
    cameras: Path,
    targets: Marks,
    errors: AsBuilt | None,
) -> tuple[_Written, list[TrirailError]]:
    """Write the configuration, the calibration of the cameras, and the map.

    The configuration is written if it would differ. Return the files that were written, and the errors. A measurement
    takes long, so an error does not prevent the other files.
    """
    from trirail.client import calibration_file
    from trirail.commissioning import config_edit
    from trirail.config import as_built

    written, failures = _Written(), list[TrirailError]()
    try:
        old = calibration_file.keep_old(cameras)
        geometry_id = as_built.geometry_of(result.geometry)
        calibration_file.write(cameras, settings.robot.name, result.cameras, targets, geometry=geometry_id)
        written = written._replace(cameras=cameras, old_cameras=old)
    except TrirailError as error:
        failures.append(error)
    if not result.is_significant and errors is None:
        return written, failures
    new = out or config_edit.find_free_path(path, "calibrated")
    map_path = config_edit.find_free_path(new, "map") if errors is not None else None
    try:
        if map_path is not None and errors is not None:
            config_edit.write_new_file(map_path, as_built.format_map(errors))
            written = written._replace(map=map_path)
        text = files.text(path)
        if new.parent.resolve() != path.parent.resolve():
            text = config_edit.resolve_paths(text, path.parent)
        text = config_edit.edit_geometry(text, result.geometry, result.scales, map_path.name if map_path else None)
        if settings.can.interface == "simulated" and settings.can.simulated.built is None:
            text = config_edit.add_simulated_build(text, settings.drives)
        text, mistake = config_edit.mark_mistake(text, errors)
        config_edit.write_new_file(new, text)
        written = written._replace(config=new)
        if mistake is not None:
            failures.append(ConfigError(f"{new}: {mistake}; correct it before you start the service with this file"))
    except TrirailError as error:
        failures.append(error)
    return written, failures


def _remarks(settings: Config, taught: list[str]) -> list[str]:
    """Return remarks on data that was created with the old geometry."""
    remarks = []
    if taught:
        remarks.append(f"taught poses {', '.join(taught)}: flagged until each is taught again")
    if settings.correction.map is not None:
        remarks.append(f"correction.map {settings.correction.map}: left out; make it again")
    remarks.append("other camera calibrations: flagged until an alignment confirms them, or they are made again")
    return remarks


def _report(written: _Written, path: Path, remarks: list[str]) -> None:
    names = {"configuration": written.config, "cameras and targets": written.cameras, "map": written.map}
    for name, file in names.items():
        if file is not None:
            terminal.print_line(f"{name} written to {file}")
    if written.old_cameras is not None:
        terminal.print_line(f"previous file saved as {written.old_cameras}")
    if written.config is None:
        return
    terminal.print_line(f"{path} is unchanged. To use the new configuration: trirail run {written.config}")
    terminal.print_line("Made with the previous geometry:")
    for remark in remarks:
        terminal.print_line(f"  {remark}")


def _content(result: GeometryCalibration) -> dict[str, object]:
    """Return a calibration in a form for programs, in which an infinite deviation is null."""
    residual_map = None
    if result.map is not None:
        residual_map = {"before": result.map.before, "after": result.map.after, "helps": result.map.helps}
    return {
        "parameters": result.parameters,
        "deviations": {name: value if math.isfinite(value) else None for name, value in result.deviations.items()},
        "undetermined": result.undetermined,
        "change": result.change,
        "change_deviation": result.change_deviation,
        "significant": result.is_significant,
        "residual": result.residual._asdict(),
        "noise": result.noise,
        "picture_noise": result.picture_noise,
        "outliers": [each._asdict() for each in result.outliers],
        "looks": len(result.looks),
        "map": residual_map,
    }
