"""Targets of a new camera calibration: the pixels of its marks after the last move."""

from __future__ import annotations

from typing import TYPE_CHECKING

from trirail.errors import TrirailError

if TYPE_CHECKING:
    from trirail.alignment.camera_calibration import CameraCalibration, Marks
    from trirail.cli.mark_source import Look, MarkSource
    from trirail.client.client import Robot


def observe_targets(
    robot: Robot, look: Look, source: MarkSource, calibration: CameraCalibration
) -> tuple[Marks, list[TrirailError]]:
    """Return the pixels of the marks in a new look, at the pose of the calibration's first look, and a list of errors.

    A calibration takes long, so it must not be lost if this look fails, and its targets must fit its marks. The pixels
    of marks that are not found are those that the calibration computes, and the list contains the error.
    """
    import numpy as np

    from trirail.alignment.camera_calibration import to_base_frame
    from trirail.alignment.images import project_points
    from trirail.alignment.procedure import observe_mean
    from trirail.client.alignment import drive

    targets = {}
    for name, mark in calibration.marks.items():
        at = np.array([to_base_frame(mark.place, calibration.poses[0])])
        u, v = project_points(calibration.views[mark.view], at)[0].tolist()
        targets[name] = (u, v)
    try:
        marks = drive(robot, look, observe_mean(source.looks), source.speed, source.wait).marks
    except (TrirailError, OSError) as error:
        words = f"the look after the last move has failed: {error}; the targets are the computed positions of the marks"
        return targets, [TrirailError(words)]
    unseen = ", ".join(name for name in targets if name not in marks)
    targets |= {name: pixel for name, pixel in marks.items() if name in targets}
    words = f"marks not found after the last move: {unseen}; their targets are their computed positions"
    return targets, [TrirailError(words)] if unseen else []
