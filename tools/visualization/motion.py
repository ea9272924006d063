"""Recording of an episode for a page: poses of all bodies and the signals of every control step, on one time axis."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.geometry import Role
from pydrake.systems.framework import Context, EventStatus

from guiderail.models.common.transforms import MM
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.tools.evaluation.metrics import VIOLATION
from guiderail.tools.evaluation.rollout import EnvCallback, Transition

POINTS = 400  # most samples of an episode: a page is not wider
DRAWN = "/drake/visualizer"  # path of Drake's visualizer in Meshcat's tree
DIGITS = 5  # significant digits of a plotted number


class Motion(EnvCallback):
    """Record the poses of all visible bodies and the actions, control step by control step.

    It replaces the simulator's monitor.
    """

    def __init__(self, env: Any):
        """Construct the callback.

        Args:
            env: Environment that was made with `render_mode="human"` and was reset.
        """
        super().__init__(env)
        self._query = self.base.task.query
        self._system = self._query.get_system()
        self._period = self.base.task.control_period
        self._poses: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        inspector = self._eval_query(self.base.simulator.get_context()).inspector()
        self._frames = {
            f"{DRAWN}/{inspector.GetName(frame).replace('::', '/')}": frame
            for frame in inspector.GetAllFrameIds()
            if frame != inspector.world_frame_id()
            and inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration) > 0
        }
        self.base.simulator.set_monitor(self._record_poses)

    def on_episode_start(self) -> None:
        """Clear the actions; the poses of time zero are recorded by then."""
        self._actions = []

    def on_step(self, transition: Transition) -> None:
        """Record the action for every control step since the last one."""
        steps = len(self.base.trace) - len(self._actions)
        self._actions += steps * [np.clip(np.asarray(transition.action, float).ravel(), -1.0, 1.0)]

    def data(self) -> dict[str, Any]:
        """Return the episode as numbers for a page: `times` [s], `frames`, and the signals at those times.

        `frames` maps each body's path in Meshcat's tree to its poses (n, 7), [x, y, z, qw, qx, qy, qz] as float32 in
        base64; a body that never moved has a single pose. Forces [N] and violations are the largest since the sample
        before, so that no peak is lost. An episode that failed before its first control step has one sample.
        """
        trace = self.base.trace
        stride = max(1, -(-len(trace) // POINTS))
        ends = np.unique(np.append(np.arange(stride - 1, len(trace), stride), len(trace) - 1))
        ends = ends[ends >= 0]
        starts = np.append(0, ends[:-1] + 1)
        poses = np.array(self._poses[: len(trace) + 1])[np.append(0, ends + 1)]
        signals = trace.signals

        def largest(values: np.ndarray) -> list[float] | None:
            if not len(ends):
                return None
            values = np.maximum.reduceat(values.ravel(), starts)
            return None if values.max() <= ConstraintViolation.UNCONSTRAINED else _with_first(values)

        data = {
            "times": [0.0, *(round(float(t), 4) for t in trace.period * (ends + 1))],
            "frames": {path: _encode(poses[:, i]) for i, path in enumerate(self._frames)},
            "force": largest(trace.force),
            "commanded": largest(signals["commanded_violation"]),
            "measured": largest(signals["measured_violation"]),
            "action": [_with_first(values) for values in np.array(self._actions)[ends].T] if len(ends) else [],
            "time": [0.0, *(round(float(100 * (n + 1) / self.base.task.num_steps), 2) for n in ends)],
        }
        if "state" in signals and len(ends):
            data["state"] = _with_first(signals["state"].ravel()[ends])
        return data

    def _eval_query(self, root: Context) -> Any:
        return self._query.Eval(self._system.GetMyContextFromRoot(root))

    def _record_poses(self, root: Context) -> EventStatus:
        """Record the poses at the end of each control step, as the simulator's monitor."""
        time = root.get_time()
        if time == 0.0:
            self._poses.clear()
        # The tolerance is far below a step of the simulation, and far above rounding errors.
        if time > len(self._poses) * self._period - 1e-6:
            query = self._eval_query(root)
            self._poses.append(np.array([_pose(query.GetPoseInWorld(frame)) for frame in self._frames.values()]))
        return EventStatus.DidNothing()


def violation_unit(constraints: LinearConstraints | None, outputs: int) -> tuple[str, float]:
    """Return the unit in which a violation is plotted, and the factor: mm if only positions are constrained."""
    has_rotations = outputs >= 6 and (constraints is None or bool(np.any(constraints.G[..., 3:])))
    return (VIOLATION, 1.0) if has_rotations else ("mm", 1.0 / MM)


def state_names(task: Any) -> Sequence[str]:
    """Return the names of the states of a task's template, in order; empty without a template."""
    return [state.name for state in task.template().template.states] if "template" in type(task).provides() else []


def _pose(X_WF: Any) -> list[float]:
    return [*X_WF.translation(), *X_WF.rotation().ToQuaternion().wxyz()]


def _encode(poses: np.ndarray) -> str:
    poses = poses.astype("<f4")
    return base64.b64encode((poses[:1] if (poses == poses[0]).all() else poses).tobytes()).decode()


def _with_first(values: np.ndarray) -> list[float]:
    """Return the values at the ends of control steps, with the first one also at time zero."""
    rounded = [float(f"{value:.{DIGITS}g}") for value in values]
    return [rounded[0], *rounded]
