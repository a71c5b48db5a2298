"""Align a part with one camera that is moved to each of two marks: python align_with_a_moved_camera.py [ROBOT …]."""

import sys
import tempfile
from pathlib import Path

from trirail import Robot
from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import CameraView, Pair
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera
from trirail.client import calibration_file

STOPS: dict[str, Pair] = {"left": (-0.05, 0.0), "right": (0.05, 0.0)}  # positions of the camera, which has its own axis

with Robot(*sys.argv[1:]) as robot:
    robot.enable()
    part = dict(STOPS)

    def capture_marks() -> Marks:
        """Move the camera to each of its stops, and find the mark there. Each stop counts as a separate view."""
        seen: dict[str, Pair] = {}
        for name, stop in STOPS.items():
            view = CameraView(stop, (640.0, 480.0), ((2.5e5, 0.0), (0.0, -2.5e5)))
            camera = SimulatedCamera(view, {name: DrawnMark(MarkShape("disc", 160e-6), part[name])})
            seen |= camera.pixels_at(robot.state().pose)
        return seen

    targets = capture_marks()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "camera.json"
        calibration_file.write(file, robot.name, robot.calibrate_camera(capture_marks), targets)
        kept = calibration_file.read(file)  # to be used for all further parts
    part = {"left": (-0.0496, 0.0), "right": (0.0504, 0.0003)}
    result = robot.align(capture_marks, kept.targets, kept.calibration, tolerance=20e-6, angle=1e-3)
    print(f"{result.why} after {len(result.corrections)}: {1e6 * result.measurements[-1].worst:.2f} µm to go")
    sys.exit(0 if result.reached else 1)
