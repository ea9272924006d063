"""Episodes that a run learns from: where they are simulated, and which policy acts in them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.utils import set_random_seed

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.episode import Callback, PolicyFn, Transition, has_image
from guiderail.tools.evaluation.forks import Forks, KilledError, can_fork
from guiderail.tools.evaluation.policies import check_compatible
from guiderail.tools.evaluation.rollout import new_columns, rollout
from guiderail.tools.learning.checkpoint import entries_of, load_module, module_arrays, restore_modules
from guiderail.tools.learning.environment_set import EnvironmentSet, select_environment
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.off_policy import OffPolicyLearner
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


Weights = dict[str, np.ndarray]  # parameters and buffers of the modules that a learner acts with, as MODULE/NAME


class Snapshot(NamedTuple):
    """State of a learner that an actor needs."""

    weights: Weights
    transitions: int  # number of transitions that the learner has learned from
    greedy_successes: int  # number of consecutive successes in greedy episodes


class SimulatedEpisode(NamedTuple):
    """Episode that an actor simulated."""

    number: int
    row: dict[str, Any]  # row in the table of the run
    transitions: list[Transition]
    is_greedy: bool  # True if the learner acted without exploration


class ActorEpisodes(Episodes):
    """Episodes that N actors, which are forks of this process, simulate while this process learns.

    Episode k uses the weights learned from the first k − N episodes, in their order; its random numbers depend only on
    the seed and k. The result of a run therefore depends on N but not on the timing of the processes; the conditions of
    episode k do not depend on N. With N = 1, an episode is simulated while the learner learns from the previous one.
    """

    def __init__(self, episodes: Episodes, learner: Learner):
        """Construct the episodes in the environment of `episodes`, which was reset; the first one starts the actors."""
        super().__init__(episodes.config, episodes.env, episodes.demonstrator)
        if not isinstance(learner, OffPolicyLearner):
            raise InputError("only an off-policy learner has parallel actors: choose tqc, sac, td3 or crossq")
        if not can_fork():
            raise InputError("parallel actors are forks, which this process cannot create: leave num_envs out")
        if has_image(self.env.observation_space):
            raise InputError("parallel actors are forks, which cannot render images: leave num_envs out")
        self._learner, self._num_envs = learner, self.config.learner.num_envs
        self._callbacks: tuple[Callback, ...] = ()  # they run in the actors' processes
        self._forks: Forks | None = None
        self._learned = self._assigned = 0  # numbers of episodes learned from and assigned
        self._simulated: dict[int, SimulatedEpisode] = {}
        self._snapshots = {0: _snapshot(learner)}  # by the number of episodes learned from
        self._earlier_episodes = 0  # episodes of the run that `init_from` names

    def run(self, learner: Learner, *callbacks: Callback, index: int) -> dict[str, Any]:
        """Learn from episode `index`, which must be the next one, and return its row."""
        if self._forks is None:
            self._callbacks, self._earlier_episodes = callbacks, self._learner.episodes - index
            self._forks = Forks(self._simulate, min(self._num_envs, self.config.episodes - index))
        try:
            return self._learn(index)
        except KilledError:
            raise InputError("an actor was killed: resume the run, which continues from its last checkpoint") from None

    def _learn(self, index: int) -> dict[str, Any]:
        while index not in self._simulated:
            self._exchange(None)
        learner, episode = self._learner, self._simulated.pop(index)
        weights, actor = self._snapshots[self._required(index)].weights, copy.deepcopy(learner.actor())
        load_module(actor, entries_of(weights, "averaged") or entries_of(weights, "actor"))
        learner.start_recorded(episode.is_greedy, actor)
        for transition in episode.transitions:
            learner.on_step(transition)
            self._exchange(0.0)  # an idle actor must not wait until the whole episode is learned
        row = {**episode.row, **new_columns(learner, episode.row)}
        self._learned += 1
        self._snapshots[self._learned] = _snapshot(learner)
        oldest = self._required(self._learned)
        self._snapshots = {number: snapshot for number, snapshot in self._snapshots.items() if number >= oldest}
        self._exchange(0.0)
        return row

    def _required(self, index: int) -> int:
        """Return the number of episodes that the weights for episode `index` are learned from."""
        return max(0, index - self._num_envs)

    def _exchange(self, timeout: float | None) -> None:
        """Assign episodes to idle actors and collect simulated ones; wait at most `timeout` [s], forever if None."""
        assert self._forks is not None
        while self._forks.has_idle and self._assigned < self.config.episodes:
            if (required := self._required(self._assigned)) > self._learned:
                break
            self._forks.submit((self._assigned, self._snapshots[required]))
            self._assigned += 1
        for episode in self._forks.collect(timeout):
            self._simulated[episode.number] = episode

    def _simulate(self, assignment: tuple[int, Snapshot]) -> SimulatedEpisode:
        """Simulate an episode; called in a fork."""
        (index, snapshot), learner = assignment, self._learner
        conditions, exploration, process = np.random.SeedSequence([self.config.seed, index]).spawn(3)
        select_environment(self.env, index)
        self.env.unwrapped.np_random = np.random.default_rng(conditions)
        learner.random = np.random.default_rng(exploration)
        set_random_seed(int(process.generate_state(1)[0]))  # global generators, which Stable-Baselines3 uses
        load_weights(learner, snapshot.weights)
        learner.episodes, learner.transitions = self._earlier_episodes + index, snapshot.transitions
        learner.greedy_successes, learner.selection = snapshot.greedy_successes, None
        recorder = _EpisodeRecorder(learner)
        row = rollout(self.env, self.policy(learner, index), recorder, *self._callbacks, index=index)
        return SimulatedEpisode(index, row, recorder.transitions, learner.is_greedy)

    def end(self) -> None:
        """End the actors, and discard the episodes that they simulated ahead."""
        if self._forks is not None:
            self._forks.close()
            self._forks = None

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the snapshots that the next episodes use."""
        arrays = {
            f"{number}/{name}": array
            for number, snapshot in self._snapshots.items()
            for name, array in snapshot.weights.items()
        }
        return arrays, {str(number): counts for number, (_, *counts) in self._snapshots.items()}

    def restore(self, rows: list[dict[str, Any]], arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; episodes simulated ahead of the checkpoint are simulated again."""
        self._snapshots = {int(k): Snapshot(entries_of(arrays, k), *counts) for k, counts in values.items()}
        self._learned = self._assigned = len(rows)


class _EpisodeRecorder(Callback):
    """Callback that records an episode's transitions and starts the episode of the acting learner."""

    def __init__(self, learner: OffPolicyLearner):
        self._learner = learner
        self.transitions: list[Transition] = []

    def on_episode_start(self) -> None:
        self._learner.on_episode_start()

    def on_step(self, transition: Transition) -> None:
        record_transition(self.transitions, transition)


def record_transition(transitions: list[Transition], transition: Transition) -> bool:
    """Append a transition without its `info`; return False if the simulation failed and nothing was appended.

    If the simulation fails, the episode ends with the transition before the failure, as at a time limit.
    """
    if "simulation_failure" in transition.info:
        if transitions:
            transitions[-1] = replace(transitions[-1], truncated=True)
        return False
    transitions.append(replace(transition, info={}))
    return True


def _modules(learner: OffPolicyLearner) -> dict[str, Any]:
    modules = {"actor": learner.model.actor}
    return modules if learner.averaged is None else modules | {"averaged": learner.averaged}


def copy_weights(learner: OffPolicyLearner) -> Weights:
    """Return a copy of the weights that a learner acts with."""
    return {name: array.copy() for name, array in module_arrays(_modules(learner), {}).items()}


def load_weights(learner: OffPolicyLearner, weights: Weights) -> None:
    """Set the weights that a learner acts with."""
    restore_modules(weights, _modules(learner), {})


def _snapshot(learner: OffPolicyLearner) -> Snapshot:
    return Snapshot(copy_weights(learner), learner.transitions, learner.greedy_successes)
