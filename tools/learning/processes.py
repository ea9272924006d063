"""Learning next to acting: actors in forks simulate episodes, or gradient steps run in a second process."""

from __future__ import annotations

import copy
import multiprocessing
import os
import signal
import threading
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import torch
from stable_baselines3.common.utils import set_random_seed

from guiderail.models.common.errors import InputError, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Callback, Transition, has_image
from guiderail.tools.evaluation.forks import Forks, KilledError, can_fork
from guiderail.tools.evaluation.rollout import new_columns, rollout
from guiderail.tools.evaluation.step_log import write_step_log
from guiderail.tools.learning.checkpoint import entries_of, load_module, module_arrays, restore_modules
from guiderail.tools.learning.environment_set import select_environment
from guiderail.tools.learning.episodes import Episodes
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.off_policy import OffPolicyLearner

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


class PipelinedLearner(Learner):
    """Learner that acts in this process while a second process trains on the previous episode.

    Episode k uses the weights learned from the episodes before k − 1, so training on an episode may take as
    long as an episode. With `waits`, an episode waits for these weights, so that the same seed gives the same run
    whatever the durations. Without `waits`, an episode starts at once with the newest weights.

    Exploration and checkpoint selection stay in this process; the second process only trains.

    Attributes:
        known: Number of the submitted episodes that the current weights were learned from.
        submitted: Number of episodes submitted since construction; after a resumption it begins with 0 again.
        late: Number of episodes that began before the weights planned for them were learned.
    """

    def __init__(
        self,
        acting: Learner,
        arguments: tuple[tuple[Any, ...], dict[str, Any]],
        *,
        waits: bool,
        excluded: tuple[str, ...] = (),
        niceness: int = 0,
        imports: Sequence[str] = (),
    ):
        """Start the training process.

        Args:
            acting: Learner that acts; its weights are replaced as they are learned.
            arguments: Positional and keyword arguments of the learner in the training process, configuration first.
            waits: True to wait at the start of an episode until its weights are learned, as described above.
            excluded: Terminations of the episodes that are excluded from training.
            niceness: Niceness of the training process.
            imports: Modules, files (.py) or task folders that the training process imports, such as a module that
                registers the learner.
        """
        if not isinstance(acting, OffPolicyLearner):
            raise InputError("only an off-policy learner can be pipelined: choose tqc, sac, td3 or crossq")
        self._acting, self._waits, self._excluded = acting, waits, excluded
        self._transitions: list[Transition] = []
        self._pending: list[Transition] | None = None  # a finished episode that is not submitted yet
        self._metrics: dict[str, float] = {}
        self.known = self.submitted = self.late = 0
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])  # the fork server imports this module once for all runs of a study
        self._pipe, child_pipe = context.Pipe()
        child_arguments = (child_pipe, niceness, tuple(imports), *arguments)
        self._process = context.Process(target=_serve, args=child_arguments, daemon=True)
        self._process.start()
        child_pipe.close()

    def warm_up(self) -> None:
        """Run every code path of acting in advance: first calls would miss the control deadline of a robot."""
        space = self._acting.model.observation_space
        observation = np.zeros(space.shape, space.dtype)
        for _ in range(3):
            self._acting.explore(observation)
            tensor = self._acting.model.policy.obs_to_tensor(observation)[0]
            self._acting.actor()._predict(tensor, deterministic=True)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action (A,) of the acting learner."""
        return self._acting.act(observation)

    def on_episode_start(self) -> None:
        """Start an episode with the newest weights; with `waits`, first wait for the weights of this episode."""
        required = self.submitted - 1
        while self.known < required and self._waits:
            self._receive_weights()
        while not self._waits and self._pipe.poll():
            self._receive_weights()
        self.late += self.known < required
        self._transitions = []
        self._exploration_state = self._acting.random.bit_generator.state
        self._acting.on_episode_start()

    def on_step(self, transition: Transition) -> None:
        """Buffer a transition until the episode ends, because the episode may be excluded from learning."""
        self._acting.transitions += record_transition(self._transitions, transition)

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """End an episode; an excluded episode does not count and does not advance the acting learner's `random`."""
        if row["termination"] in self._excluded:
            self._acting.transitions -= len(self._transitions)
            self._acting.episodes -= 1
            self._acting.exclude_episode()
            self._acting.random.bit_generator.state = self._exploration_state
        else:
            self._acting.on_episode_end(row)
            self._pending = self._transitions
        return {}

    def submit_episode(self) -> None:
        """Send the finished episode to the training process, unless it was excluded."""
        if self._pending is not None:
            self._send(("learn", self._pending, self.records_metrics))
            self._pending = None
            self.submitted += 1

    def receive_learned(self) -> bool:
        """Receive the weights learned so far without waiting; return True if all submitted episodes are learned."""
        while self.known < self.submitted and self._pipe.poll():
            self._receive_weights()
        return self.known == self.submitted

    def write(self, path: Path, table: pa.Table) -> None:
        """Write a step log in the training process; if writing fails, a later call raises the error."""
        self._send(("write", path, table))

    def finish(self) -> None:
        """Block until everything is learned and written, and end the training process."""
        self.submit_episode()
        while self.known < self.submitted:
            self._receive_weights()
        self._send(("end",))
        self._process.join()
        with suppress(EOFError, ConnectionError):
            answer = self._pipe.recv()
            if isinstance(answer, InputError):
                raise answer

    def close(self) -> None:
        """Terminate the training process."""
        self._process.terminate()
        self._process.join()

    def metrics(self) -> Mapping[str, float]:
        """Return the metrics that the training process recorded for the newest weights."""
        metrics, self._metrics = self._metrics, {}
        return metrics

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the policy of the acting learner; the entries of `description` are added to its description."""
        return self._acting.policy(description)

    def has_diverged(self) -> bool:
        """Return True if a parameter of the acting learner's actor network is NaN or infinite."""
        return self._acting.has_diverged()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state of both learners and the pending episode; call it before `submit_episode`."""
        while self.known < self.submitted:
            self._receive_weights()
        self._send(("state",))
        learned_arrays, learned_values = self._receive()
        arrays, values = self._acting.state()
        pending = self._pending or []
        stored = {
            f"pending/{name}": np.array([getattr(transition, name) for transition in pending])
            for name in _STORED
            if pending and getattr(pending[0], name) is not None
        }
        stored |= {f"acting/{name}": array for name, array in arrays.items()}
        stored |= {f"learning/{name}": array for name, array in learned_arrays.items()}
        return stored, {"acting": values, "learning": learned_values}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`, and submit the pending episode.

        Raises:
            KeyError: If an entry is missing.
            RuntimeError, ValueError: If the state does not fit this learner.
        """
        self._acting.restore(entries_of(arrays, "acting"), values["acting"])
        self._send(("restore", entries_of(arrays, "learning"), values["learning"]))
        if (message := self._receive()) is not None:
            raise ValueError(message)
        if columns := entries_of(arrays, "pending"):
            rows = zip(*columns.values(), strict=True)
            self._pending = [Transition(**dict(zip(columns, row, strict=True)), info={}) for row in rows]
        self.submit_episode()

    def _send(self, message: tuple[Any, ...]) -> None:
        try:
            self._pipe.send(message)
        except (BrokenPipeError, ConnectionError):
            raise _process_ended_error() from None

    def _receive(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise _process_ended_error() from None
        if isinstance(answer, InputError):
            raise answer
        return answer

    def _receive_weights(self) -> None:
        weights, self._metrics = self._receive()
        load_weights(self._acting, weights)
        self.known += 1


# Fields of a transition that a learner uses.
_STORED = (
    "observation", "action", "reward", "next_observation", "terminated", "truncated", "privileged", "next_privileged",
)  # fmt: skip


def _process_ended_error() -> InputError:
    return InputError("the training process has ended: resume from the last checkpoint, if there is one")


def _serve(
    pipe: Connection, niceness: int, imports: tuple[str, ...], arguments: tuple[Any, ...], keywords: dict[str, Any]
) -> None:
    """Run the training process: answer requests until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both processes; the acting one handles it
    os.nice(niceness)
    torch.set_num_threads(1)
    requests: SimpleQueue[tuple[Any, ...]] = SimpleQueue()
    # A thread reads requests immediately: two processes writing to full pipes would deadlock, and a robot cannot wait.
    threading.Thread(target=_read, args=(pipe, requests), daemon=True).start()
    if imports:
        from guiderail.tools.imports import import_modules  # imports Drake, which takes a second

        import_modules(imports)
    learner: Any = LEARNERS.get(arguments[0].algorithm)(*arguments, **keywords)
    is_packaged = LEARNERS.is_packaged(arguments[0].algorithm)  # an error of a user's learner becomes an InputError
    while (message := requests.get()) != ("end",):
        name, *values = message
        try:
            with nullcontext() if is_packaged else naming_failures(f"{type(learner).__name__} in the training process"):
                answer = _HANDLERS[name](learner, *values)
        except InputError as error:
            answer = error
        try:
            if answer is not _NO_ANSWER:
                pipe.send(answer)
        except (BrokenPipeError, ConnectionError):
            return


def _read(pipe: Connection, requests: SimpleQueue[tuple[Any, ...]]) -> None:
    try:
        while True:
            requests.put(pipe.recv())
    except (EOFError, ConnectionError):
        requests.put(("end",))


_NO_ANSWER = object()


def _learn(
    learner: OffPolicyLearner, transitions: list[Transition], records_metrics: bool
) -> tuple[Weights, Mapping[str, float]]:
    learner.records_metrics = records_metrics
    for transition in transitions:
        learner.on_step(transition)
    return copy_weights(learner), learner.metrics()


def _restore(learner: OffPolicyLearner, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> str | None:
    try:
        learner.restore(arrays, values)
    except (KeyError, ValueError, RuntimeError, IndexError, TypeError) as error:
        return str(error)
    return None


def _write(learner: OffPolicyLearner, path: Path, table: pa.Table) -> object:
    write_step_log(path, table)
    return _NO_ANSWER


_HANDLERS: dict[str, Any] = {
    "learn": _learn,
    "state": lambda learner: learner.state(),
    "restore": _restore,
    "write": _write,
}
