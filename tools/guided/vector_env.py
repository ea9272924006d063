"""Several guided environments in one process, whose predictions are computed in batches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from guiderail.models.common.errors import InputError
from guiderail.tools.guided.env import GuidedEnv
from guiderail.tools.guided.guide import predict


class GuidedVectorEnv(SyncVectorEnv):
    """Vector environment of `GuidedEnv`s that share their guidance; an environment behaves as it does alone.

    The guidance is fitted once, and the predictions of all environments at a control step are `LcNsKmp.predict_batch`.
    An environment is reset in the step after the end of its episode (`AutoresetMode.NEXT_STEP`).

    Args:
        env_fns: Functions that return the environments to wrap, at least one.
        **keywords: Keywords of `GuidedEnv`.

    Raises:
        InputError: As `GuidedEnv`.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gymnasium.Env[Any, Any]]], **keywords: Any):
        if not env_fns:
            raise InputError("a vector environment needs at least one environment")
        first = GuidedEnv(env_fns[0](), **keywords)

        def wrap(make: Callable[[], gymnasium.Env[Any, Any]]) -> Callable[[], gymnasium.Env[Any, Any]]:
            return lambda: GuidedEnv(make(), **{**keywords, "guidance": first.guide.copy()})

        super().__init__([lambda: first, *map(wrap, env_fns[1:])], autoreset_mode=AutoresetMode.NEXT_STEP)

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply actions (B, A); return observations, rewards (B,), terminations (B,), truncations (B,) and infos."""
        stepped = [i for i in range(self.num_envs) if not self._autoreset_envs[i]]
        guided: list[Any] = [self.envs[i] for i in stepped]
        for env, i in zip(guided, stepped, strict=True):
            env.begin_action(actions[i])
        while active := [env for env in guided if not env.is_action_complete]:
            for env, output in zip(active, _predict_batch([env.request() for env in active]), strict=True):
                env.advance(output)
        results = {i: env.end_action() for env, i in zip(guided, stepped, strict=True)}
        infos: dict[str, Any] = {}
        for i, one in enumerate(self.envs):
            if i in results:
                self._env_obs[i], self._rewards[i], self._terminations[i], self._truncations[i], info = results[i]
            else:
                self._env_obs[i], info = one.reset()
                self._rewards[i], self._terminations[i], self._truncations[i] = 0.0, False, False
            infos = self._add_info(infos, info, i)
        self._observations = gymnasium.vector.utils.concatenate(
            self.single_observation_space, self._env_obs, self._observations
        )
        self._autoreset_envs = np.logical_or(self._terminations, self._truncations)
        copied = self._observations if not self.copy else _copied(self._observations)
        return copied, np.copy(self._rewards), np.copy(self._terminations), np.copy(self._truncations), infos


def _copied(observations: Any) -> Any:
    from copy import deepcopy

    return deepcopy(observations)


def _predict_batch(requests: list[Any]) -> list[np.ndarray | None]:
    """Return the outputs of predictions, those of one primitive in a batch; None without a request or a solution."""
    groups: dict[int, list[int]] = defaultdict(list)
    outputs: list[np.ndarray | None] = [None] * len(requests)
    for i, request in enumerate(requests):
        if request is not None:
            groups[id(request[0])].append(i)
    for rows in groups.values():
        if len(rows) == 1:
            outputs[rows[0]] = predict(requests[rows[0]])
            continue
        primitive, _, _, history = requests[rows[0]]
        _, steps, raw, histories = zip(*(requests[i] for i in rows), strict=True)
        batch = primitive.predict_batch(steps, np.array(raw), None if history is None else np.array(histories))
        for i, output, is_solved in zip(rows, batch.outputs, batch.is_solved, strict=True):
            outputs[i] = output if is_solved else None
    return outputs
