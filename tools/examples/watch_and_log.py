"""Write the state to a CSV file for some seconds: python watch_and_log.py FILE SECONDS [ROBOT [LOCATOR]]."""

import csv
import sys

from trirail import Robot

file, seconds, *robot_and_locator = sys.argv[1:]

with Robot(*robot_and_locator) as robot, open(file, "w", newline="", encoding="utf-8") as opened:
    rows = csv.writer(opened)
    rows.writerow(["t", "mode", "x", "y", "phi", "error_a", "error_b", "error_c", "goal"])
    begin = robot.state().t
    for state in robot.states(timeout=5.0):  # fifty per second; if this program is too slow, only the newest states
        goal = state.goal.id if state.goal else ""
        # `pose` is measured: the forward kinematics of the measured sliders. `commanded.pose` is the setpoint.
        rows.writerow([state.t, state.mode, *state.pose, *state.sliders.following_error, goal])
        if state.t >= begin + float(seconds):
            sys.exit(0)
    sys.exit("the service no longer sends its state")
