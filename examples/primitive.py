"""Use the primitive alone, with NumPy: learn a motion from demonstrations, constrain it and displace it by actions."""

import numpy as np

from guiderail import Demonstrations, LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.gains import authority_gains

rng = np.random.default_rng(0)
times = np.linspace(0.0, 2.0, 100)
path = np.column_stack([times, np.sin(2 * times)])
demonstrations = Demonstrations(
    times, [path + 0.05 * rng.standard_normal(2) * np.sin(2 * times)[:, None] for _ in range(6)]
)

reference = ReferenceTrajectory.from_demonstrations(demonstrations, components=6, floor=0.005)
primitive = LcNsKmp(
    reference,
    SquaredExponential(length_scale=0.5),
    history=10,
    history_variance=1e-6,
    constraints=LinearConstraints.box([-np.inf, -1.0], [np.inf, 0.9]),
)
gains = authority_gains(primitive)  # factors from an action in ±1 to a null-space action
history = np.tile(reference.means[0], (10, 1))
for step in range(reference.num_steps):
    output = primitive.predict(step, gains * np.array([0.0, 1.0]), history).output
    history = np.vstack([history[1:], output])
    assert output[1] <= 0.9 + 1e-9
print("last output:", output.round(3), "last mean of the demonstrations:", reference.means[-1].round(3))
