"""Trace of an episode: commands, measurements and rewards of every control step, and their statistics.

`DiagramEnv` fills it, and so does the executor of packages/hardware. A statistic becomes a column of results only if
`COLUMNS` of tools/evaluation/metrics.py describes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

TOLERANCE = 1e-9  # largest constraint violation that counts as rounding of the primitive's solver [m or rad]
QUASI_STATIC_TIME = 0.5  # contact that lasts longer is quasi-static, not transient (ISO/TS 15066) [s]


@dataclass(frozen=True)
class Metric:
    """Definition of a number that is computed from an episode, or from a table of episodes."""

    name: str  # name of the metric's column
    unit: str  # unit, or the quantity that is counted; "" if there is none
    description: str  # definition in words
    compute: Callable[[Any], Any]  # function from the episode, or from the table of episodes, to the number


class EpisodeTrace:
    """Record of an episode, with one row taken at the end of every control step.

    The arrays are views of storage that the next episode overwrites: copy data that are needed after a reset.
    """

    def __init__(self, num_steps: int, num_outputs: int, period: float, signals: Mapping[str, int]):
        """Construct an empty trace.

        Args:
            num_steps: Largest number of control steps.
            num_outputs: Size O of a pose.
            period: Control period [s].
            signals: Sizes of further signals by name.
        """
        self.period = period
        self._length = 0
        self._commanded = np.empty((num_steps, num_outputs))
        self._measured = np.empty((num_steps, num_outputs))
        self._force = np.empty(num_steps)
        self._reward = np.empty(num_steps)
        self._signals = {name: np.empty((num_steps, size)) for name, size in signals.items()}

    def __len__(self) -> int:
        """Return the number of control steps recorded so far."""
        return self._length

    @property
    def commanded(self) -> np.ndarray:
        """Commanded poses, (n, O)."""
        return self._commanded[: self._length]

    @property
    def measured(self) -> np.ndarray:
        """Measured poses, (n, O)."""
        return self._measured[: self._length]

    @property
    def force(self) -> np.ndarray:
        """Force of the impedance or, without an impedance, of the contact, (n,) [N]."""
        return self._force[: self._length]

    @property
    def reward(self) -> np.ndarray:
        """Reward, (n,)."""
        return self._reward[: self._length]

    @property
    def signals(self) -> dict[str, np.ndarray]:
        """Further signals by name, (n, size) each."""
        return {name: values[: self._length] for name, values in self._signals.items()}

    def clear(self) -> None:
        """Delete all control steps."""
        self._length = 0

    def assign(self, other: EpisodeTrace) -> None:
        """Replace the control steps by those of a trace of the same task."""
        self._length = len(other)
        for name in ("commanded", "measured", "force", "reward"):
            getattr(self, name)[:] = getattr(other, name)
        for name, values in self.signals.items():
            values[:] = other.signals[name]

    def append(
        self,
        commanded: np.ndarray,
        measured: np.ndarray,
        force: float,
        reward: float,
        signals: Mapping[str, np.ndarray],
    ) -> None:
        """Record one control step: poses (O,), force [N] as in `force`, reward and signals."""
        n = self._length
        self._commanded[n] = commanded
        self._measured[n] = measured
        self._force[n] = force
        self._reward[n] = reward
        for name, values in self._signals.items():
            values[n] = signals[name]
        self._length = n + 1

    def statistics(self) -> dict[str, float]:
        """Return the safety statistics of the episode so far, by name.

        Before the first control step, the largest violations are −∞ and the peak force is 0. The maximum of values that
        contain NaN is NaN. `collision_steps` counts the control steps in collision, and `collisions` the uninterrupted
        sequences of such steps. If its signal is not recorded, a violation is −∞ and a count is 0.
        """
        collision = self._is_positive("collision")
        return {
            "max_commanded_violation": self._largest("commanded_violation"),
            "max_measured_violation": self._largest("measured_violation"),
            "peak_force": float(self.force.max(initial=0.0)),
            "peak_contact_force": float(self.signals["contact_force"].max(initial=0.0))
            if "contact_force" in self._signals
            else 0.0,
            # Forces are added in the order of the steps, because the order of NumPy's mean rounds differently.
            "quasi_static_force": self._quasi_static_force(),
            "mean_force": float(np.cumsum(self.force)[-1] / len(self)) if len(self) else 0.0,
            "collisions": float((collision & ~np.append(False, collision[:-1])).sum()),
            "collision_steps": float(collision.sum()),
            "cost": float(self.unsafe().sum()),
            "saturated_steps": float(self.signals["saturation"].any(axis=1).sum())
            if "saturation" in self._signals
            else 0.0,
            "fallback_steps": float(self._is_positive("fallback").sum()),
            "steps": float(len(self)),
        }

    def unsafe(self, first: int = 0) -> np.ndarray:
        """Return whether each control step from number `first` on is unsafe, (n − first,).

        A control step is unsafe if the commanded or the measured pose violates a constraint by more than `TOLERANCE`,
        or the force is above the limit of a collision. A violation that is NaN is unsafe.
        """
        unsafe = self._is_positive("collision")[first:]
        for name in ("commanded_violation", "measured_violation"):
            if name in self._signals:
                unsafe = unsafe | ~(self.signals[name][first:, 0] <= TOLERANCE)
        return unsafe

    def _quasi_static_force(self) -> float:
        """Return the largest force that the contact never falls below for `QUASI_STATIC_TIME` [N]; 0 if it is shorter.

        Without the signal `contact_force`, the force is that of `force`.
        """
        force = self.signals["contact_force"][:, 0] if "contact_force" in self._signals else self.force
        window = max(round(QUASI_STATIC_TIME / self.period), 1)
        if len(force) < window:
            return 0.0
        return float(np.lib.stride_tricks.sliding_window_view(force, window).min(axis=1).max())

    def _largest(self, name: str) -> float:
        return float(self.signals[name].max(initial=-np.inf)) if name in self._signals else -np.inf

    def _is_positive(self, name: str) -> np.ndarray:
        """Return whether a scalar signal is positive at each control step, (n,); False without the signal."""
        return self.signals[name][:, 0] > 0.0 if name in self._signals else np.zeros(len(self), bool)


def mean_jerk(positions: np.ndarray, period: float) -> float:
    """Return the mean norm of the third derivative of `positions` (n, O), by finite differences over a `period` [s].

    It is 0 for fewer than four positions.
    """
    if len(positions) < 4:
        return 0.0
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=1).mean() / period**3)
