"""`guiderail record`: what a policy does, as demonstrations that a primitive can learn from."""

from pathlib import Path
from typing import Any, cast

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.models.primitives import Demonstrations
from guiderail.tools.datasets.paths import check_new
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import check_seed, rollout
from guiderail.tools.learning.run_folder import RunFolder

SIGNALS = ("commanded", "measured")


def record(run: Path, out: Path, *, episodes: int = 5, signal: str = "commanded", seed: int = 1_000_000) -> Path:
    """Writes the successful held-out episodes of a run's policy as demonstrations.

    The commanded poses are what a primitive should learn under impedance control: the push on a contact lives in the
    difference between them and the measured ones.

    Args:
        run: the run's folder.
        out: the file, .npz or .csv; it must not exist.
        episodes: how many demonstrations.
        signal: "commanded" or "measured" poses.
        seed: of the first episode's initial conditions.

    Raises:
        InputError: if an argument makes no sense, or the policy succeeds too seldom to demonstrate anything.
    """
    if signal not in SIGNALS:
        raise InputError(f"there is no signal {signal!r} to record: choose one of {', '.join(SIGNALS)}")
    if episodes < 1:
        raise InputError(f"a recording needs at least one episode, not {episodes}")
    check_seed(seed)
    if out.suffix not in (".npz", ".csv"):
        raise InputError(f"{out} has the ending {out.suffix!r}: demonstrations are .npz or .csv")
    check_new(out, "file")
    config, policy = RunFolder(run).config(), Policy.load(run)
    env = make_environment(config.task, config.environment)
    env.reset(seed=config.seed)
    times, outputs = [], []
    for index in range(4 * episodes):
        row = rollout(env, policy, seed=seed + index, held_out=True)
        trace = cast(Any, env.unwrapped).trace
        if row["success"]:
            outputs.append(getattr(trace, signal).copy())
            times.append(trace.period * np.arange(1, len(trace) + 1))
        if len(outputs) == episodes:
            break
    env.close()
    if len(outputs) < episodes:
        raise InputError(f"{run} succeeded {len(outputs)} times in {4 * episodes} episodes: train it further first")
    Demonstrations(times, outputs).save(out)
    return out
