"""Learn a motion of a pose: position and orientation become six continuous outputs in the frame of the target."""

import numpy as np
from pydrake.math import RollPitchYaw

from guiderail import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives import pose_demonstrations, pose_rotation

rng = np.random.default_rng(0)
times, positions, quaternions = [], [], []
for _ in range(4):  # recordings of p_WE and R_WE with different starts
    s = np.linspace(0, 1, 80)[:, None]
    start = np.array([0.4, 0.0, 0.5]) + 0.02 * rng.standard_normal(3)
    target = np.array([0.6, 0.1, 0.2])
    times.append(2.0 * s[:, 0])
    positions.append(start + (target - start) * s + 0.01 * rng.standard_normal(3) * np.sin(np.pi * s))
    yaw = 0.5 * s[:, 0] + 0.05 * rng.standard_normal() * (1 - s[:, 0])
    quaternions.append(np.array([RollPitchYaw(np.pi, 0.0, angle).ToQuaternion().wxyz() for angle in yaw]))

demonstrations = pose_demonstrations(times, positions, quaternions)  # relative to the last pose of each recording
print(", ".join(demonstrations.names))
reference = ReferenceTrajectory.from_demonstrations(demonstrations, components=4, floor=1e-3)

bound = np.array([0.3, 0.3, 0.35, 1.0, 1.0, 1.0])  # largest distance from the target [m], [rad]
primitive = LcNsKmp(reference, constraints=LinearConstraints.box(-bound, bound))
pose = primitive.predict(reference.num_steps // 2).output
angle = pose_rotation(pose[3:]).magnitude()
print("middle of the motion, relative to the target: position", pose[:3].round(2), "m, rotation", angle.round(2), "rad")
