"""Replay buffer that mixes demonstrations into every batch."""

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize


class DemonstrationReplayBuffer(NStepReplayBuffer):
    """Replay buffer with a fixed fraction of demonstrated transitions in every batch (RLPD; Ball et al., 2023).

    The first `num_demonstrated` rows are the demonstrations; a full buffer overwrites the others only.

    Attributes:
        fraction: Fraction of a batch that is demonstrated, once there are other transitions.
        num_demonstrated: Number of rows of demonstrations.
    """

    fraction = 0.5
    num_demonstrated = 0

    def add(self, *args: np.ndarray, **kwargs: np.ndarray) -> None:  # type: ignore[override]
        """Add a row; after the last one, continue behind the demonstrations."""
        super().add(*args, **kwargs)  # type: ignore[arg-type]
        if self.full and self.pos < self.num_demonstrated:
            self.pos = self.num_demonstrated

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return a batch; demonstrated rows are spread evenly over it, so that equal parts of it have as many."""
        size, first = self.size(), self.num_demonstrated
        if not 0 < first < size:
            return super().sample(batch_size, env)
        count = np.arange(batch_size + 1) * self.fraction
        is_demonstrated = np.diff(np.floor(count + 1e-9)) > 0
        low, high = np.where(is_demonstrated, 0, first), np.where(is_demonstrated, first, size)
        # From the generator of the process, as Stable-Baselines3's own buffers do.
        indices = np.random.randint(low, high)  # noqa: NPY002
        return self._get_samples(indices, env=env)
