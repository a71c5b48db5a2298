"""Send goals in advance that blend into each other: a square with round corners. [ROBOT [LOCATOR]]."""

import sys

from trirail import Robot

CORNERS = [(0.03, 0.03), (-0.03, 0.03), (-0.03, -0.03), (0.03, -0.03), (0.03, 0.03)]
ROUND = 0.008
"""Distance from a corner at which the next side begins [m]."""

with Robot(*sys.argv[1:]) as robot:
    robot.enable()
    robot.move_to(x=CORNERS[0][0], y=CORNERS[0][1], phi=0.0).wait(timeout=30.0)
    # After a goal with `blend`, further goals wait, as many as [motion] queue allows. A goal without is preempted.
    goals = [robot.move_to(x=x, y=y, phi=0.0, blend=ROUND) for x, y in CORNERS[1:]]
    for goal in goals:
        print(goal.wait(timeout=30.0).message)
    sys.exit(0 if all(goal.result and goal.result.outcome == "done" for goal in goals) else 1)
