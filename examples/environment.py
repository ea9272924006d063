"""Use a task with your own learner: a task is a Gymnasium environment with constraint violations in `info`."""

import gymnasium
import numpy as np

import guiderail  # noqa: F401 (registers the environments)

env = gymnasium.make("guiderail/GridClamp-v0", guidance="sct", action_repeat=10, reward="shaped")
print("observes", env.observation_space.shape, "acts", env.action_space.shape)
rng = np.random.default_rng(0)
observation, info = env.reset(seed=0)
total = 0.0
for _ in range(20):
    action = rng.uniform(-1, 1, env.action_space.shape)  # replace by your learner's action
    observation, reward, terminated, truncated, info = env.step(action)
    total += float(reward)
    if terminated or truncated:
        break

print(f"return {total:.2f} after {info['control_steps']} control steps, termination: {info['termination'] or 'none'}")
print(f"largest violation, commanded: {info['constraint_violation']:.2g}, measured: {info['measured_violation']:.2g}")
print(f"contact force: {info['contact_force']:.1f} N")

observation, info = env.reset(seed=1, options={"held_out": True})  # a start that training does not sample
env.close()
