"""What happened in an episode, control step by control step."""

from collections.abc import Mapping

import numpy as np


class EpisodeTrace:
    """Commanded and measured pose, contact force and reward of every control step of an episode, and further signals.

    The arrays are views of storage that the next episode writes into: copy what should outlive a reset.
    """

    def __init__(self, num_steps: int, num_outputs: int, period: float, signals: Mapping[str, int] | None = None):
        """
        Args:
            num_steps: control steps that an episode can have.
            num_outputs: O, the size of a pose.
            period: seconds between control steps.
            signals: the sizes of further signals by name.
        """
        self.period = period
        self._length = 0
        self._commanded = np.empty((num_steps, num_outputs))
        self._measured = np.empty((num_steps, num_outputs))
        self._force = np.empty(num_steps)
        self._reward = np.empty(num_steps)
        self._signals = {name: np.empty((num_steps, size)) for name, size in (signals or {}).items()}

    def __len__(self) -> int:
        """Control steps recorded so far."""
        return self._length

    @property
    def commanded(self) -> np.ndarray:
        """The commanded poses, (n, O)."""
        return self._commanded[: self._length]

    @property
    def measured(self) -> np.ndarray:
        """The measured poses at the end of each control step, (n, O)."""
        return self._measured[: self._length]

    @property
    def force(self) -> np.ndarray:
        """The contact force of each control step, (n,), N."""
        return self._force[: self._length]

    @property
    def reward(self) -> np.ndarray:
        """The reward of each control step, (n,)."""
        return self._reward[: self._length]

    @property
    def signals(self) -> dict[str, np.ndarray]:
        """The further signals by name, (n, size) each."""
        return {name: values[: self._length] for name, values in self._signals.items()}

    def clear(self) -> None:
        """Forgets the episode."""
        self._length = 0

    def append(
        self,
        commanded: np.ndarray,
        measured: np.ndarray,
        force: float,
        reward: float,
        signals: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Records one more control step; `signals` has a value for each further one."""
        n = self._length
        self._commanded[n] = commanded
        self._measured[n] = measured
        self._force[n] = force
        self._reward[n] = reward
        for name, values in self._signals.items():
            values[n] = signals[name] if signals is not None else np.nan
        self._length = n + 1


def mean_jerk(positions: np.ndarray, period: float) -> float:
    """The mean norm of the third derivative of `positions` (n, O), by differences; 0 for fewer than four of them."""
    if len(positions) < 4:
        return 0.0
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=1).mean() / period**3)
