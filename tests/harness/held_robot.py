"""Episodes in which the robot is held for two seconds: `python tests/harness/held_robot.py [--episodes N]`.

The scripted policy acts on the hard connector on the gantry, guided by KGRL. All joints of the gantry are locked for
two seconds. The guided motion advances with the clock or with the robot's state. The episodes of both kinds have the
same length and the same conditions.
"""

import argparse
from collections import Counter

import numpy as np

from guiderail.diagrams.envs import assemble
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.bnc_connector import scripted_center_of_pressure
from guiderail.models.common.arrays import round_period

TOLERANCES = {
    # No robot exceeds this tolerance, so progress follows the clock. The episodes are as long as those of "state".
    "clock": (1e3, 1e3),
    "state": assemble.PROGRESS_TOLERANCE,
}


def set_held(env: object, is_held: bool) -> None:
    """Lock or unlock all joints of the gantry."""
    diagram = env.diagram.diagram
    plant = diagram.GetSubsystemByName("station").plant
    context = plant.GetMyMutableContextFromRoot(env.simulator.get_mutable_context())
    plant.SetVelocities(context, np.zeros(plant.num_velocities()))
    for index in plant.GetJointIndices(plant.GetModelInstanceByName("gantry")):
        joint = plant.get_joint(index)
        if joint.num_velocities():
            joint.Lock(context) if is_held else joint.Unlock(context)


def run_episode(env: object, seed: int, begin: float | None, seconds: float) -> dict:
    """Run an episode in which the robot is held; return the last `info` and the "delay" of the motion [s].

    Args:
        env: Environment.
        seed: Seed of the episode.
        begin: Time at which the robot is locked [s]; None: never.
        seconds: Time for which the robot is locked [s].
    """
    period = env.diagram.control_period
    first = None if begin is None else round(begin / period)
    last = None if begin is None else round((begin + seconds) / period)
    observation, info = env.reset(seed=seed, options={"held_out": True})
    terminated = truncated = False
    while not (terminated or truncated):
        step = info["control_steps"]
        if step in (first, last):
            set_held(env, step == first)
        observation, _, terminated, truncated, info = env.step(scripted_center_of_pressure(observation))
    port = env.diagram.diagram.GetOutputPort("motion_time")
    delay = round_period(period) * info["control_steps"] - float(port.Eval(env.simulator.get_context())[0])
    return {**info, "delay": delay}


def run_episodes(progress: str, begin: float | None, episodes: int, seconds: float = 2.0) -> list[dict]:
    """Return the results of `run_episode` for several seeds and one kind of progress."""
    assemble.PROGRESS_TOLERANCE = TOLERANCES[progress]
    # With a function `before_build`, a diagram with another tolerance is not used again.
    env = make_env("BncConnector", guidance="kgrl", difficulty="hard", progress="state", before_build=lambda builder: 0)
    infos = [run_episode(env, 1000 + k, begin, seconds) for k in range(episodes)]
    env.close()
    return infos


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument(
        "--held-from",
        type=float,
        nargs="*",
        default=[2.0, 4.0],
        help="times of locking [s]; without a value the robot is never locked",
    )
    parser.add_argument("--progress", choices=TOLERANCES, nargs="+", default=list(TOLERANCES))
    options = parser.parse_args()
    print("progress | held from [s] | success | terminations | delay at the end [s] | peak force [N]")
    for begin in options.held_from or [None]:
        for progress in options.progress:
            infos = run_episodes(progress, begin, options.episodes)
            reasons = dict(Counter(info["termination"] for info in infos))
            delay, force = np.mean([info["delay"] for info in infos]), max(info["impedance_force"] for info in infos)
            success = f"{reasons.get('success', 0)}/{len(infos)}"
            print(f"{progress} | {begin} | {success} | {reasons} | {delay:.2f} | {force:.1f}")


if __name__ == "__main__":
    main()
