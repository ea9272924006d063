"""Seam between training and a supervisor that corrects the policy, which the distribution guiderail-hardware has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from guiderail.tools.evaluation.episode import Callback, PolicyFn
from guiderail.tools.learning.run_folder import RunConfig


class SupervisedEpisodes(Protocol):
    """Episodes of a run whose environment a supervisor can change from episode to episode."""

    env: Any  # environment of the next episode

    @property
    def config(self) -> RunConfig:
        """Configuration of the run with the supervisor's corrections so far."""
        ...

    def state(self) -> dict[str, Any]:
        """Return the values for a checkpoint."""
        ...

    def rollout(self, act: PolicyFn, *callbacks: Callback, index: int) -> dict[str, Any]:
        """Run one episode and return its row."""
        ...


Supervise = Callable[[RunConfig, Mapping[str, Any]], SupervisedEpisodes]
"""Function that starts supervised episodes from a run's configuration and the values of its checkpoint, if any."""
