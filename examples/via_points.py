"""Make a motion pass through a point: add, move and remove a via-point."""

import numpy as np

from guiderail import Kmp, ReferenceTrajectory

times = np.linspace(0.0, 2.0, 80)
means = np.column_stack([times / 2, np.sin(np.pi * times / 2)])
reference = ReferenceTrajectory(times, means, np.tile(0.05**2 * np.eye(2), (80, 1, 1)))
motion = Kmp(reference.times, reference.means, reference.covariances)

instant, point = np.array([1.0]), np.array([0.5, 0.7])
print("original ", motion.mean(instant)[0].round(3), "±", np.sqrt(motion.covariance(instant)[0].diagonal()).round(3))
name = motion.add_via_point(instant, point, 1e-6 * np.eye(2))
print("through  ", motion.mean(instant)[0].round(3), "±", np.sqrt(motion.covariance(instant)[0].diagonal()).round(3))
motion.move_via_point(name, instant, point + np.array([0.0, 0.1]), 1e-6 * np.eye(2))
print("moved    ", motion.mean(instant)[0].round(3))
motion.remove_via_point(name)
print("removed  ", motion.mean(instant)[0].round(3))
