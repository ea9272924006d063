"""Policy that is evaluated or shown, with the configuration of its run or of the task that it acts in."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy, MakePolicy, make_baseline
from guiderail.tools.evaluation.cache import policy_digest
from guiderail.tools.evaluation.policies import (
    as_policy,
    check_compatible,
    is_policy_file,
    learned_policy,
    load_policy,
)
from guiderail.tools.evaluation.scope import default_baselines
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.pretrained import PRETRAINED, find_run


@dataclass(frozen=True)
class Subject:
    """Policy that is evaluated or shown.

    Attributes:
        name: Name of the policy.
        config: Configuration of its run; of no run, one with the environment it acts in; None in an environment that is
            given as an object.
        make_policy: Makes the policy for an environment.
        folder: Its run, or None.
        is_stored: Whether evaluated episodes are stored in the run's folder.
        digest: Digest of the policy, for the names of stored files; None for a baseline policy.
    """

    name: str
    config: RunConfig | None
    make_policy: MakePolicy
    folder: RunFolder | None = None
    is_stored: bool = False
    digest: str | None = None


def find_subject(
    policy: Any, env: Any, environment: Mapping[str, Any] | None = None, *, trust_policy: bool = False
) -> Subject:
    """Return a policy that is evaluated or shown.

    Args:
        policy: Folder of a run, or `pretrained:NAME`. With `env`: any policy that `load_policy` or `as_policy` takes,
            or the name of a baseline policy.
        env: Name of the task, or an environment, that a policy without a run acts in; None for a run.
        environment: Options of the task's environment that differ from the defaults; unused for a run.
        trust_policy: Read a policy's file that can execute code.

    Raises:
        InputError: If there is no such policy or task, or a policy without a run has no task.
    """
    if env is None:
        if not isinstance(policy, Path | str) or is_policy_file(policy):
            raise InputError("a policy without a run acts in a task: name it (--task)")
        folder = RunFolder(find_run(policy))
        run_config = folder.config()
        make_policy = learned_policy(folder.path, run_config.environment)
        is_stored = not str(policy).startswith(PRETRAINED)
        return Subject(folder.path.name, run_config, make_policy, folder, is_stored, policy_digest(folder))
    from guiderail.tools.learning.train import configure

    config = None if isinstance(env, gymnasium.Env) else configure(env, environment or {})
    if not isinstance(policy, Path | str):
        act = as_policy(policy)
        unknown = str(time.time_ns())  # a function has no digest, so that its stored episodes are never used again
        if act is policy:
            return Subject("policy", config, lambda env: act, digest=unknown)
        return Subject("policy", config, partial(check_compatible, act), digest=unknown)
    source = find_run(policy)
    if is_policy_file(policy) or source.is_dir():
        make_policy = partial(check_compatible, load_policy(source, trust_policy=trust_policy))
        return Subject(source.name.replace(":", "."), config, make_policy, digest=_digest(source))
    return Subject(str(policy), config, make_baselines(config, {}, [str(policy)])[str(policy)])


def _digest(source: Path) -> str:
    """Return the digest of a policy's folder or file; a new one for a function, which may use other files."""
    file = source / "policy.safetensors" if source.is_dir() else source
    if not file.is_file():
        return str(time.time_ns())
    return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()


def make_baselines(
    config: RunConfig | None, environment: Mapping[str, Any], baselines: Mapping[str, MakePolicy] | Sequence[str] | None
) -> Mapping[str, MakePolicy]:
    """Return the functions that make baseline policies, by name.

    Args:
        config: Configuration of the run or of the task; None in an environment that is given as an object.
        environment: Options of the environment.
        baselines: Names, or the functions themselves; None for the default set.

    Raises:
        InputError: If a name is unknown.
    """
    if isinstance(baselines, Mapping):
        return baselines
    if config is not None:
        names = default_baselines(config.task, environment) if baselines is None else baselines
        return {name: make_baseline(config.task, name, config.seed) for name in names}
    names = ["zero", "uniform_random", "constant"] if baselines is None else baselines
    for name in names:
        if name not in BASELINES:
            raise InputError(f"there is no baseline policy {name!r}: {did_you_mean(name, BASELINES)}")
    return {name: partial(BaselinePolicy, BASELINES[name]) for name in names}
