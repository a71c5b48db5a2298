"""Align a part with two simulated cameras, each of which sees one disc: python align_with_two_cameras.py [ROBOT …]."""

import sys

import numpy as np
from trirail import Robot
from trirail.alignment.camera_calibration import Marks
from trirail.alignment.finding import find
from trirail.alignment.images import CameraView
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera

DISC = MarkShape("disc", 160e-6)  # metres
VIEWS = {
    "left": CameraView((-0.06, 0.0), (640.0, 480.0), ((2.5e5, 1e4), (1e4, -2.5e5))),
    "right": CameraView((0.06, 0.0), (640.0, 480.0), ((-2.5e5, 1e4), (1e4, 2.5e5))),
}

with Robot(*sys.argv[1:]) as robot:
    robot.enable()
    robot.move_to(x=0.0, y=0.0, phi=0.0).wait()  # where the marks are in the pictures
    rng = np.random.default_rng()
    part = {"left": (-0.06, 0.0), "right": (0.06, 0.0)}

    def capture_marks() -> Marks:
        """Take a picture with each camera, and find the disc in the picture."""
        pose, seen = robot.state().pose, {}
        for name, place in part.items():
            camera = SimulatedCamera(VIEWS[name], {name: DrawnMark(DISC, place)}, 1280, 960, noise=2.0)
            if spot := find(camera.picture(lambda _: pose, 0.0, rng), MarkShape("disc", 40.0)):
                seen[name] = (spot.u, spot.v)
        return seen

    targets = capture_marks()  # this part is at its target, and so are its marks
    calibration = robot.calibrate_camera(capture_marks)
    part = {"left": (-0.0597, 0.0001), "right": (0.0603, 0.0005)}  # the next part, shifted by 0.3 mm and turned
    result = robot.align(capture_marks, targets, calibration, tolerance=20e-6, angle=1e-3)
    for measured in result.measurements:
        print(f"{1e6 * measured.worst:.2f} µm to go")
    sys.exit(0 if result.reached else 1)
