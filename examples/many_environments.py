"""Step many environments at once: Gymnasium's vector environment runs each in a process of its own."""

import multiprocessing

import gymnasium

import guiderail  # noqa: F401 (registers the environments)

if __name__ == "__main__":  # each process imports this file first
    multiprocessing.set_forkserver_preload(["guiderail.diagrams.envs.make"])  # imported once for all processes
    envs = gymnasium.make_vec(
        "guiderail/NarrowPassage-v0",
        num_envs=2,
        vectorization_mode="async",
        # Forks of a fresh process: forks of this process would copy locks that its threads hold.
        vector_kwargs={"context": "forkserver"},
        guidance="skgrl",
        action_repeat=5,
    )
    observations, infos = envs.reset(seed=0)  # environment i has the seed 0 + i
    print("observations", observations.shape)
    for _ in range(10):
        observations, rewards, terminated, truncated, infos = envs.step(envs.action_space.sample())
    print("control steps so far:", infos["control_steps"])
    print("nothing beyond a constraint:", bool((infos["constraint_violation"] <= 1e-9).all()))
    envs.close()
