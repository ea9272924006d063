"""Guard of chunks as a LeRobot processor step: bounds, velocity and jerk limits of the actions of any policy.

`add_guard` appends the step to a stored policy's postprocessor, which `lerobot-rollout` applies. The step needs the
core of guiderail in LeRobot's environment (`pip install guiderail`), not the simulation.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.processor import ProcessorStep, ProcessorStepRegistry, TransitionKey

HORIZON = 16  # steps for which a single action is repeated to form a chunk


@ProcessorStepRegistry.register("guiderail_chunk_guard")
@dataclass
class ChunkGuardProcessorStep(ProcessorStep):
    """Step that changes actions as little as possible so that they are within the limits (`ChunkGuard`).

    A chunk (1, K, A) is limited as a whole. A single action, an array (A,) or (1, A) or a dictionary by name, is
    limited as a chunk that repeats the action. All returned actions have to be executed, one per control period. A NaN
    or infinite action is refused. The limits are satisfied up to the rounding of the action's type.

    Attributes:
        lower: Lower bounds of the A numbers of an action; None for no bound.
        upper: Upper bounds; None for no bound.
        velocity: Velocity limits [unit/s].
        jerk: Jerk limits [unit/s³].
        period: Control period [s], one over `--fps`.
        mode: "projection" or "slowdown".
        start: Position at which an episode starts at rest; by default the observation in the first transition. An
            observed start may be outside of the bounds if one step within the limits reaches the inside.
        names: Names of the A numbers, for actions and observations by name.
    """

    lower: list[float | None]
    upper: list[float | None]
    velocity: list[float]
    jerk: list[float]
    period: float
    mode: str = "projection"
    start: list[float] | None = None
    names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        try:
            from guiderail.models.primitives import LinearConstraints
            from guiderail_lerobot.chunk_guard import MIN_STEPS, ChunkGuard
        except ImportError as error:
            raise ImportError("the guard needs guiderail in this environment: pip install guiderail") from error
        lists = (self.lower, self.upper, self.velocity, self.jerk, *filter(None, [self.names]))
        sizes = {len(numbers) for numbers in lists}
        if len(sizes) != 1:
            raise ValueError("lower, upper, velocity, jerk and names have one entry for each number of an action")
        lower = np.array([-math.inf if bound is None else bound for bound in self.lower], float)
        upper = np.array([math.inf if bound is None else bound for bound in self.upper], float)
        box = LinearConstraints.box(lower, upper)
        self._min_steps = MIN_STEPS
        self._guard = ChunkGuard(
            box, self.velocity, self.jerk, period=self.period, start=box.nearest(np.zeros(len(lower))), mode=self.mode
        )
        self.is_fallback = False
        self.reset()

    def __call__(self, transition: Any) -> Any:
        """Return the transition with its action within the limits.

        Raises:
            ValueError: If the action has the wrong shape or names or is not finite, the start is unknown, `start` is
                outside of the bounds, or an observed start is so far outside that one step within the limits does not
                reach the inside.
        """
        action = transition.get(TransitionKey.ACTION)
        by_name = isinstance(action, dict)
        if by_name and (unknown := sorted(set(action) - set(self.names))):
            raise ValueError(f"the guard would drop the numbers {unknown} of an action: give limits and names for them")
        values = self._to_array(action) if by_name else np.asarray(torch.as_tensor(action).detach().cpu(), dtype=float)
        if not self._is_started:
            self._start_at(transition.get(TransitionKey.OBSERVATION))
            self._is_started = True
        size = len(self.velocity)
        is_single_batch = values.ndim == 1 or (values.ndim in (2, 3) and len(values) == 1)
        if not is_single_batch or values.shape[-1] != size or not values.size:
            raise ValueError(f"an action has the shape ({size},), (1, {size}) or (1, K, {size}), not {values.shape}")
        chunk = values.reshape(-1, size)
        number = len(chunk)
        num_steps = HORIZON if number == 1 else max(self._min_steps, number)
        padded = np.concatenate([chunk, np.tile(chunk[-1], (num_steps - number, 1))])
        result = self._guard.guard(padded, number)
        self.is_fallback = result.is_fallback
        limited = result.outputs[:number].reshape(values.shape)
        changed = transition.copy()
        changed[TransitionKey.ACTION] = (
            {name: float(value) for name, value in zip(self.names, limited, strict=True)}
            if by_name
            else torch.as_tensor(limited, dtype=action.dtype, device=action.device)
        )
        return changed

    def _to_array(self, numbers: Any) -> np.ndarray:
        """Return a dictionary's numbers in the order of `names`, (A,)."""
        missing = [name for name in self.names if name not in numbers]
        if missing or not self.names:
            raise ValueError(f"the guard needs the numbers {missing or 'of an action by name: give names'}")
        return np.array([float(numbers[name]) for name in self.names])

    def _start_at(self, observation: Any) -> None:
        if self.start is not None:
            self._guard.reset(np.array(self.start, float))
        elif isinstance(observation, dict):
            self._guard.reset_near(self._to_array(observation))
        else:
            raise ValueError("the guard needs the position at which the episode starts: give start")

    def reset(self) -> None:
        """Start an episode: the next action continues from the start at rest."""
        self._is_started = False

    def get_config(self) -> dict[str, Any]:
        """Return the attributes."""
        return asdict(self)

    def transform_features(self, features: Any) -> Any:
        """Return the features unchanged."""
        return features


def add_guard(policy: Path | str, **limits: Any) -> None:
    """Append a guard to the postprocessor of a stored policy.

    Args:
        policy: Folder of the policy.
        limits: Attributes of `ChunkGuardProcessorStep`.
    """
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
    from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME

    pipeline = PolicyProcessorPipeline.from_pretrained(
        str(policy),
        config_filename=f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    pipeline.steps = [*pipeline.steps, ChunkGuardProcessorStep(**limits)]
    pipeline.save_pretrained(policy)
