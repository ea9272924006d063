"""Violations of what was commanded, from the commands themselves: nobody's word is taken for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.poses import pose_to_transform
from guiderail.tools.evaluation.rollout import EnvCallback

# From what a reset drew to where a template's objects are then.
Frames = Callable[[Mapping[str, Any]], Mapping[str, RigidTransform]]


def nothing_moves(drawn: Mapping[str, Any]) -> Mapping[str, RigidTransform]:
    """Every object is where the template has it."""
    return {}


class RecomputedViolation(EnvCallback):
    """Adds `recomputed_violation`: how far the worst command of an episode was outside, −inf where nothing bounds it.

    It is computed from the trace's `desired_pose` and from the task's constraints, or the active constraints of the
    template in the state of each control step, with plain NumPy: not by the systems that say so in `info`.
    """

    def __init__(self, env: gymnasium.Env, frames: Frames | None = nothing_moves):
        """
        Args:
            env: the environment of a declared task.
            frames: where the template's objects are; None where nobody knows: then only a task's constraints bound it.
        """
        super().__init__(env)
        self._frames = frames

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """`recomputed_violation`."""
        task: Task | None = getattr(self.base.task, "declaration", None)
        if task is None or not len(self.base.trace):
            return {"recomputed_violation": -np.inf}
        return {"recomputed_violation": float(self._violations(task).max())}

    def _violations(self, task: Task) -> np.ndarray:
        """Of every control step, (n,)."""
        poses = self.base.trace.commanded
        constraints = task.constraints()
        if constraints is not None:
            # The command at the end of control step n is the one of step n, as counted from zero.
            G, c = constraints.window(np.arange(len(poses)))
            return (c - np.einsum("nfo,no->nf", G, poses)).max(axis=1, initial=-np.inf)
        if self._frames is None or "template" not in task.provides():
            return np.full(len(poses), -np.inf)
        placed = task.template()
        frames = {**placed.frames, **self._frames(self.base.drawn)}
        states = self.base.trace.signals["state"][:, 0].astype(int)
        return np.array(
            [
                placed.template.violation(state, pose_to_transform(pose), frames)
                for state, pose in zip(states, poses, strict=True)
            ]
        )
