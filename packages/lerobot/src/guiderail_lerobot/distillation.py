"""Policy distillation: a student that predicts the task-space commands of a trained KGRL policy (thesis, 6.2.3)."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.models.primitives import UnsolvableError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.evaluation.policies import is_compatible
from guiderail.tools.learning.learner import register_learner
from guiderail.tools.pretrained import find_run
from guiderail_lerobot.chunking import ChunkLearner
from guiderail_lerobot.config import DistillationConfig

CLOCK_SPREAD = 1e-6  # an observation entry with a smaller range over the episodes, at every step, is a clock


@register_learner("distillation")
class DistillationLearner(ChunkLearner):
    """Learner of a student that maps the teacher's observation directly to the next K commands.

    In every episode the teacher acts with noise, so that observations off its own path are visited. The labels are the
    commands of the teacher without noise,

        y_{t+k} = LC-NS-KMP(t + k, π(s_t)),   k = 0 … K−1,

    computed for the visited observations and for copies of them with noise. The network is trained after the last
    episode, and is a base policy (`guidance=base_policy`). The setting `symmetry` has no effect.
    """

    Config = DistillationConfig
    config: DistillationConfig

    def __init__(self, config: DistillationConfig, env: gymnasium.Env, **arguments: Any):
        """Construct the learner; `Learner` describes the arguments.

        Raises:
            InputError: If no teacher is given, the teacher has no policy, its observations or actions differ from the
                environment's, or the guidance is not KGRL with a clock-driven phase; also as `ChunkLearner`.
        """
        super().__init__(config, env, **arguments | {"symmetry": None})
        if not config.teacher:
            raise InputError("distillation needs a teacher: give --set teacher=RUN")
        self._teacher = Policy.load(find_run(config.teacher))
        if not is_compatible(lambda env: self._teacher, env):
            raise InputError(
                f"the policy of {config.teacher} has other observations or actions than this environment: give the "
                "--env of its training"
            )
        declared = self._env.diagram.config
        prior = make_prior_knowledge(declared).primitive
        if declared.guidance != "kgrl" or prior is None or prior.motion is not None or prior.progress is not None:
            raise InputError("distillation needs kgrl with a clock-driven phase: give --guidance kgrl")
        self._primitive = prior.primitive(history=False)
        self._gains, self._selection = prior.null_space_gains(self._primitive), prior.selection
        self._num_outputs = prior.num_outputs
        self._steps: list[int] = []  # control step of each observation

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the teacher's action (A,) with noise, clipped to ±1."""
        action = self._teacher(observation)
        noisy = action + self.config.action_noise * self._random.standard_normal(action.shape)
        return np.clip(noisy, -1.0, 1.0).astype(np.float32)

    def on_episode_start(self) -> None:
        """Count the episode, and seed the noise of its actions."""
        super().on_episode_start()
        self._random = np.random.default_rng([self._seed, self.episodes])

    def on_step(self, transition: Transition) -> None:
        """Store the observation and its control step."""
        self._observations.append(np.asarray(transition.observation, np.float32))
        self._steps.append(self._step)
        self._groups.append(self.episodes)
        self._step = len(self._env.trace)

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return no columns."""
        return {}

    def label(self, observation: np.ndarray, step: int) -> np.ndarray:
        """Return the teacher's commands (K, O) from a control step on, for an observation (n,) at that step."""
        action = self._gains * (self._selection @ np.asarray(self._teacher(observation), float))
        commands = []
        for future_step in range(step, step + self.config.chunk_steps):
            try:
                commands.append(self._primitive.predict(future_step, action).output)
            except UnsolvableError:  # as in the guidance: project the last command onto the constraints
                last = commands[-1] if commands else self._primitive.reference.means[0]
                commands.append(self._primitive.constraints.nearest(last, future_step))
        return np.array(commands)

    def finish(self) -> None:
        """Label the observations and their noisy copies, and train.

        Raises:
            InputError: If noisy copies are configured and there is only one episode, so that no clock can be found.
        """
        if self.config.noisy_copies and self.config.copy_noise and len(set(self._groups)) < 2:
            raise InputError(
                "noisy copies have no noise in the observed clock, which is found by comparing episodes: give at least "
                "2 --episodes, not 1, or --set noisy_copies=0"
            )
        observations, steps, groups = np.array(self._observations), np.array(self._steps), list(self._groups)
        scale = observations.std(axis=0) * ~self._clocks(observations, steps)
        random = np.random.default_rng([self._seed, 0])
        copies = [observations]
        for _ in range(self.config.noisy_copies):
            noise = self.config.copy_noise * scale * random.standard_normal(observations.shape)
            copies.append((observations + noise).astype(np.float32))
        self._actions = [
            self.label(observation, int(step)).ravel()
            for copy in copies
            for observation, step in zip(copy, steps, strict=True)
        ]
        self._observations, self._groups = list(np.concatenate(copies)), groups * len(copies)
        self._train()
        self._observations, self._groups = list(observations), groups

    @staticmethod
    def _clocks(observations: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Return a mask (n,) of the entries that depend only on the step, for observations (N, n) at `steps` (N,)."""
        spreads = [np.ptp(observations[steps == step], axis=0) for step in np.unique(steps)]
        return np.max(spreads, axis=0) < CLOCK_SPREAD

    def _training_rows(self, random: np.random.Generator) -> np.ndarray:
        """Return the indices of all samples: a teacher can label any observation, so no bootstrap sample is needed."""
        return np.arange(len(self._groups))

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from: the visited observations."""
        arrays = {"observations": np.array(self._observations), "steps": np.array(self._steps)}
        return arrays | {"groups": np.array(self._groups)}, {"episodes": self.episodes}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; raise KeyError if it does not fit this learner."""
        self._observations, self._steps = [*arrays["observations"]], arrays["steps"].tolist()
        self._groups, self.episodes = arrays["groups"].tolist(), values["episodes"]
