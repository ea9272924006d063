"""Environments by name, and what an episode in one comes to: a row of numbers that the safety ledger backs."""

from collections.abc import Callable, Mapping
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.trace import mean_jerk
from guiderail.models.errors import InputError

START_DEVIATION = 0.01  # m, of a held-out start from the usual one
# What the safety ledger counts.
COUNTS = ("collisions", "collision_steps", "saturations", "fallbacks")


class EpisodeRecord:
    """Takes in the decisions of one episode, and tells what it came to.

    Everything it says comes from the safety ledger and the trace, which know every control step and not only the last
    of a hold. (An episode in which the simulation failed has no ledger; then it is what was seen until there.)
    """

    def __init__(self, env: gymnasium.Env):
        """
        Args:
            env: just reset.
        """
        self._env = cast(Any, env.unwrapped)
        self._terms: dict[str, float] = dict.fromkeys(self._env.task.reward_terms, 0.0)
        self._return = 0.0
        self._violation = self._measured = -np.inf
        self._last: dict[str, Any] = {}

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        """Takes in what a step of the environment returned."""
        self._return += float(reward)
        self._violation = max(self._violation, info["constraint_violation"])
        self._measured = max(self._measured, info["measured_violation"])
        for name in self._terms:
            self._terms[name] += float(info[name])
        self._last = dict(info)

    def row(self, episode: int) -> dict[str, Any]:
        """The episode's numbers, in a fixed order."""
        trace, ledger = self._env.trace, self._last.get("ledger", {})
        force = np.asarray(trace.force)
        jerk = {
            f"jerk_{which}_{part}": value
            for which, poses in (("commanded", trace.commanded), ("measured", trace.measured))
            for part, value in split_jerk(poses, trace.period).items()
        }
        return {
            "episode": episode,
            "return": self._return,
            "success": int(self._last["is_success"]),
            "termination": "simulation_failure" if "simulation_failure" in self._last else self._last["termination"],
            "steps": len(trace),
            "peak_force": float(ledger.get("peak_force", force.max(initial=0.0))),
            "mean_force": float(ledger.get("mean_force", force.mean() if len(force) else 0.0)),
            "mean_squared_force": float(np.mean(force**2)) if len(force) else 0.0,
            **jerk,
            "worst_violation": float(ledger.get("worst_commanded_violation", self._violation)),
            "worst_measured_violation": float(ledger.get("worst_measured_violation", self._measured)),
            **{name: int(ledger.get(name, 0)) for name in COUNTS},
            **{f"reward_{name}": value for name, value in self._terms.items()},
        }


def split_jerk(poses: np.ndarray, period: float) -> dict[str, float]:
    """Mean jerk of positions and, in a pose of six numbers, of rotations [1/s³ of their units]."""
    poses = np.array(poses)
    angular = mean_jerk(poses[:, 3:], period) if poses.shape[1] == 6 else 0.0
    return {"linear": mean_jerk(poses[:, :3], period), "angular": angular}


def reset_held_out(env: gymnasium.Env, seed: int, **options: Any) -> np.ndarray:
    """Starts an episode with conditions that training never drew; `options` are further ones of the reset.

    A task draws them by its reset option `held_out`, or at least by the seed, which is none of training's. One in which
    every episode starts from the same place is started a little beside it instead.
    """
    try:
        return env.reset(seed=seed, options={"held_out": True} | options)[0]
    except InputError as error:
        if "held_out" not in str(error):
            raise
    usual = env.reset(seed=seed + 1)[1].get("start")
    observation, drawn = env.reset(seed=seed)
    if usual is None or not np.array_equal(usual, drawn["start"]):
        return observation
    beside = START_DEVIATION * np.random.default_rng(seed).standard_normal(len(drawn["start"]))
    return env.reset(seed=seed, options={"start": np.asarray(drawn["start"]) + beside})[0]


def run_episode(
    env: gymnasium.Env,
    act: Callable[[np.ndarray], np.ndarray],
    *,
    held_out_seed: int | None = None,
    episode: int = 0,
    **options: Any,
) -> dict[str, Any]:
    """Runs one episode and returns its row; the environment's trace is still that episode's afterwards.

    Args:
        env: the environment.
        act: the policy.
        held_out_seed: draws conditions that training never drew; without it, the next ones that training would draw.
        episode: the row's number.
        options: further ones of a held-out reset.
    """
    observation = env.reset()[0] if held_out_seed is None else reset_held_out(env, held_out_seed, **options)
    record = EpisodeRecord(env)
    finished = False
    while not finished:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        record.add(float(reward), info)
        finished = terminated or truncated
    return record.row(episode)


def standing_still(env: gymnasium.Env) -> Callable[[np.ndarray], np.ndarray]:
    """The policy before it learned anything: the action of zero, which leaves guidance to itself."""
    shape = env.action_space.shape or ()
    return lambda observation: np.zeros(shape, np.float32)
