"""Constraint violations recomputed from the commands, independently of the systems that report them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.transforms import pose_to_transform
from guiderail.tools.evaluation.rollout import EnvCallback

# Maps the values sampled at a reset to the poses of a template's objects.
Frames = Callable[[Mapping[str, Any]], Mapping[str, RigidTransform]]


def nominal_frames(sampled: Mapping[str, Any]) -> Mapping[str, RigidTransform]:
    """Return an empty mapping: every object has its nominal pose."""
    return {}


class RecomputedViolation(EnvCallback):
    """Callback that adds `recomputed_violation`, the largest violation of an episode's commands; −inf if unconstrained.

    It is computed with NumPy from the recorded `desired_pose` and the task's constraints, or the template's active
    constraints in the state of each control step.
    """

    def __init__(self, env: gymnasium.Env, frames: Frames | None = nominal_frames):
        """Construct the callback.

        Args:
            env: Environment of a declared task.
            frames: Poses of the template's objects. If None they are unknown, and only the task's constraints are
                recomputed.
        """
        super().__init__(env)
        self._frames = frames

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return `recomputed_violation`."""
        task: Task | None = getattr(self.base.task, "declaration", None)
        if task is None or not len(self.base.trace):
            return {"recomputed_violation": -np.inf}
        return {"recomputed_violation": float(self._violations(task).max())}

    def _violations(self, task: Task) -> np.ndarray:
        """Return the violation of every control step, (n,)."""
        poses = self.base.trace.commanded
        constraints = task.constraints()
        if constraints is not None:
            # Command n of the trace, counted from zero, has to satisfy the constraints of step n.
            G, c = constraints.window(np.arange(len(poses)))
            return (c - np.einsum("nfo,no->nf", G, poses)).max(axis=1, initial=-np.inf)
        if self._frames is None or "template" not in task.provides():
            return np.full(len(poses), -np.inf)
        placed = task.template()
        frames = {**placed.frames, **self._frames(self.base.sampled)}
        states = self.base.trace.signals["state"][:, 0].astype(int)
        return np.array(
            [
                placed.template.violation(state, pose_to_transform(pose), frames)
                for state, pose in zip(states, poses, strict=True)
            ]
        )
