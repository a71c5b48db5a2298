"""Follow a target that a camera, here a simulated one, sees a hundred times a second. [ROBOT [LOCATOR]]."""

import math
import sys
import time
from collections.abc import Iterator

from trirail import Robot

RATE, SECONDS = 100.0, 4.0
RADIUS, TURN = 0.02, math.pi  # a full circle takes two seconds [m], [rad/s]


def camera() -> Iterator[tuple[tuple[float, float, float], tuple[float, float, float], float]]:
    """Yield the pose and the velocity of the target, and the wall-clock time of the picture on this machine."""
    begins = time.time()
    for n in range(round(RATE * SECONDS)):
        time_of_picture = begins + n / RATE
        time.sleep(max(0.0, time_of_picture - time.time()))
        c, s = math.cos(TURN * (time_of_picture - begins)), math.sin(TURN * (time_of_picture - begins))
        yield (RADIUS * c, RADIUS * s, 0.0), (-RADIUS * TURN * s, RADIUS * TURN * c, 0.0), time_of_picture


with Robot(*sys.argv[1:]) as robot:
    robot.enable()
    lags = []
    with robot.track() as track:  # if the updates end for any reason, the robot brakes on its path
        for pose, velocity, time_of_picture in camera():
            track.update(pose, velocity, time_of_picture)
            lags.append(track.lag or 0.0)
    print(f"{len(lags)} updates, at most {1e3 * max(lags[len(lags) // 4 :]):.2f} mm behind after the first second")
    print("stands at", *(f"{value:.4f}" for value in robot.state().pose))
