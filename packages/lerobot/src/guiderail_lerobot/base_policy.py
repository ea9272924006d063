"""Base policies: functions that predict chunks of commanded poses, which guidance uses as its reference.

A base policy is a function from an
observation (n,) to chunks of the next K commands with O outputs, one command per control step. It returns E samples
(E, K, O) of an ensemble or of a generative model, one chunk (K, O), or one chunk as a flat vector. A `Policy` whose
description has the entry `chunk`, [E, K, O], is a base policy (`guiderail train --algorithm chunk`); it returns samples
as a flat vector.
"""

from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry, check_callable, did_you_mean
from guiderail.models.policy import Policy

BasePolicy = Callable[[np.ndarray], Any]

BASE_POLICIES: Registry[BasePolicy] = Registry("base policy", plugin="base_policy", check=check_callable)
register_base_policy = BASE_POLICIES.register


def find_base_policy(source: str) -> BasePolicy:
    """Return the base policy of a registered name, or of a folder with `policy.safetensors`.

    Raises:
        InputError: If there is no base policy `source`, or the folder's policy predicts no chunks.
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
        ValueError: If the policy does not return finite chunks of `num_outputs` (O) outputs.
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
    """Return mean and variance over the samples of chunks (E, K, O) at the next points, each (num_points, O).

    If the chunks have fewer than `num_points` points, their last point is repeated. Covariances between outputs are
    left out, because estimates from few samples are spurious. The variance of a single sample is zero.
    """
    points = np.minimum(np.arange(num_points), samples.shape[1] - 1)
    variances = samples.var(axis=0, ddof=1) if len(samples) > 1 else np.zeros(samples.shape[1:])
    return samples.mean(axis=0)[points], variances[points]


def add_base_policy(source: str) -> str:
    """Return the name of a base policy; register it first if it is given as a file or `module:function`.

    Another source, such as the folder of a run, is returned unchanged.

    Raises:
        InputError: If the source can execute code and `trust_imports` is not active, or the policy cannot be loaded.
    """
    if source in BASE_POLICIES.names():
        return source
    from guiderail.tools.evaluation.policies import function_of, is_policy_file, load_policy  # imports Drake
    from guiderail.tools.imports import is_trusted

    if not is_policy_file(source):
        return source
    module, separator, function = source.rpartition(":") if function_of(source) is not None else (source, "", "")
    path = module if separator and not module.endswith(".py") else str(Path(module).resolve())
    name = path + separator + function
    if name not in BASE_POLICIES.names():
        if Path(source).suffix != ".onnx" and not is_trusted():
            raise InputError(f"the base policy {source} can execute code: give --trust-imports if you trust its origin")
        BASE_POLICIES.register(name, load_policy(source, trust_policy=True))
    return name


def base_policy_key(source: str | None) -> Hashable:
    """Return a key that changes if another policy replaces the base policy `source`; None without a base policy."""
    if not source:
        return None
    if source in BASE_POLICIES.names():
        return id(BASE_POLICIES.get(source))  # unique, because a diagram with this policy is never freed
    file = (Path(source) / "policy.safetensors").stat()
    return file.st_ino, file.st_mtime_ns, file.st_size
