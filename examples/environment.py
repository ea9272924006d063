"""How do I use it with my own learner? As a Gymnasium environment; what was safe about it is in `info`."""

import gymnasium
import numpy as np

env = gymnasium.make("guiderail.diagrams:guiderail/NarrowPassage-v0", guidance="kgrl", hold=10, reward="shaped")
print("observes", env.observation_space.shape, "acts", env.action_space.shape)
rng = np.random.default_rng(0)
observation, info = env.reset(seed=0)
total, over = 0.0, False
while not over:
    action = rng.uniform(-1, 1, env.action_space.shape)  # your learner's
    observation, reward, terminated, truncated, info = env.step(action)
    total += float(reward)
    over = terminated or truncated

print(f"ended as {info['termination']!r} with a return of {total:.1f}")
for name in ("worst_commanded_violation", "worst_measured_violation", "peak_force", "collisions", "fallbacks"):
    print(f"{name}: {info['ledger'][name]:.3f}")

observation, info = env.reset(seed=1, options={"held_out": True})  # from where training never starts
env.close()
