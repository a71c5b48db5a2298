"""Control of the robot, cycle by cycle: modes, goals, feedback and setpoints. This package does no input or output."""
