"""Step many environments in parallel: Gymnasium's vector environment runs each of them in a separate process."""

import gymnasium

import guiderail  # noqa: F401 (registers the environments)

if __name__ == "__main__":  # each process imports this file first
    envs = gymnasium.make_vec(
        "guiderail/NarrowPassage-v0",
        num_envs=2,
        guidance="skgrl",
        action_repeat=5,
    )
    observations, infos = envs.reset(seed=0)  # environment i has the seed 0 + i
    print("observations", observations.shape)
    for _ in range(10):
        observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
    print("control steps so far:", infos["control_steps"])
    print("constraints satisfied:", bool((infos["constraint_violation"] <= 1e-9).all()))
    envs.close()
