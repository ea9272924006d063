"""Learning beside acting: gradient steps in a process of their own, while the next episode goes on in this one."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import torch

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.rollout import Transition
from guiderail.tools.evaluation.step_log import write_step_log
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.off_policy import OffPolicyLearner

Weights = dict[str, dict[str, np.ndarray]]


class PipelinedLearner(Learner):
    """Acts, and hands over each episode to another process, which learns from it during the next one.

    In episode k it acts with what was learned from the episodes before k − 1: then the learning of one episode has the
    time of a whole one. With `waits` that is exactly so, whatever takes how long, so that the same seed gives the same
    run. Without, nobody is waited for: where learning is late, an episode begins with what there is.

    What explores, and which actor is selected, is decided here; the other process only learns.

    Attributes:
        known: how many episodes the present policy was learned from.
        given: how many were handed over.
        late: how often an episode began before what it should have known was learned.
    """

    def __init__(
        self,
        acting: Learner,
        arguments: tuple[tuple[Any, ...], dict[str, Any]],
        *,
        waits: bool,
        leaves_out: tuple[str, ...] = (),
        niceness: int = 0,
        imports: Sequence[str] = (),
    ):
        """
        Args:
            acting: who acts; its networks are replaced as they are learned.
            arguments: of another one of its kind, positional and by name, that learns; the first is its preset.
            waits: whether an episode begins only when what it should know was learned.
            leaves_out: terminations of episodes that are not learned from.
            niceness: of the other process.
            imports: modules or files (.py) that register what is not installed, such as the learner.

        Raises:
            InputError: if the learner is of another kind.
        """
        if not isinstance(acting, OffPolicyLearner):
            raise InputError("only an off-policy learner can learn in a process of its own: choose sac or tqc")
        self._acting, self._waits, self._leaves_out = acting, waits, leaves_out
        self._decisions: list[Transition] = []
        self._pending: list[Transition] | None = None  # of an episode that is over and not handed over yet
        self.known = self.given = self.late = 0
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])  # a study imports once, not for every run
        self._pipe, other = context.Pipe()
        told = (other, niceness, tuple(imports), *arguments)
        self._process = context.Process(target=_learn, args=told, daemon=True)
        self._process.start()
        other.close()

    def warm_up(self) -> None:
        """Whatever is called for the first time takes longer than a robot waits."""
        space = self._acting.model.observation_space
        nothing = np.zeros(space.shape, space.dtype)
        for _ in range(3):
            self._acting.explore(nothing)
            tensor = self._acting.model.policy.obs_to_tensor(nothing)[0]
            self._acting.actor()._predict(tensor, deterministic=True)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """As the learner acts."""
        return self._acting.act(observation)

    def on_episode_start(self) -> None:
        """Begins an episode with what was learned until now."""
        behind = self.given - 1
        while self.known < behind and self._waits:
            self._take(self._receive())
        while not self._waits and self._pipe.poll():
            self._take(self._receive())
        self.late += self.known < behind
        self._decisions = []
        self._drawn = self._acting.random.bit_generator.state
        self._acting.on_episode_start()

    def on_step(self, decision: Transition) -> None:
        """Keeps a decision until it is known whether the episode is learned from.

        Where the simulation failed nothing followed: what came before is then the episode's last, as at a time limit.
        """
        if "simulation_failure" in decision.info:
            if self._decisions:
                self._decisions[-1] = replace(self._decisions[-1], truncated=True)
            return
        self._decisions.append(replace(decision, info={}))
        self._acting.decisions += 1

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Ends an episode. One that is left out leaves no trace in what explores."""
        if row["termination"] in self._leaves_out:
            self._acting.decisions -= len(self._decisions)
            self._acting.episodes -= 1
            self._acting.leave_out()
            self._acting.random.bit_generator.state = self._drawn
        else:
            self._acting.on_episode_end(row)
            self._pending = self._decisions
        return {}

    def submit_episode(self) -> None:
        """Has the last episode learned from, where it is one to learn from."""
        if self._pending is not None:
            self._send(("learn", self._pending))
            self._pending = None
            self.given += 1

    def write(self, path: Path, table: pa.Table) -> None:
        """Has a step log written there by the other process; what comes in its way is raised by what asks it next."""
        self._send(("write", path, table))

    def finish(self) -> None:
        """Waits until everything is learned and written, and ends the other process."""
        self.submit_episode()
        while self.known < self.given:
            self._take(self._receive())
        self._send(("end",))
        self._process.join()
        with suppress(EOFError, ConnectionError):
            refused = self._pipe.recv()
            if isinstance(refused, InputError):
                raise refused

    def close(self) -> None:
        """Ends the other process, whatever it does."""
        self._process.terminate()
        self._process.join()

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Of who acts."""
        return self._acting.policy(description)

    def has_diverged(self) -> bool:
        """Of who acts."""
        return self._acting.has_diverged()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Of both, and the episode that is to be learned from; to be asked for before it is handed over."""
        while self.known < self.given:
            self._take(self._receive())
        self._send(("state",))
        learned, known = self._receive()
        arrays, values = self._acting.state()
        pending = self._pending or []
        kept = {f"pending/{name}": np.array([getattr(one, name) for one in pending]) for name in _KEPT if pending}
        both = {f"acting/{k}": v for k, v in arrays.items()} | {f"learning/{k}": v for k, v in learned.items()}
        return both | kept, {"acting": values, "learning": known}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Becomes what it was, and hands the last episode over."""
        of = {
            part: {key[len(part) + 1 :]: value for key, value in arrays.items() if key.startswith(part + "/")}
            for part in ("acting", "learning", "pending")
        }
        self._acting.restore(of["acting"], values["acting"])
        self._send(("restore", of["learning"], values["learning"]))
        if (wrong := self._receive()) is not None:
            raise ValueError(wrong)
        if of["pending"]:
            columns = [of["pending"][name] for name in _KEPT]
            self._pending = [
                Transition(**dict(zip(_KEPT, one, strict=True)), info={}) for one in zip(*columns, strict=True)
            ]
        self.submit_episode()

    def _send(self, message: tuple[Any, ...]) -> None:
        try:
            self._pipe.send(message)
        except (BrokenPipeError, ConnectionError):
            raise _ended() from None

    def _receive(self) -> Any:
        try:
            answer = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise _ended() from None
        if isinstance(answer, InputError):
            raise answer
        return answer

    def _take(self, learned: Weights) -> None:
        _load(self._acting, learned)
        self.known += 1


# What a learner takes from a decision, in the order of its fields.
_KEPT = ("observation", "action", "reward", "following", "terminated", "truncated")


class SpacesOnlyEnv(gymnasium.Env):
    """Of an environment, for another process."""

    def __init__(self, env: gymnasium.Env):
        """
        Args:
            env: the environment.
        """
        self.observation_space, self.action_space = env.observation_space, env.action_space


def _ended() -> InputError:
    return InputError("the process that learns has ended: go on from the last checkpoint, where there is one")


def _modules(learner: OffPolicyLearner) -> dict[str, Any]:
    modules = {"actor": learner.model.actor}
    return modules if learner.averaged is None else modules | {"averaged": learner.averaged}


def _load(learner: OffPolicyLearner, weights: Weights) -> None:
    for name, module in _modules(learner).items():
        module.load_state_dict({key: torch.from_numpy(value) for key, value in weights[name].items()})


def _weights(learner: OffPolicyLearner) -> Weights:
    return {
        name: {key: value.detach().numpy().copy() for key, value in module.state_dict().items()}
        for name, module in _modules(learner).items()
    }


def _learn(
    pipe: Connection, niceness: int, imports: tuple[str, ...], given: tuple[Any, ...], named: dict[str, Any]
) -> None:
    """The other process: learns, and writes what takes long, until nobody is at the pipe's other end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: whoever acts decides what comes of it
    os.nice(niceness)
    torch.set_num_threads(1)
    asked: SimpleQueue[tuple[Any, ...]] = SimpleQueue()
    # Always read: two that write into a full pipe wait for each other, and a robot waits for nobody.
    threading.Thread(target=_read, args=(pipe, asked), daemon=True).start()
    if imports:
        from guiderail.tools.environments import import_modules  # Drake takes a second

        import_modules(imports)
    learner: Any = LEARNERS.get(given[0].algorithm)(*given, **named)
    while (message := asked.get()) != ("end",):
        what, *rest = message
        try:
            if (answer := _ANSWERS[what](learner, *rest)) is not _NOTHING:
                pipe.send(answer)
        except (BrokenPipeError, ConnectionError):
            return


def _read(pipe: Connection, asked: SimpleQueue[tuple[Any, ...]]) -> None:
    try:
        while True:
            asked.put(pipe.recv())
    except (EOFError, ConnectionError):
        asked.put(("end",))


_NOTHING = object()


def _learned(learner: OffPolicyLearner, decisions: list[Transition]) -> Weights | InputError:
    try:
        for decision in decisions:
            learner.on_step(decision)
    except InputError as error:
        return error
    return _weights(learner)


def _restored(learner: OffPolicyLearner, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> str | None:
    try:
        learner.restore(arrays, values)
    except (KeyError, ValueError, RuntimeError, IndexError, TypeError) as error:
        return str(error)
    return None


def _written(learner: OffPolicyLearner, path: Path, table: pa.Table) -> object:
    try:
        write_step_log(path, table)
    except InputError as error:
        return error
    return _NOTHING


_ANSWERS: dict[str, Any] = {
    "learn": _learned,
    "state": lambda learner: learner.state(),
    "restore": _restored,
    "write": _written,
}
