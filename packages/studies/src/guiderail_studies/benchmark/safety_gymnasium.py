"""Environments with the interfaces of Safety-Gymnasium and OmniSafe, whose steps return a cost.

    python -m guiderail_studies.benchmark.safety_gymnasium train --algo PPOLag --env-id guiderail/GridClamp-v0

runs OmniSafe's own command with the environments of guiderail registered.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import gymnasium

from guiderail.models.common.errors import InputError


class SafetyGymnasiumView:
    """Environment with the interface of Safety-Gymnasium: a step also returns the cost.

    The cost is `info["cost"]`, the number of unsafe control steps of the action: with a commanded or measured pose
    outside the constraints, or in collision.

    Attributes:
        env: Environment with Gymnasium's interface.
        action_space: Space of actions.
        observation_space: Space of observations.
        metadata: Metadata of `env`.
        spec: Specification of `env`.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]):
        """Construct the view of an environment whose `info` has a cost."""
        self.env = env
        self.action_space, self.observation_space = env.action_space, env.observation_space
        self.metadata, self.spec = env.metadata, env.spec

    @property
    def unwrapped(self) -> gymnasium.Env[Any, Any]:
        """Environment without wrappers."""
        return self.env.unwrapped

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return its first observation and `info`."""
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, float, float, bool, bool, dict[str, Any]]:
        """Apply an action; return observation, reward, cost, terminated, truncated and `info`.

        Raises:
            InputError: If `info` has no cost.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise InputError("the environment's info has no cost: use an environment of guiderail, or add it")
        return observation, float(reward), float(info["cost"]), terminated, truncated, info

    def render(self) -> Any:
        """Return what the environment renders."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


class OmniSafeEnvironment:
    """Environment of guiderail with the interface of OmniSafe's `CMDP`; `register_omnisafe` derives the class from it.

    Args:
        env_id: Identifier of an environment of guiderail, as in `gymnasium.make`.
        num_envs: Number of environments; 1 only.
        device: PyTorch device of the tensors that are returned.
        options: Options of the environment (`env_cfgs` in OmniSafe's configuration).

    Raises:
        InputError: If `num_envs` is not 1, or an option is invalid.
    """

    need_auto_reset_wrapper = True
    need_time_limit_wrapper = False
    _time_limit: int | None = None

    def __init__(self, env_id: str, num_envs: int = 1, device: Any = "cpu", **options: Any):
        if num_envs != 1:
            raise InputError(f"OmniSafe runs one environment of guiderail in a process, not {num_envs}: give parallel")
        self._env = SafetyGymnasiumView(gymnasium.make(env_id, **options))
        self._num_envs, self._device = num_envs, device
        self._action_space, self._observation_space = self._env.action_space, self._env.observation_space
        self._metadata = dict(self._env.metadata)

    @property
    def max_episode_steps(self) -> int:
        """Largest number of actions of an episode."""
        base: Any = self._env.unwrapped
        return -(-int(base.diagram.num_steps) // int(base.action_repeat))

    def step(self, action: Any) -> tuple[Any, ...]:
        """Apply an action tensor; return observation, reward, cost, terminated and truncated as tensors, and `info`."""
        *values, info = self._env.step(action.detach().cpu().numpy())
        return (*map(self._tensor, values), info)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return its first observation as a tensor, and `info`."""
        observation, info = self._env.reset(seed=seed, options=options)
        return self._tensor(observation), info

    def set_seed(self, seed: int) -> None:
        """Set the seed of this and all later episodes."""
        self._env.reset(seed=seed)

    def render(self) -> Any:
        """Return what the environment renders."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

    def _tensor(self, value: Any) -> Any:
        import torch

        return torch.as_tensor(value, dtype=torch.float32, device=self._device)


def register_omnisafe() -> list[str]:
    """Register the environments of guiderail with OmniSafe, and return their identifiers.

    Raises:
        InputError: If OmniSafe is not installed.
    """
    import guiderail  # noqa: F401 (registers the environments with Gymnasium)

    try:
        core: Any = import_module("omnisafe.envs.core")
    except ImportError as error:
        raise InputError(
            f"OmniSafe cannot be imported ({error}): see docs/benchmark.md for an environment in which it runs"
        ) from error
    names = sorted(name for name, spec in gymnasium.registry.items() if spec.namespace == "guiderail")
    core.env_register(type("GuiderailEnvironment", (OmniSafeEnvironment, core.CMDP), {"_support_envs": names}))
    return names


if __name__ == "__main__":
    register_omnisafe()
    import_module("omnisafe.utils.command_app").app()
