"""The robot's kinematics without a service: sliders for a circle of poses, poses for these sliders, and Jacobians."""

import math

import numpy as np
from trirail import Geometry, KinematicsError, forward, inverse, jacobians

robot = Geometry.symmetric(l0=0.3)  # or three measured legs: Geometry(legs=(Leg(…), Leg(…), Leg(…)))

angle = np.linspace(0.0, 2.0 * math.pi, 1000)
pose = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.full_like(angle, 0.1)], axis=1)  # (N, 3): x, y, phi
velocity = np.stack([-0.05 * np.sin(angle), 0.05 * np.cos(angle), np.zeros_like(angle)], axis=1)  # 1 radian per second

motion = inverse(robot, pose, velocity)
print("sliders reach", motion.position.min(axis=0), "to", motion.position.max(axis=0), "m")
print("and move at up to", np.abs(motion.velocity).max(axis=0), "m/s")

print("there and back again:", np.abs(forward(robot, motion.position) - pose).max(), "m or rad")

J1, J2 = jacobians(robot, pose)  # (N, 3, 3): J1 @ slider velocity = J2 @ platform velocity
left, right = np.einsum("nij,nj->ni", J1, motion.velocity), np.einsum("nij,nj->ni", J2, velocity)
print("the Jacobians agree:", np.abs(left - right).max())

try:
    inverse(robot, (0.0, 0.0, math.pi / 3.0))
except KinematicsError as error:
    print(error)
