"""Fuzzing of pouring: noisy, random and adversarial inputs.

Collisions are counted at every plant step. The thermos must not be commanded to tilt in the template's first state.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.tasks.pouring import MAX_MUG_OFFSET, scripted_pour
from guiderail.models.common.transforms import pose_to_transform
from guiderail.tools.evaluation.baselines import BaselineFactory, bang_bang, uniform_random
from guiderail.tools.evaluation.episode import EnvCallback, PolicyFn
from guiderail.tools.evaluation.metrics import TOLERANCE
from research.action_fuzzing.campaign import Campaign, Case


class EarlyTilt(EnvCallback):
    """Callback that records the largest commanded tilt in the template's first state, which requires no tilt."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return `early_tilt` [rad] over all control steps; 0 if the template was never in its first state."""
        trace = self.base.trace
        upright = trace.commanded[trace.signals["state"][:, 0] == 0]
        return {"early_tilt": max(map(_tilt, upright), default=0.0)}


def _tilt(pose: np.ndarray) -> float:
    """Return the angle between the thermos's axis and the vertical [rad], for a pose (6,) of the thermos."""
    R = pose_to_transform(pose).rotation().matrix()
    return float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))


PolicyMaker = Callable[[np.random.Generator], PolicyFn]
"""Function from a random generator to a policy of the three inputs."""


def noisy_pour(rng: np.random.Generator, spread: float = 1.5) -> PolicyFn:
    """Return the scripted policy with Gaussian noise of standard deviation `spread`; its own inputs are at most 1."""
    return lambda observation: np.clip(scripted_pour(observation) + spread * rng.normal(size=3), -1.0, 1.0)


def random_walk(rng: np.random.Generator) -> PolicyFn:
    """Return a policy of inputs ±1 that are resampled with probability 0.1: longer moves reach the whole workspace."""
    action = np.sign(rng.normal(size=3))

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal action
        if rng.uniform() < 0.1:
            action = np.sign(rng.normal(size=3))
        return action

    return act


def noisy_approach(rng: np.random.Generator) -> PolicyFn:
    """Return a policy of noisy inputs towards the mug."""

    def act(observation: np.ndarray) -> np.ndarray:
        towards = -observation[:3] / np.linalg.norm(observation[:3])
        return np.clip(rng.uniform(0.5, 2.0) * towards + 0.6 * rng.normal(size=3), -1.0, 1.0)

    return act


def noisy_press(rng: np.random.Generator) -> PolicyFn:
    """Return a policy that presses down on the table with random sideways inputs."""

    def act(observation: np.ndarray) -> np.ndarray:
        return np.array([*np.clip(rng.normal(size=2), -1.0, 1.0), -1.0])

    return act


ADVERSARIES: dict[str, PolicyMaker] = {
    "noisy_pour": noisy_pour,
    "random_walk": random_walk,
    "noisy_approach": noisy_approach,
    "noisy_press": noisy_press,
    "uniform_random": lambda rng: uniform_random(rng, 3),
}


def _three_inputs(make: PolicyMaker) -> BaselineFactory:
    """Return the adversary for the template's three inputs, and `bang_bang` for the six velocities without guidance."""
    return lambda rng, size: make(rng) if size == 3 else bang_bang(rng, size)


def campaign() -> Campaign:
    """Return the campaign: every adversary with a displaced mug, through the template and without guidance."""
    return Campaign(
        "Pouring",
        [
            # With a large mug offset, random inputs reach joint limits, where the last command is repeated.
            Case("sct", {"guidance": "sct", "mug_offset": MAX_MUG_OFFSET}, constrained=True, may_wait=True),
            Case("none", {"guidance": "none", "mug_offset": MAX_MUG_OFFSET}, constrained=False, limits={}),
        ],
        {"collisions": 0, "early_tilt": TOLERANCE},
        make_callback=EarlyTilt,
        actions={name: _three_inputs(make) for name, make in ADVERSARIES.items()},
        frames=lambda sampled: {"mug_tip": RigidTransform([*sampled["mug_position"], 0.0])},
    )
