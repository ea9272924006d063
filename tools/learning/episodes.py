"""Episodes that a run learns from: where they are simulated, and which policy acts in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.episode import Callback, PolicyFn, Transition
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.environment_set import EnvironmentSet
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.pretrained import find_run

Demonstrator = Callable[[gymnasium.Env], PolicyFn]
"""Function from an environment to the policy of a demonstrator."""


def make_demonstrator(config: RunConfig) -> Demonstrator | None:
    """Return the demonstrator of a run: the policy that `demonstrator` names, by default each task's scripted policy.

    Returns:
        The demonstrator; None if there are no demonstration episodes.

    Raises:
        InputError: If the policy cannot be read, or a task has no scripted policy.
    """
    learner = config.learner
    if not learner.demonstration_episodes:
        return None
    if learner.demonstrator:
        folder = RunFolder(find_run(learner.demonstrator))
        return partial(check_compatible, Policy.load(folder.path), learned_in=folder.config().environment)
    makers = {member.name: make_baseline(member.task, "scripted") for member in config.members}
    if not makers:
        return make_baseline(config.task, "scripted")
    return lambda env: makers[cast("EnvironmentSet", env.unwrapped).current](env)


class Episodes:
    """Episodes of a run, one after another in one environment; subclasses run them in forks, or with a supervisor.

    Attributes:
        env: Environment of the next episode.
        config: Configuration of the run, which a supervisor's corrections change.
        demonstrator: Demonstrator of the learner's `demonstration_episodes`, or None.
        is_real_time: True on a robot: every episode ends with a checkpoint, and the episodes write their step log.
    """

    is_real_time = False

    def __init__(self, config: RunConfig, env: gymnasium.Env, demonstrator: Demonstrator | None = None):
        self.config, self.env, self.demonstrator = config, env, demonstrator

    def policy(self, learner: Learner, index: int) -> PolicyFn:
        """Return the policy of an episode: a demonstrator in the first episodes, otherwise the learner."""
        if self.demonstrator is not None and index < self.config.learner.demonstration_episodes:
            return self.demonstrator(self.env)
        if LEARNERS.is_packaged(self.config.learner.algorithm):
            return learner.act

        def act(observation: np.ndarray) -> np.ndarray:
            with naming_failures(f"{type(learner).__name__}.act"):
                return learner.act(observation)

        return act

    def run(self, learner: Learner, *callbacks: Callback, index: int) -> dict[str, Any]:
        """Run an episode that the learner learns from; return its row."""
        return rollout(self.env, self.policy(learner, index), learner, *callbacks, index=index)

    def saving_steps(
        self, checkpoint: Callable[[], None], table: Callable[[], None], submit: Callable[[], None]
    ) -> list[Callable[[], None]]:
        """Return the steps after an episode with a checkpoint, in their order; `idle` is called after each."""
        return [checkpoint, table, submit]

    def idle(self) -> None:
        """Do what is due between two steps of saving."""

    def end_episode(self) -> None:
        """Do what is due after an episode has been saved."""

    def end(self) -> None:
        """End the episodes, before the learner finishes."""

    def close(self) -> None:
        """Release the environment; called even if training fails."""
        self.env.close()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from, as `Learner.state`."""
        return {}, {}

    def restore(self, rows: list[dict[str, Any]], arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`, after the episodes with the given rows."""


Supervise = Callable[[RunConfig], Episodes]
"""Function that starts the episodes of a run that a supervisor corrects."""


class Sb3Callbacks(Callback):
    """Adapter that calls callbacks of Stable-Baselines3 in the episodes of a run.

    The callbacks receive the learner's `model`, an algorithm of Stable-Baselines3. `num_timesteps` counts the run's
    transitions, including those before it was resumed. `locals` has the entries `infos`, `rewards`, `dones`, `actions`
    and `new_obs`, each of length 1 as for one environment.

    Attributes:
        is_stopped: True once a callback returned False from `on_step`; training ends after the episode.
    """

    def __init__(self, callbacks: Any, learner: Learner):
        """Construct the adapter for one or several callbacks of Stable-Baselines3."""
        model = getattr(learner, "model", None)
        if model is None:
            raise InputError(f"{type(learner).__name__} has no Stable-Baselines3 model, which its callbacks need")
        callback_list = list(callbacks) if isinstance(callbacks, list | tuple) else [callbacks]
        for callback in callback_list:
            if not isinstance(callback, BaseCallback):
                raise InputError(f"{brief(callback)} is no callback of Stable-Baselines3: derive it from BaseCallback")
        self._model, self._callback, self._is_started = model, CallbackList(callback_list), False
        # Transitions of the run that `init_from` names are not counted.
        self._learner, self._first = learner, getattr(learner, "transitions", 0)
        self.is_stopped = False

    def on_episode_start(self) -> None:
        """Report the start of training before the first episode, and the start of a rollout in each episode."""
        if not self._is_started:
            self._model.num_timesteps = getattr(self._learner, "transitions", 0) - self._first
            self._callback.init_callback(self._model)
            self._callback.on_training_start({"self": self._model}, {})
            self._is_started = True
        self._callback.on_rollout_start()

    def on_step(self, transition: Transition) -> None:
        """Call `on_step` of the callbacks."""
        self._model.num_timesteps += 1
        self._callback.update_locals(
            {
                "infos": [dict(transition.info)],
                "rewards": [transition.reward],
                "dones": [transition.is_last],
                "actions": [transition.action],
                "new_obs": transition.next_observation[None],
            }
        )
        self.is_stopped = not self._callback.on_step() or self.is_stopped

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Report the end of the rollout."""
        self._callback.on_rollout_end()
        return {}

    def close(self) -> None:
        """Report the end of training."""
        if self._is_started:
            self._callback.on_training_end()
