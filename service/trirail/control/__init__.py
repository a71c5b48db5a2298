"""Control of the robot, one cycle at a time: modes, goals, feedback and setpoints. It does no input or output."""
