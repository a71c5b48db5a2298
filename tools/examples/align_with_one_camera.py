"""Align a part by two marks in the picture of one camera, with asyncio: python align_with_one_camera.py [ROBOT …]."""

import asyncio
import sys

from trirail import AsyncRobot
from trirail.alignment.camera_calibration import Marks
from trirail.alignment.images import CameraView
from trirail.alignment.shapes import MarkShape
from trirail.alignment.simulated_camera import DrawnMark, SimulatedCamera

VIEW = CameraView((0.02, 0.01), (1000.0, 800.0), ((1.2e5, 0.0), (0.0, -1.2e5)))
DISC = MarkShape("disc", 200e-6)


async def main() -> int:
    """Calibrate with a part that is at its target, align another part, and print the remaining error."""
    async with AsyncRobot(*sys.argv[1:]) as robot:
        await robot.enable()
        part = {"a": (0.017, 0.01), "b": (0.023, 0.01)}

        async def capture_marks() -> Marks:
            """Return the pixel coordinates of both marks; with a real camera, await its picture here."""
            marks = {name: DrawnMark(DISC, place) for name, place in part.items()}
            return SimulatedCamera(VIEW, marks).pixels_at((await robot.state()).pose)

        targets = await capture_marks()
        calibration = await robot.calibrate_camera(
            capture_marks, views={"a": "camera", "b": "camera"}
        )  # one camera sees both marks
        part = {"a": (0.0173, 0.0102), "b": (0.0233, 0.0102)}
        result = await robot.align(capture_marks, targets, calibration, tolerance=20e-6, angle=5e-3)
        print(f"{result.why} after {len(result.corrections)}: {1e6 * result.measurements[-1].worst:.2f} µm to go")
        return 0 if result.reached else 1


sys.exit(asyncio.run(main()))
