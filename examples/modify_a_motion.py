"""Modify a whole motion at once: null-space actions at a few steps displace the motion smoothly."""

import numpy as np

from guiderail import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains

STEPS = 60
times = np.linspace(0.0, 2.0, STEPS)
means = np.column_stack([times / 2, np.sin(np.pi * times / 2)])
deviation = 0.02 + 0.2 * np.sin(np.pi * times / 2)  # standard deviation, smallest at both ends
reference = ReferenceTrajectory(times, means, deviation[:, None, None] ** 2 * np.eye(2))
primitive = LcNsKmp(reference, constraints=LinearConstraints.box([-np.inf, -np.inf], [np.inf, 1.1]))

action = authority_gains(primitive) * np.array([[0.0, 1.0], [0.0, -1.0]])  # up at step 20, down at step 40
modified = primitive.modified_trajectory([20, 40], action)
displacement = modified.trajectory[:, 1] - means[:, 1]
print("displacement at the ends        ", displacement[[0, -1]].round(3))
print("displacement at steps 20 and 40 ", displacement[[20, 40]].round(3))
print("largest y, with the bound 1.1   ", modified.trajectory[:, 1].max().round(9))
