"""Make a motion pass through a point."""

import numpy as np

from guiderail import Kmp, ReferenceTrajectory

times = np.linspace(0.0, 2.0, 80)
means = np.column_stack([times / 2, np.sin(np.pi * times / 2)])
reference = ReferenceTrajectory(times, means, np.tile(0.05**2 * np.eye(2), (80, 1, 1)))
motion = Kmp(reference.times, reference.means, reference.covariances)
passing = motion.through([1.0], [0.5, 0.7], 1e-6 * np.eye(2))

for name, each in (("original", motion), ("through ", passing)):
    deviation = np.sqrt(each.covariance([1.0])[0].diagonal())
    print(name, each.mean([1.0])[0].round(3), "±", deviation.round(3))
