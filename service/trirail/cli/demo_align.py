"""`trirail demo align`: align parts with two simulated cameras; Rerun shows pictures, marks and residuals.

The cameras see a stage that differs from its configuration and has backlash in its drives.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from trirail_drivers.interface import Triple

from trirail.alignment.camera_calibration import to_base_frame
from trirail.alignment.finding import find
from trirail.alignment.images import CameraView, Pair
from trirail.alignment.procedure import Alignment
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.cli.terminal import counted, out, plain
from trirail.client import own_service
from trirail.client.client import Robot
from trirail.client.stage_as_built import StageAsBuilt, built_otherwise
from trirail.config import corrected_geometry, load
from trirail.errors import ServiceError

PART_COUNT = 5
MAX_OFFSET_M, MAX_ROTATION = 0.4e-3, math.radians(0.25)
"""Largest offset and rotation of a part [m, rad]."""
DISC = MarkShape("disc", 160e-6)
MARK_POSITIONS: dict[str, Pair] = {"left": (-0.05, 0.0), "right": (0.05, 0.0)}
VIEWS = {
    "left": CameraView(MARK_POSITIONS["left"], (480.0, 360.0), ((2.6e5, 1.2e4), (1.5e4, -2.6e5))),
    "right": CameraView(MARK_POSITIONS["right"], (480.0, 360.0), ((-2.6e5, 2e4), (1e4, 2.6e5))),
}
MOVE_M, MOVE_ANGLE = 0.5e-3, math.radians(0.5)
"""Moves of the calibration [m, rad]."""
SIZE = 960, 720
EXPOSURE, DELAY = 0.004, 0.01
WAIT_S = 0.02
"""Time until the cameras show a new position [s]. It covers exposure, delay and the settling of the drives."""
BUILT_OFF, BUILT_TURNED, PLAY = 50e-6, 0.1e-3, 0.5e-6
"""Largest as-built errors of the stage in position [m] and angle [rad], and backlash of the drives [m]."""
COLOURS = {"mark": (90, 200, 250), "target": (250, 200, 60), "residual": (240, 90, 90)}


class DrawnCameras:
    """Two simulated cameras over a part. Each picture is sent to Rerun when it is taken."""

    def __init__(self, stage: StageAsBuilt, stream: rr.RecordingStream, seed: int) -> None:
        self.part: Mapping[str, Pair] = MARK_POSITIONS
        self.targets: Mapping[str, Pair] = {}
        self._stage, self._stream = stage, stream
        self._rng = np.random.default_rng(seed)

    def capture(self) -> dict[str, Pair]:
        """Take a picture with each camera, find the disc in the picture, and show both."""
        marks: dict[str, Pair] = {}
        self._stream.set_time("time", duration=time.monotonic())
        for name, place in self.part.items():
            marks_there = {name: DrawnMark(DISC, place)}
            camera = SimulatedCamera(
                VIEWS[name], marks_there, *SIZE, noise=3.0, shade=0.4, exposure=EXPOSURE, delay=DELAY
            )
            picture = camera.picture(self._stage.pose_at, time.monotonic(), self._rng)
            disc = find(picture, MarkShape("disc", DISC.size * VIEWS[name].scale))
            if disc is not None:
                marks[name] = (disc.u, disc.v)
            self._show(name, picture, marks.get(name))
        return marks

    def _show(self, name: str, picture: NDArray[np.uint8], mark: Pair | None) -> None:
        camera, target = f"cameras/{name}", self.targets.get(name)
        self._stream.log(camera, rr.Image(picture, "L").compress(80))
        shown = [] if mark is None else [mark]
        self._stream.log(f"{camera}/mark", rr.Points2D(shown, radii=6.0, colors=COLOURS["mark"]))
        if target is None:
            return
        self._stream.log(f"{camera}/target", rr.Points2D([target], radii=6.0, colors=COLOURS["target"]))
        ways = [] if mark is None else [np.subtract(target, mark)]
        arrows = rr.Arrows2D(origins=shown, vectors=ways, colors=COLOURS["residual"])
        self._stream.log(f"{camera}/residual", arrows)


def run(file: Path, recording: Path, parts: int = PART_COUNT, seed: int = 0) -> int:
    """Calibrate the cameras, then align `parts` parts; return 0 if all succeeded.

    Pictures are written to a file next to `recording`, and shown in the live view. Raises ServiceError if it exists.
    """
    config = load(file)
    recording.parent.mkdir(parents=True, exist_ok=True)
    pictures = recording.with_name(f"{recording.stem}-pictures.rrd")
    if pictures.exists():
        raise ServiceError(f"{pictures} already exists; name another file, or remove it")
    out.print(f"[bold]trirail demo align[/]: starting the service on {plain(file.name)}", soft_wrap=True)
    built = built_otherwise(corrected_geometry(config), np.random.default_rng(seed), BUILT_OFF, BUILT_TURNED)
    stage, results = StageAsBuilt(built, (PLAY, PLAY, PLAY)), []
    with own_service.service(file, recording), rr.RecordingStream("trirail_align") as stream:
        sinks: list[rr.FileSink | rr.GrpcSink] = [rr.FileSink(pictures)]
        if config.telemetry.live_port:
            sinks.append(rr.GrpcSink(f"rerun+http://127.0.0.1:{config.telemetry.live_port}/proxy"))
        stream.set_sinks(*sinks, default_blueprint=_layout())
        with Robot(config.robot.name, config.zenoh.listen[0], user="demo") as robot, robot.records(stage.add_records):
            robot.enable()
            cameras = DrawnCameras(stage, stream, seed)
            results = list(_parts(robot, cameras, stream, parts, seed))
            robot.disable()
            stream.disconnect()  # while the live view can still receive the rest
    out.print(f"[bold]recording[/]  {plain(str(recording))}", soft_wrap=True)
    out.print(f"[bold]pictures[/]   {plain(str(pictures))}: look at them with trirail view", soft_wrap=True)
    return 0 if len(results) == parts and all(result.reached for result in results) else 1


def _layout() -> rrb.Blueprint:
    """Return a layout with both cameras side by side, next to the residuals of each part."""
    cameras = [rrb.Spatial2DView(origin=f"/cameras/{name}", name=name) for name in VIEWS]
    plots = rrb.Vertical(
        rrb.TimeSeriesView(origin="/residual/worst_um", name="A mark has to go  [µm]"),
        rrb.TimeSeriesView(origin="/residual/turn_urad", name="The part has to turn  [µrad]"),
        rrb.TextLogView(origin="/alignments", name="Parts"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(*cameras, plots, column_shares=[3, 3, 2]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="Following"),
        collapse_panels=True,
    )


def _parts(robot: Robot, cameras: DrawnCameras, stream: rr.RecordingStream, parts: int, seed: int) -> list[Alignment]:
    moves = [(MOVE_M, 0, 0), (-MOVE_M, 0, 0), (0, MOVE_M, 0), (0, -MOVE_M, 0), (0, 0, MOVE_ANGLE), (0, 0, -MOVE_ANGLE)]
    robot.move_to(x=0.0, y=0.0, phi=0.0).wait(30.0)
    time.sleep(WAIT_S)
    calibration = robot.calibrate_camera(cameras.capture, moves, looks=4, wait=WAIT_S)
    cameras.targets = cameras.capture()
    out.print(f"calibrated in {counted(len(moves), 'move')}: residual {calibration.noise:.3f} pixel")
    rng, results = np.random.default_rng(seed), []
    for number in range(parts):
        robot.move_to(x=0.0, y=0.0, phi=0.0).wait(30.0)
        time.sleep(WAIT_S)
        x, y = rng.uniform(-MAX_OFFSET_M, MAX_OFFSET_M, 2).tolist()
        error = x, y, float(rng.uniform(-MAX_ROTATION, MAX_ROTATION))
        cameras.part = _placed(error)
        result = robot.align(cameras.capture, cameras.targets, calibration, looks=4, wait=WAIT_S)
        left = [f"{1e6 * each.worst:.2f}" for each in result.measurements]
        made = counted(len(result.corrections), "correction")
        line = f"part {number + 1}: {' → '.join(left)} µm, {made}: {result.why}"
        stream.log("alignments", rr.TextLog(line))
        for each in result.measurements:
            stream.set_time("time", duration=each.time)
            stream.log("residual/worst_um", rr.Scalars(1e6 * each.worst))
            stream.log("residual/turn_urad", rr.Scalars(1e6 * each.turn))
        out.print(f"  [{'green' if result.reached else 'red'}]{line}[/]", soft_wrap=True)
        results.append(result)
    return results


def _placed(error: Triple) -> dict[str, Pair]:
    lying = {name: to_base_frame(place, error).tolist() for name, place in MARK_POSITIONS.items()}
    return {name: (x, y) for name, (x, y) in lying.items()}
