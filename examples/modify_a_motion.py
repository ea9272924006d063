"""Modify a whole motion at once: null-space actions at some points displace the motion between them smoothly."""

import numpy as np

from guiderail import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import authority_gains

STEPS = 60
times = np.linspace(0.0, 2.0, STEPS)
means = np.column_stack([times / 2, np.sin(np.pi * times / 2)])
wide = 0.02 + 0.2 * np.sin(np.pi * times / 2)  # the demonstrations agree at both ends
reference = ReferenceTrajectory(times, means, wide[:, None, None] ** 2 * np.eye(2))
primitive = LcNsKmp(reference, constraints=LinearConstraints.box([-np.inf, -np.inf], [np.inf, 1.1]))

action = authority_gains(primitive) * np.array([[0.0, 1.0], [0.0, -1.0]])  # up at one point, down at another
modified = primitive.modified_trajectory([20, 40], action)
added = modified.trajectory[:, 1] - means[:, 1]
print("added at the ends    ", added[[0, -1]].round(3))
print("added at the points  ", added[[20, 40]].round(3))
print("highest, of 1.1 at most", modified.trajectory[:, 1].max().round(9))
