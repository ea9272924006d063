"""Callbacks of Stable-Baselines3 in a training run of this package."""

from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from guiderail.models.common.errors import InputError, brief
from guiderail.tools.evaluation.rollout import Callback, Transition
from guiderail.tools.learning.learner import Learner


class Sb3Callbacks(Callback):
    """Callback of an episode that calls callbacks of Stable-Baselines3.

    The callbacks receive the learner's `model`, an algorithm of Stable-Baselines3. `num_timesteps` counts the run's
    transitions, including those before it was resumed, and `locals` has the names `infos`, `rewards`, `dones`,
    `actions` and `new_obs`, with values of one environment.

    Attributes:
        is_stopped: True once a callback returned False from `on_step`; training ends after the episode.
    """

    def __init__(self, callbacks: Any, learner: Learner):
        """Construct the callback for one or several callbacks of Stable-Baselines3.

        Raises:
            InputError: If the learner has no model of Stable-Baselines3, or a callback is not a `BaseCallback`.
        """
        model = getattr(learner, "model", None)
        if model is None:
            raise InputError(
                f"callbacks of Stable-Baselines3 need one of its models, and {type(learner).__name__} has none"
            )
        callback_list = list(callbacks) if isinstance(callbacks, list | tuple) else [callbacks]
        for one in callback_list:
            if not isinstance(one, BaseCallback):
                raise InputError(f"{brief(one)} is no callback: give those of Stable-Baselines3 (BaseCallback)")
        self._model, self._callback, self._is_started = model, CallbackList(callback_list), False
        self._learner, self._first = learner, getattr(learner, "transitions", 0)  # those of `init_from` do not count
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
