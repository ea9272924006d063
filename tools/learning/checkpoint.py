"""All that a run needs to go on as if it had never stopped, in one file that holds no code."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import digest
from guiderail.tools.files import write_atomically

Actor = dict[str, torch.Tensor]


@dataclass
class Candidate:
    """An actor, and how many greedy episodes in a row succeeded before it and, itself included, since."""

    actor: Actor
    before: int
    since: int = 0

    def score(self) -> int:
        """Successes on both sides: what acts well by luck, or only just learned to, has few on one of them."""
        return min(self.before, self.since)


class CheckpointSelection:
    """Selects the latest actor in the midst of the longest row of greedy episodes that succeeded.

    Learning on the edge of contact swings: a policy that succeeds for twenty episodes can fail for two and recover. The
    last one of a run is therefore a poor choice, and choosing by held-out conditions would be no choice at all. Nor is
    it enough that the next few episodes succeeded: the actors that did so were its successors, and were better.
    """

    def __init__(self, window: int):
        """
        Args:
            window: successes before and after an actor, beyond which more count for nothing and the later one is taken.
        """
        self.window = window
        self._selected: Candidate | None = None
        self._open: list[Candidate] = []  # whose row goes on

    def begin(self, actor: torch.nn.Module, before: int) -> None:
        """A greedy episode begins, acted by this actor; so many in a row succeeded before it."""
        copy = {key: value.detach().clone() for key, value in actor.state_dict().items()}
        self._open.append(Candidate(copy, min(before, self.window)))

    def finish(self, success: bool) -> None:
        """It is over."""
        if not success:
            self._selected, self._open = self._best(), []
            return
        for candidate in self._open:
            candidate.since += 1
        while self._open and self._open[0].since >= self.window:
            self._selected = self._better(self._selected, self._open.pop(0))

    def leave_out(self) -> None:
        """It is over, and says nothing of the actor."""
        self._open.pop()

    def result(self) -> Actor | None:
        """The best actor so far; None where none has successes on both sides."""
        best = self._best()
        return None if best is None else best.actor

    def _best(self) -> Candidate | None:
        return reduce(self._better, self._open, self._selected)

    @staticmethod
    def _better(best: Candidate | None, candidate: Candidate) -> Candidate | None:
        least = 1 if best is None else best.score()
        return candidate if candidate.score() >= least else best

    def state(self) -> tuple[Actor, dict[str, Any]]:
        """Between episodes: tensors by name, and what JSON can hold."""
        known = {str(index): candidate for index, candidate in enumerate(self._open)}
        if self._selected is not None:
            known["selected"] = self._selected
        tensors = {f"{name}/{key}": value for name, one in known.items() for key, value in one.actor.items()}
        return tensors, {"rows": {name: [one.before, one.since] for name, one in known.items()}}

    def restore(self, tensors: Mapping[str, torch.Tensor], values: Mapping[str, Any]) -> None:
        """Becomes what it was when `state` was called."""
        actors: dict[str, Actor] = {name: {} for name in values["rows"]}
        for name, value in tensors.items():
            actor, key = name.split("/", 1)
            actors[actor][key] = value
        known = {name: Candidate(actors[name], *rows) for name, rows in values["rows"].items()}
        self._selected = known.pop("selected", None)
        self._open = [known[name] for name in sorted(known, key=int)]


def save_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Writes arrays and JSON values with a digest of both; a run killed while writing keeps its last checkpoint."""
    arrays = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
    text = json.dumps(values)
    write_atomically(path, save(arrays, {"values": text, "digest": digest(arrays, text)}))


def load_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `save_checkpoint` wrote.

    Raises:
        InputError: if the file is missing, truncated or changed.
    """
    if not path.is_file():
        raise InputError(f"there is no checkpoint {path}: start the run anew in another folder")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata()
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (it is no dictionary)
        text = metadata["values"]
        if metadata["digest"] != digest(arrays, text):
            raise ValueError("the digest differs")
        return arrays, json.loads(text)
    except (SafetensorError, ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise InputError(
            f"the checkpoint {path} is damaged: restore a copy, or start anew in another folder"
        ) from error
