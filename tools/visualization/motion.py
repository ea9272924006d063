"""What a page shows of an episode: where each body was and what was measured, all by one clock."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.geometry import Role
from pydrake.systems.framework import Context, EventStatus

from guiderail.models.common.units import MM
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.tools.evaluation.rollout import EnvCallback, Transition

POINTS = 400  # at most, of an episode: as many as a page is wide
DRAWN = "/drake/visualizer"  # where Drake's visualizer keeps the bodies that move
DIGITS = 5  # of a number that is plotted


class Motion(EnvCallback):
    """Remembers an episode control step by control step: the poses of all bodies that are drawn, and the actions.

    It takes the place of the simulator's monitor, and leaves no other there.
    """

    def __init__(self, env: Any):
        """
        Args:
            env: an environment that was made with `render_mode="human"` and was reset.
        """
        super().__init__(env)
        self._query = self.base.task.query
        self._system = self._query.get_system()
        self._period = self.base.task.control_period
        self._poses: list[np.ndarray] = []
        inspector = self._seen(self.base.simulator.get_context()).inspector()
        self._frames = {
            f"{DRAWN}/{inspector.GetName(frame).replace('::', '/')}": frame
            for frame in inspector.GetAllFrameIds()
            if frame != inspector.world_frame_id()
            and inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration) > 0
        }
        self.base.simulator.set_monitor(self._follow)

    def on_episode_start(self) -> None:
        """Starts a list of actions; the poses of time zero were there already."""
        self._actions: list[np.ndarray] = []

    def on_step(self, decision: Transition) -> None:
        """The action that every control step since the last decision had."""
        steps = len(self.base.trace) - len(self._actions)
        self._actions += steps * [np.clip(np.asarray(decision.action, float).ravel(), -1.0, 1.0)]

    def shown(self) -> dict[str, Any]:
        """The episode as numbers for a page: `times` [s], `frames`, and the signals at those times.

        `frames` has for each body its path in Meshcat's tree and its poses (n, 7), [x, y, z, qw, qx, qy, qz] as
        float32 in base64; one that never moved has a single one. Forces [N] and violations are the largest since the
        time before, so that no peak is lost.
        """
        trace = self.base.trace
        stride = max(1, -(-len(trace) // POINTS))
        ends = np.unique(np.append(np.arange(stride - 1, len(trace), stride), len(trace) - 1))
        starts = np.append(0, ends[:-1] + 1)
        poses = np.array(self._poses[: len(trace) + 1])[np.append(0, ends + 1)]
        signals = trace.signals

        def largest(values: np.ndarray) -> list[float] | None:
            values = np.maximum.reduceat(values.ravel(), starts)
            return None if values.max() <= ConstraintViolation.UNCONSTRAINED else _first_again(values)

        shown = {
            "times": [0.0, *(round(float(t), 4) for t in trace.period * (ends + 1))],
            "frames": {path: _encoded(poses[:, i]) for i, path in enumerate(self._frames)},
            "force": largest(trace.force),
            "commanded": largest(signals["commanded_violation"]),
            "measured": largest(signals["measured_violation"]),
            "action": [_first_again(values) for values in np.array(self._actions)[ends].T],
            "time": [0.0, *(round(float(100 * (n + 1) / self.base.task.num_steps), 2) for n in ends)],
        }
        if "state" in signals:
            shown["state"] = _first_again(signals["state"].ravel()[ends])
        return shown

    def _seen(self, root: Context) -> Any:
        return self._query.Eval(self._system.GetMyContextFromRoot(root))

    def _follow(self, root: Context) -> EventStatus:
        """The simulator's monitor: the poses at the end of each control step."""
        time = root.get_time()
        if time == 0.0:
            self._poses.clear()
        # Steps of the simulation are far longer than what rounding makes of them.
        if time > len(self._poses) * self._period - 1e-6:
            seen = self._seen(root)
            self._poses.append(np.array([_pose(seen.GetPoseInWorld(frame)) for frame in self._frames.values()]))
        return EventStatus.DidNothing()


def violation_unit(constraints: LinearConstraints | None, outputs: int) -> tuple[str, float]:
    """What a violation is plotted in, and what to multiply it by: lengths in mm, anything that turns as it comes."""
    turns = outputs >= 6 and (constraints is None or bool(np.any(constraints.G[..., 3:])))
    return ("m or rad", 1.0) if turns else ("mm", 1.0 / MM)


def state_names(task: Any) -> Sequence[str]:
    """The states of a task's template, by number; none where it has no template."""
    return [state.name for state in task.template().template.states] if "template" in type(task).provides() else []


def _pose(X_WF: Any) -> list[float]:
    return [*X_WF.translation(), *X_WF.rotation().ToQuaternion().wxyz()]


def _encoded(poses: np.ndarray) -> str:
    poses = poses.astype("<f4")
    return base64.b64encode((poses[:1] if (poses == poses[0]).all() else poses).tobytes()).decode()


def _first_again(values: np.ndarray) -> list[float]:
    """Numbers at the ends of control steps, the first one at time zero too."""
    rounded = [float(f"{value:.{DIGITS}g}") for value in values]
    return [rounded[0], *rounded]
