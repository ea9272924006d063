"""Plan by sampling: simulate random plans from a saved state, execute the beginning of the best one, and plan again."""

import numpy as np

from guiderail import make_env

HORIZON, SAMPLES, EXECUTED = 8, 10, 4  # steps of a plan, random plans, steps that are executed

env = make_env("NarrowPassage", guidance="kgrl", difficulty="hard", action_repeat=10)
rng = np.random.default_rng(0)


def simulate(state, plan):
    """Return the sum of the rewards of a plan from a saved state; an early end of the episode counts as well."""
    env.restore(state)
    total = 0.0
    for action in plan:
        _, reward, terminated, truncated, info = env.step(action)
        total += reward
        if terminated or truncated:
            return total + (100.0 if info["is_success"] else -100.0)
    return total


def vary(plan):
    """Return a plan with a random offset, and random changes of each action."""
    offset, changes = rng.standard_normal(plan.shape[-1]), rng.standard_normal(plan.shape)
    return np.clip(plan + 0.7 * offset + 0.3 * changes, -1.0, 1.0)


env.reset(seed=0)
plan = np.zeros((HORIZON, *env.action_space.shape))
ended = False
while not ended:
    state = env.save()
    plan = max([plan, *(vary(plan) for _ in range(SAMPLES))], key=lambda each: simulate(state, each))
    env.restore(state)
    for action in plan[:EXECUTED]:
        _, _, terminated, truncated, info = env.step(action)
        if ended := terminated or truncated:
            break
    plan = np.concatenate([plan[EXECUTED:], np.zeros_like(plan[:EXECUTED])])
print(f"{info['termination']} after {info['control_steps']} control steps")
