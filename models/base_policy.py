"""Base policies: frozen policies that predict chunks of commanded poses, which guidance takes as its reference.

A base policy is a function from an observation (n,) to the next K commanded outputs, one a control step: samples
(E, K, O) of an ensemble or of a generative model, one chunk (K, O), or a flat vector of either. A `Policy` whose
description has the entry `chunk`, [E, K, O], is one (`guiderail train --algorithm chunk`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry, did_you_mean
from guiderail.models.policy import Policy

BasePolicy = Callable[[np.ndarray], Any]

BASE_POLICIES: Registry[BasePolicy] = Registry("base policy", entry_points="guiderail.base_policies")
register_base_policy = BASE_POLICIES.register


def find_base_policy(source: str) -> BasePolicy:
    """Return the base policy of a registered name, or of a folder with `policy.safetensors`.

    Raises:
        InputError: If there is none, or the folder's policy predicts no chunks.
    """
    if source in BASE_POLICIES.names():
        return BASE_POLICIES.get(source)
    if not Path(source).is_dir():
        raise InputError(
            f"there is no base policy {source!r}: give the folder of a run of the learner chunk, or register one "
            f"({did_you_mean(source, BASE_POLICIES.names())})"
        )
    policy = Policy.load(source)
    if "chunk" not in policy.description:
        raise InputError(f"the policy in {source} predicts no chunks: train one with --algorithm chunk")
    return policy


def chunk_samples(policy: BasePolicy, observation: np.ndarray, num_outputs: int) -> np.ndarray:
    """Return the chunks (E, K, O) that a base policy predicts for an observation (n,).

    Raises:
        ValueError: If it does not return finite chunks of O outputs.
    """
    samples = np.asarray(policy(observation), dtype=float)
    chunk = getattr(policy, "description", {}).get("chunk", (1, -1, num_outputs))
    if samples.ndim == 1 and samples.size and samples.size % num_outputs == 0:
        samples = samples.reshape(chunk)
    while samples.ndim > 3 and len(samples) == 1:
        samples = samples[0]
    samples = samples[None] if samples.ndim == 2 else samples
    if samples.ndim != 3 or samples.shape[2] != num_outputs or not samples.size or not np.isfinite(samples).all():
        raise ValueError(
            f"the base policy returned an array of shape {samples.shape}, not finite chunks (E, K, {num_outputs})"
        )
    return samples


def mean_and_variance(samples: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and the variance of chunks (E, K, O) at the next points, each (num_points, O).

    The last point of a shorter chunk is repeated. Covariances between outputs are left out, because those of few
    samples are spurious. One sample has no variance.
    """
    points = np.minimum(np.arange(num_points), samples.shape[1] - 1)
    variances = samples.var(axis=0, ddof=1) if len(samples) > 1 else np.zeros(samples.shape[1:])
    return samples.mean(axis=0)[points], variances[points]
