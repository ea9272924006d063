"""Environments by name, and what an episode in one comes to: a row of numbers that the safety ledger backs."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from threadpoolctl import threadpool_limits

import guiderail.diagrams  # noqa: F401 (registers the environments)
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.make import resolve
from guiderail.diagrams.tasks.task import TASKS, environment_id
from guiderail.diagrams.trace import mean_jerk
from guiderail.models.errors import InputError
from guiderail.models.registry import did_you_mean

# Guidance in which an action of zero is the demonstration, so that step-0 success can be stated.
DEMONSTRATED = tuple(name for name in GUIDANCE.names() if GUIDANCE.get(name).demonstrates)
# What the safety ledger counts.
COUNTS = ("collisions", "collision_steps", "saturations", "fallbacks")


def known_tasks() -> list[str]:
    """The tasks that there are: those that are declared, and environments that somebody registered as guiderail's."""
    return sorted(
        {*TASKS.names(), *(spec.name for spec in gymnasium.registry.values() if spec.namespace == "guiderail")}
    )


def check_environment(task: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a task's environment, its defaults filled in.

    Raises:
        InputError: for an unknown task, or an argument that it does not take.
    """
    if task in TASKS.names():
        return resolve(task, arguments).values
    if task not in known_tasks():
        raise InputError(f"there is no task {task!r}: {did_you_mean(task, known_tasks())}")
    entry = gymnasium.spec(environment_id(task)).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else cast(Any, entry)
    taken = {k: v for k, v in inspect.signature(creator).parameters.items() if k not in ("self", "render_mode")}
    unknown = sorted(set(arguments) - set(taken))
    if unknown:
        raise InputError(f"{task} has no argument {unknown[0]}: it takes {', '.join(taken)}")
    defaults = {key: parameter.default for key, parameter in taken.items()}
    return {k: arguments.get(k, v) for k, v in defaults.items() if k in arguments or v is not inspect.Parameter.empty}


def make_environment(task: str, arguments: Mapping[str, Any], render_mode: str | None = None) -> gymnasium.Env:
    """The environment of a task. From here on this process calculates with one thread.

    Matrices are small here. Where another process wants the cores too, threads that wait for each other take eighty
    times as long (a movement primitive with a history: 78 s for 1), and sums would depend on how many there are.

    Raises:
        InputError: for an unknown task or argument, or a pairing that makes no sense.
    """
    threadpool_limits(1)
    arguments = check_environment(task, arguments)
    return gymnasium.make(environment_id(task), disable_env_checker=True, render_mode=render_mode, **arguments)


def most_decisions(env: gymnasium.Env) -> int:
    """The most decisions that an episode can take."""
    base = cast(Any, env.unwrapped)
    return -(-base.task.num_steps // base.hold)


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
    """Starts an episode with conditions that training never drew; `options` are further ones of the reset."""
    return env.reset(seed=seed, options={"held_out": True} | options)[0]


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
