"""Learning while a robot moves: gradient steps in a process of their own, for which nobody waits."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from guiderail.models.errors import InputError
from guiderail.tools.learning.off_policy import OffPolicyLearner
from guiderail.tools.operate.company import end_with_parent
from guiderail.tools.rollouts.rollout import Decision, Observer

NICENESS = 5  # of the gradient steps, beside whoever has to be in time


class Student(Observer):
    """Acts, and hands over each sound episode to another process, which learns from it during the next ones.

    In episode k it acts with what was learned from the episodes before k − 1: then the learning of one episode has the
    time of a whole one. Where that is not enough the robot waits for nobody and acts with what there is, unless it must
    give the same again.

    Attributes:
        known: how many sound episodes the present policy was learned from.
        given: how many were handed over.
        late: how often an episode began before what it should have known was learned.
    """

    def __init__(self, acting: OffPolicyLearner, arguments: tuple[Any, dict[str, Any]], *, waits: bool):
        """
        Args:
            acting: who acts; its networks are replaced as they are learned.
            arguments: of another one of its kind, positional and by name, that learns.
            waits: whether an episode begins only when what it should know was learned.

        Raises:
            InputError: if the learner is of another kind.
        """
        if not isinstance(acting, OffPolicyLearner):
            raise InputError("only an off-policy learner can learn beside a robot: choose sac or tqc")
        self._acting, self._waits = acting, waits
        self._decisions: list[Decision] = []
        self.known = self.given = self.late = 0
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_learn, args=(other, type(acting), *arguments), daemon=True)
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

    def begin(self) -> None:
        """Begins an episode with what was learned until now."""
        behind = self.given - 1
        while self.known < behind and self._waits:
            self._take(self._receive())
        while self._pipe.poll() and (not self._waits or self.known < behind):
            self._take(self._receive())
        self.late += self.known < behind
        self._decisions = []
        self._acting.begin()

    def see(self, decision: Decision) -> None:
        """Keeps a decision until it is known whether the episode is sound."""
        without = Decision(
            decision.observation,
            decision.action,
            decision.reward,
            decision.following,
            decision.terminated,
            decision.truncated,
            {},
        )
        self._decisions.append(without)
        self._acting.decisions += 1

    def end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Hands the episode over if it is sound; says how much the policy knew, and whether this is learned from."""
        is_sound = row["termination"] not in UNSOUND
        columns = {"learned_from": is_sound, "episodes_known": self.known, "late": self.late}
        if is_sound:
            self._acting.end(row)
            self._pipe.send(("learn", self._decisions))
            self.given += 1
        else:
            self._acting.decisions -= len(self._decisions)
            self._acting.episodes -= 1
        return columns

    def write(self, path: Path, table: pa.Table) -> None:
        """Has a ledger written there by the other process."""
        self._pipe.send(("write", path, table))

    def finish(self) -> None:
        """Waits until everything is learned, and ends the other process."""
        while self.known < self.given:
            self._take(self._receive())
        self._pipe.send(("end",))
        self._process.join()

    def end_now(self) -> None:
        """Ends the other process, whatever it does."""
        self._process.terminate()
        self._process.join()

    def _receive(self) -> Any:
        try:
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            raise InputError(
                "the process that learns has ended: what was learned from the last episodes is lost"
            ) from None

    def _take(self, learned: dict[str, dict[str, np.ndarray]]) -> None:
        _load(self._acting, learned)
        self.known += 1


UNSOUND = ("stopped", "did_not_hold", "simulation_failure")
"""Terminations of episodes that nobody should learn from."""


def _modules(learner: OffPolicyLearner) -> dict[str, Any]:
    modules = {"actor": learner.model.actor}
    return modules if learner.averaged is None else modules | {"averaged": learner.averaged}


def _load(learner: OffPolicyLearner, weights: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    import torch

    for name, module in _modules(learner).items():
        module.load_state_dict({key: torch.from_numpy(value) for key, value in weights[name].items()})


def _weights(learner: OffPolicyLearner) -> dict[str, dict[str, np.ndarray]]:
    return {
        name: {key: value.detach().numpy().copy() for key, value in module.state_dict().items()}
        for name, module in _modules(learner).items()
    }


def _learn(pipe: Connection, kind: type[OffPolicyLearner], given: tuple[Any, ...], named: dict[str, Any]) -> None:
    """The other process: learns, and writes what takes long."""
    import torch

    end_with_parent()
    os.nice(NICENESS)
    torch.set_num_threads(1)
    learner = kind(*given, **named)
    while True:
        try:
            what, *rest = pipe.recv()
        except EOFError:
            return
        if what == "end":
            return
        if what == "write":
            path, table = rest
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(table, path, compression="NONE", use_dictionary=False)
            continue
        for decision in rest[0]:
            learner.see(decision)
        pipe.send(_weights(learner))
