"""Training in a second process while this process acts: a robot must not wait for gradient steps."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from guiderail.models.common.errors import InputError, naming_failures
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.evaluation.step_log import write_step_log
from guiderail.tools.learning.checkpoint import entries_of
from guiderail.tools.learning.episodes import Weights, copy_weights, load_weights, record_transition
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.off_policy import OffPolicyLearner


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
            raise InputError("only an off-policy learner trains while it acts: choose tqc, sac, td3 or crossq")
        self._acting, self._waits, self._excluded = acting, waits, excluded
        self._transitions: list[Transition] = []
        self._pending: list[Transition] | None = None  # a finished episode that is not submitted yet
        self.known = self.submitted = self.late = 0
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
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
            self._send(("learn", self._pending))
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
        load_weights(self._acting, self._receive())
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


def _learn(learner: OffPolicyLearner, transitions: list[Transition]) -> Weights:
    for transition in transitions:
        learner.on_step(transition)
    return copy_weights(learner)


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
