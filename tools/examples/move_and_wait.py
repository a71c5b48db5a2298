"""Move the platform to a pose and wait until it is there: python move_and_wait.py [ROBOT [LOCATOR]]."""

import sys

from trirail import RefusedError, Robot

with Robot(*sys.argv[1:]) as robot:
    robot.enable()
    try:
        goal = robot.move_to(x=0.02, y=-0.01, phi=0.1)  # metres and radians
    except RefusedError as refusal:  # nothing moves; the error carries code, slider, value and limit
        sys.exit(f"refused ({refusal.code}): {refusal}")
    if goal.reply.slowed > 1.0:
        print(f"slowed {goal.reply.slowed:.2f} times, since a slider could not follow")
    result = goal.wait(timeout=30.0)
    print(result.message)
    sys.exit(0 if result.outcome == "done" else 1)
