"""Duration of gradient steps compared with Stable-Baselines3: `python -m research.benchmarks learner`.

Durations are CPU times of one core. The two learners alternate, and the ratio is the median over the turns. An
observation has 13 entries and an action 2, as in the connector task.

Fractions of Stable-Baselines3's time, for TQC with the preset `tqc_contact` (two critics of 128 by 128 units, 25
quantiles, batches of 64):
- 0.20 to 0.25 with hand-written gradients, as implemented
- 0.39 with critics batched in PyTorch's autograd, flat parameters and a fused optimizer

Factors by which a change multiplies the duration with hand-written gradients:
- 1.02 to 1.08 if PyTorch instead of NumPy sorts the quantiles
- 0.96 to 1.05 if the memory of the quantile errors is preallocated
- 1.05 to 1.08 if a matrix product sums the quantile errors
- 40 with two threads on busy cores, because waiting threads spin

With large batches and layers, the matrix products dominate: for SAC with 256 by 256 units and batches of 256
(`table_4_1_simulation`), the fraction is 0.68.
"""

import time
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC

from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import register_learner
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.off_policy import OffPolicyLearner, SacLearner, TqcLearner
from research.benchmarks import with_progress


@register_learner("plain_sac")
class PlainSac(OffPolicyLearner):
    """SAC with the gradient step of Stable-Baselines3."""

    algorithm = SAC


@register_learner("plain_tqc")
class PlainTqc(OffPolicyLearner):
    """TQC with the gradient step of sb3-contrib."""

    algorithm = TQC


PRESETS = ("tqc_contact", "sac_gridclamp", "tqc_fast", "table_4_1_simulation")
REQUIRED_RATIO = 2.5  # smallest accepted `times_faster` of the result `REQUIRED_OF`
REQUIRED_OF = "tqc tqc_contact"
TURNS = 8  # number of timed turns of each learner, after a turn that is not timed
_TRANSITIONS = 2000  # transitions in the replay buffer


class _Spaces(gymnasium.Env):
    """Environment with the spaces of the connector; only these are used."""

    observation_space = spaces.Box(-10.0, 10.0, (13,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)


LEARNERS: dict[str, tuple[type[OffPolicyLearner], type[OffPolicyLearner]]] = {
    "tqc": (PlainTqc, TqcLearner),
    "sac": (PlainSac, SacLearner),
}


def measure(turns: int = TURNS) -> dict[str, Any]:
    """Measure the CPU time of a gradient step [ms] by algorithm and preset, and its ratio to Stable-Baselines3."""
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for algorithm, preset in with_progress(
        [(algorithm, preset) for algorithm in LEARNERS for preset in PRESETS], "learner"
    ):
        results[f"{algorithm} {preset}"] = _compare(algorithm, preset, turns)
    results["fast_enough"] = results[REQUIRED_OF]["times_faster"] >= REQUIRED_RATIO
    return results


def _compare(algorithm: str, preset: str, turns: int) -> dict[str, float]:
    plain, ours = (_with_transitions(kind, preset) for kind in LEARNERS[algorithm])
    seconds = np.array([[_seconds(learner) for learner in (plain, ours)] for _ in range(1 + turns)])[1:]
    plain_ms, ours_ms = 1e3 * np.median(seconds, axis=0)
    ratio = float(np.median(seconds[:, 0] / seconds[:, 1]))
    return {"stable_baselines3_ms": float(plain_ms), "step_ms": float(ours_ms), "times_faster": ratio}


def _seconds(learner: OffPolicyLearner) -> float:
    """Return the CPU time of a gradient step [s]."""
    start = time.process_time()
    learner.model.train(learner.config.gradient_steps, learner.config.batch_size)
    return (time.process_time() - start) / learner.config.gradient_steps


def _with_transitions(kind: type[OffPolicyLearner], preset: str) -> OffPolicyLearner:
    """Return a learner with a filled replay buffer."""
    settings: Any = resolve_preset(preset, "tqc", {"symmetry": False})
    learner = kind(settings, _Spaces(), action_repeat=10, seed=0, max_transitions=_TRANSITIONS)
    random = np.random.default_rng(0)
    for index in range(_TRANSITIONS):
        observation, following = random.standard_normal((2, 13)).astype(np.float32)
        action = random.uniform(-1, 1, 2).astype(np.float32)
        reward, is_terminated = float(random.standard_normal()), index % 50 == 49
        learner.store(Transition(observation, action, reward, following, is_terminated, False, {}))
    return learner


def show(results: dict[str, Any]) -> None:
    """Print the results."""
    for name, row in results.items():
        if isinstance(row, dict):
            needed = f" (at least {REQUIRED_RATIO})" if name == REQUIRED_OF else ""
            print(
                f"{name:26s}  {row['step_ms']:6.2f} ms per gradient step, Stable-Baselines3 "
                f"{row['stable_baselines3_ms']:6.2f} ms: {row['times_faster']:.1f} times faster{needed}"
            )
