"""Compare the smoothness of exploration methods at the same RMS, because smaller motions have less jerk."""

import numpy as np

from guiderail import LcNsKmp, ReferenceTrajectory
from guiderail.diagrams.envs.trace import mean_jerk
from guiderail.models.primitives.gains import exploration_rms, rms_gains

ACTION_REPEAT, STEPS, PERIOD = 5, 150, 0.02
times = PERIOD * np.arange(STEPS)
means = np.column_stack([times / 3, np.sin(np.pi * times / 3)])
deviation = 0.01 + 0.1 * np.sin(np.pi * times / 3)
reference = ReferenceTrajectory(times, means, deviation[:, None, None] ** 2 * np.eye(2))

for name, history, variance in (("no history (KGRL)", 0, 1.0), ("rho = 1e-4", 10, 1e-4), ("rho = 1e-8", 10, 1e-8)):
    primitive = LcNsKmp(reference, history=history, history_variance=variance)
    gains = rms_gains(primitive, action_scale=0.5, action_repeat=ACTION_REPEAT)
    actions = np.repeat(np.random.default_rng(0).uniform(-1, 1, (primitive.num_steps, 2)), ACTION_REPEAT, axis=0)
    past = np.tile(primitive.reference.means[0], (primitive.history, 1))
    path = []
    for step in range(primitive.num_steps):
        path.append(primitive.predict(step, gains * actions[step], past if primitive.history else None).output)
        past = np.vstack([past, path[-1]])[1:] if primitive.history else past
    jerk = mean_jerk(np.array(path), PERIOD)
    rms = exploration_rms(primitive, gains, ACTION_REPEAT).round(2)
    print(f"{name}: RMS {rms} standard deviations, mean jerk {jerk:.2g}")
