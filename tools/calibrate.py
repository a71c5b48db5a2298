"""Identification of a robot's geometry as built from measured poses. The result is a [geometry] section.

python tools/calibrate.py poses.csv --config robot.toml --output geometry.toml
python tools/calibrate.py poses.csv --config robot.toml --map --output as_built.toml

With --map, the geometry stays as it is, and a map of the robot's deviations from it is written, for [correction].
The file with the poses has the columns x, y, phi, A, B, C: poses of the platform that an external instrument has
measured, and the slider positions at these poses, in metres and radians. The mathematics are described in
kinematics.calibration. The report is written to standard error. Needs trirail[analysis].
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from trirail import config
from trirail.config import as_built
from trirail.errors import ConfigError, TrirailError
from trirail.kinematics import correction_fit
from trirail.kinematics.arrays import Array
from trirail.kinematics.calibration import Calibration, CalibrationError, identify
from trirail.kinematics.geometry import LEGS, Geometry, singular_angles
from trirail.wire.units import ANGLE, LENGTH, quantity
from trirail_drivers import files

COLUMNS = ("x", "y", "phi", *LEGS)
COORDINATES = (("x", "µm", 1e6), ("y", "µm", 1e6), ("phi", "mrad", 1e3))
HELD = """\
No pose tells where an anchor lies along its rail, which home makes up for, nor where the travel of a cross slide is
counted from: both stay as in the starting geometry."""


def read(path: Path, *, degrees: bool = False) -> tuple[Array, Array, list[int]]:
    """Read a file; return its poses, (N, 3) [m, m, rad], slider positions, (N, 3) [m], and line numbers.

    Raises FileError, or CalibrationError with the line of the error.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    try:
        with io.StringIO(files.text(path), newline="") as file:
            reader = csv.reader(file)
            names = [name.strip() for name in next(reader, [])]
            if sorted(names) != sorted(COLUMNS):
                raise CalibrationError(f"line 1: the columns are {', '.join(names)}; expected {', '.join(COLUMNS)}")
            for fields in reader:
                if fields:
                    rows.append(_numbers(names, fields, reader.line_num, "deg" if degrees else "rad"))
                    lines.append(reader.line_num)
    except csv.Error as error:
        raise CalibrationError(f"not a CSV file: {error}") from error
    data = np.array(rows).reshape(-1, len(COLUMNS))
    return data[:, :3], data[:, 3:], lines


def _numbers(names: Sequence[str], fields: Sequence[str], line: int, bare: str) -> list[float]:
    """Return the fields of a row in SI units, in the order of COLUMNS; an angle without a unit is in `bare`."""
    if len(fields) != len(names):
        raise CalibrationError(f"line {line}: {len(fields)} fields; expected {len(names)}")
    texts = dict(zip(names, fields, strict=True))
    values = []
    for name in COLUMNS:
        try:
            values.append(quantity(texts[name], ANGLE, bare) if name == "phi" else quantity(texts[name], LENGTH))
        except ValueError as error:
            raise CalibrationError(f"line {line}: {name}: {error}") from error
    return values


def section(geometry: Geometry) -> str:
    """Return a geometry as the [geometry] section of a configuration, with all digits."""
    labels = ", ".join(f'"{label}"' for label in geometry.labels)
    lines = ["[geometry]", f'kind = "{geometry.kind}"', f"labels = [{labels}]"]
    for name, leg in zip(geometry.labels, geometry.each, strict=True):
        lines += ["", f"[[geometry.leg]]  # {name}"]
        for key, value in leg.keys().items():
            lines.append(f"{key} = {np.asarray(value).tolist()}")
    return "\n".join(lines) + "\n"


def describe(result: Calibration, lines: Sequence[int]) -> str:
    """Return the report on a calibration as text."""
    text = [f"{len(lines)} poses; the residuals are {result.misfit:.2f} times the stated noise", ""]
    text.append(f"{'residual':<36}{'rms':>10}{'greatest':>12}")
    for (name, unit, scale), column in zip(COORDINATES, np.abs(result.residuals.T), strict=True):
        rms, worst = math.sqrt(np.mean(column**2)), int(np.argmax(column))
        text.append(f"{f'{name} [{unit}]':<36}{rms * scale:>10.3f}{column[worst] * scale:>12.3f}  line {lines[worst]}")

    text += ["", f"{'correction':<36}{'change':>10}{'std. error':>12}"]
    for leg, changes, errors in zip(result.geometry.labels, result.corrections, result.standard_errors, strict=True):
        for name, change, error in zip(result.geometry.parameters, changes, errors, strict=True):
            unit = "mrad" if name.endswith("angle") else "mm"
            known = f"{error * 1e3:.4f}" if math.isfinite(error) else "open"
            text.append(f"{f'{leg} {name} [{unit}]':<36}{change * 1e3:>10.4f}{known:>12}")

    if result.misfit > 1.0:
        text.append(f"The standard errors follow from {result.misfit:.2f} times the stated noise, as the residuals do.")

    text += ["", HELD]
    for leg, names, combinations in result.open:
        label = result.geometry.labels[LEGS.index(leg)]
        if len(names) == 1:
            text.append(f"{label}: these poses do not determine {names[0]}: it stays as in the starting geometry.")
            continue
        what = "one combination of them stays" if combinations == 1 else f"{combinations} combinations of them stay"
        text.append(f"{label}: these poses cannot separate {', '.join(names)}: {what} as in the starting geometry.")
    if result.open:
        text.append("Poses that differ more, in phi above all, would.")

    angles = singular_angles(result.geometry)
    low, high = max(phi for phi in angles if phi < 0.0), min(phi for phi in angles if phi > 0.0)
    text += ["", f"With G at (0, 0) singular at phi = {low:.4f} and {high:.4f} rad: see limits.platform.phi."]
    return "\n".join(text)


def calibrate(options: argparse.Namespace) -> None:
    """Read the poses, identify the geometry or the map, report, and write the result. Raises TrirailError."""
    start = config.geometry(config.load(options.config).geometry)
    try:
        poses, sliders, lines = read(options.poses, degrees=options.deg)
    except CalibrationError as error:
        raise CalibrationError(f"{options.poses}: {error}") from error
    if options.map:
        write(map_text(options, start, poses, sliders), options.output)
        return
    try:
        result = identify(start, poses, sliders, position_noise=options.position_noise, angle_noise=options.angle_noise)
    except CalibrationError as error:
        if error.row is None:
            raise
        raise CalibrationError(f"{options.poses}: line {lines[error.row]}: {error}") from error
    print(describe(result, lines), file=sys.stderr)
    write(section(result.geometry), options.output)


def map_text(options: argparse.Namespace, robot: Geometry, poses: Array, sliders: Array) -> str:
    """Fit the map, print the report, and return the content of the map's file.

    Raises CalibrationError if the map cannot be fitted, or if the service would refuse it.
    """
    limits = config.load(options.config).limits
    try:
        fit = correction_fit.fit(robot, poses, sliders, config.room(limits), options.cells)
        made = as_built.measured_today(fit.correction, robot)
        text = as_built.format_map(made)
        config.check_as_built(as_built.parse(text), robot, limits)
    except (CalibrationError, ConfigError) as error:
        raise CalibrationError(f"{options.poses}: {error}") from error
    print(describe_map(fit), file=sys.stderr)
    return text


def describe_map(fit: correction_fit.Fit) -> str:
    """Return the report on a map as text."""
    cells = math.prod(fit.correction.cells)
    measured = f"{len(fit.before)} measurements of " if fit.distinct < len(fit.before) else ""
    text = [
        f"{measured}{fit.distinct} poses; {fit.empty} of {cells} cells have none, and get their values from neighbours"
    ]
    text += ["", f"{'pose error: rms, greatest':<28}{'measured':>18}{'left':>18}{'left if not measured':>24}"]
    for k, (name, unit, scale) in enumerate(COORDINATES):
        columns = [np.abs(each[:, k]) * scale for each in (fit.before, fit.residuals, fit.predicted)]
        errors = [f"{math.sqrt(np.mean(each**2)):.2f}, {each.max():.2f}" for each in columns]
        text.append(f"{f'{name} [{unit}]':<28}{errors[0]:>18}{errors[1]:>18}{errors[2]:>24}")
    return "\n".join(text)


def write(text: str, output: Path | None) -> None:
    """Write a text to a file or, without a file, to standard output. Raises CalibrationError."""
    if output is None:
        print(text, end="")
        return
    try:
        files.create(output, text.encode())
    except FileExistsError:
        raise CalibrationError(f"{output} already exists: choose another file") from None
    except OSError as error:
        raise CalibrationError(f"cannot write {output}: {error.strerror}") from error


def length(text: str) -> float:
    """Parse a length from the command line [m]. Raises ValueError."""
    return quantity(text, LENGTH)


def angle(text: str) -> float:
    """Parse an angle from the command line [rad]. Raises ValueError."""
    return quantity(text, ANGLE)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(description="Identifies the geometry of a robot as built from measured poses.")
    columns = f"CSV file with the columns {', '.join(COLUMNS)} [m, rad], or with units: 12.5um, 3arcsec"
    parser.add_argument("poses", type=Path, help=columns)
    parser.add_argument(
        "--config", type=Path, default=config.SIM, help="configuration with the starting geometry (%(default)s)"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="new file for the result; else standard output")
    parser.add_argument(
        "--map", action="store_true", help="write a map of the errors that the geometry does not explain"
    )
    parser.add_argument(
        "--cells",
        type=int,
        nargs=3,
        default=(4, 4, 8),
        choices=range(1, 9),
        metavar="N",
        help="of the map, 1 to 8",
    )
    parser.add_argument("--deg", action="store_true", help="phi is in degrees where it has no unit")
    parser.add_argument("--position-noise", type=length, default=20e-6, metavar="M", help="of x, y [m] (%(default)s)")
    parser.add_argument("--angle-noise", type=angle, default=1e-4, metavar="RAD", help="of phi [rad] (%(default)s)")
    try:
        calibrate(parser.parse_args(arguments))
    except TrirailError as error:
        print(f"calibrate: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
