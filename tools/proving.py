"""Which of a run's actors is its result: one that proved itself, by nothing but the training's own episodes."""

from collections.abc import Mapping
from typing import Any

import torch


class Proving:
    """Keeps the latest actor whose next so many practising episodes went at least as well as any before.

    Learning on the edge of contact swings: a policy that succeeds for twenty episodes can fail for two and recover. The
    last one of a run is therefore a poor choice, and choosing by held-out conditions would be no choice at all.
    """

    def __init__(self, episodes: int):
        """
        Args:
            episodes: practising episodes, each acted by an actor or its close successors, that prove it.
        """
        self.episodes = episodes
        self.proven: dict[str, torch.Tensor] | None = None
        self._best = 0
        self._candidates: list[dict[str, torch.Tensor]] = []
        self._outcomes: list[bool] = []

    def begin(self, actor: torch.nn.Module) -> None:
        """A practising episode begins, acted by this actor."""
        self._candidates.append({key: value.detach().clone() for key, value in actor.state_dict().items()})

    def finish(self, success: bool) -> None:
        """It is over."""
        self._outcomes.append(success)
        if len(self._outcomes) < self.episodes:
            return
        passed = sum(self._outcomes)
        if passed >= self._best:
            self.proven, self._best = self._candidates[0], passed
        del self._candidates[0], self._outcomes[0]

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Between episodes: tensors by name, and what JSON can hold."""
        kept = dict(enumerate(self._candidates)) | ({} if self.proven is None else {"proven": self.proven})
        tensors = {f"{name}/{key}": value for name, actor in kept.items() for key, value in actor.items()}
        return tensors, {"best": self._best, "outcomes": list(self._outcomes)}

    def restore(self, tensors: Mapping[str, torch.Tensor], values: Mapping[str, Any]) -> None:
        """Becomes what it was when `state` was called."""
        actors: dict[str, dict[str, torch.Tensor]] = {}
        for name, value in tensors.items():
            actor, key = name.split("/", 1)
            actors.setdefault(actor, {})[key] = value
        self.proven = actors.pop("proven", None)
        self._candidates = [actors[key] for key in sorted(actors, key=int)]
        self._best, self._outcomes = values["best"], list(values["outcomes"])
