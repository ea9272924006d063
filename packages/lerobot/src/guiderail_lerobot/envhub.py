"""Environments for LeRobot's EnvHub: `env.py`, which `lerobot_robot_guiderail.export` writes, calls `make_hub_env`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError
from guiderail_lerobot.env_server import open_environment


class LeRobotObservation(gymnasium.ObservationWrapper[dict[str, np.ndarray], np.ndarray, np.ndarray]):
    """Environment whose observation is a dictionary with `agent_pos`, which LeRobot renames to `observation.state`.

    Attributes:
        task: Name of the task.
        task_description: The same name; LeRobot passes it to policies that read a text.
        _max_episode_steps: Largest number of actions in an episode, which LeRobot reads.

    Args:
        env: Environment of a task.
        task: Name of the task.

    Raises:
        InputError: If the observation is an image.
    """

    def __init__(self, env: Any, task: str):
        super().__init__(env)
        if len(env.observation_space.shape) != 1:
            raise InputError("an environment whose observation is an image is not available for LeRobot's EnvHub")
        self.task = self.task_description = task
        self._max_episode_steps = -(-env.diagram.num_steps // env.action_repeat)
        observed: gymnasium.Space[Any] = gymnasium.spaces.Dict({"agent_pos": env.observation_space})
        self.observation_space = observed

    def observation(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """Return the observation, (n,), as a dictionary."""
        return {"agent_pos": observation}


def make_hub_env(
    task: str, options: Mapping[str, Any], n_envs: int = 1, use_async_envs: bool = False
) -> dict[str, dict[int, VectorEnv]]:
    """Return the environments of a task as LeRobot's EnvHub expects them: a vector environment by suite and number.

    Args:
        task: Name of a task, or folder of a run.
        options: Options of the environment.
        n_envs: Number of environments.
        use_async_envs: If True, each environment runs in a process of its own.

    Raises:
        InputError: If the task or an option is invalid, or `n_envs` is less than 1.
    """
    as_whole(n_envs, "n_envs", 1)
    makers = [partial(_make_one, task, dict(options))] * n_envs
    mode = AutoresetMode.SAME_STEP  # LeRobot reads the success of an episode from `final_info`
    vector = (
        AsyncVectorEnv(makers, autoreset_mode=mode, context="forkserver")
        if use_async_envs
        else SyncVectorEnv(makers, autoreset_mode=mode)
    )
    return {task: {0: vector}}


def _make_one(task: str, options: dict[str, Any]) -> LeRobotObservation:
    return LeRobotObservation(open_environment(task, options), task)
