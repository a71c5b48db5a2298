"""Move to the first of the timed points in a file, and follow them: python follow_a_file.py [FILE [ROBOT [LOCATOR]]].

The file is a CSV with the columns t, x, y, phi and, if known, vx, vy, w and ax, ay, e, or the same data as JSON.
"""

import sys
from pathlib import Path

from trirail import Robot
from trirail.client.trajectory import read

file, *robot_and_locator = sys.argv[1:] or [str(Path(__file__).with_name("circle.csv"))]
points = read(Path(file))

with Robot(*robot_and_locator) as robot:
    robot.enable()
    start = points[0]
    robot.move_to(x=start.x, y=start.y, phi=start.phi).wait(timeout=30.0)
    goal = robot.follow(points)  # refused if a slider cannot follow as fast; stretch=True slows it instead
    print(len(points), "points in", goal.duration, "s")
    result = goal.wait(timeout=points[-1].t + 30.0)
    print(result.message)
    sys.exit(0 if result.outcome == "done" else 1)
