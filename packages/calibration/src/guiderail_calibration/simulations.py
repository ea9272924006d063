"""Simulated episodes for draws of the prior or the posterior, stored so that a calibration can be resumed."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.tools.environments import make_environment, task_content
from guiderail.tools.evaluation.baselines import MakePolicy, zero_policy
from guiderail.tools.evaluation.forks import Forks, can_fork
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import has_constant_offset
from guiderail.tools.learning.run_folder import installed_versions
from guiderail.tools.progress import EpisodeProgress
from guiderail_calibration.parameters import Parameter, options_of
from guiderail_calibration.recordings import Episode

EPISODES = 5  # simulated episodes of each draw
BATCH = 24  # draws of a process before it is replaced: Drake does not free the diagrams of closed environments
PRIOR_SEED, POSTERIOR_SEED = 1, 2  # seeds of the draws
Prepare = Callable[[gymnasium.Env, int], Any]  # function from an environment and an episode's number to a callback


@dataclass(frozen=True)
class Simulator:
    """Simulator of a robot: an environment and a policy, with the parameters of a calibration."""

    task: str  # name of the task
    environment: Mapping[str, Any]  # options of the environment
    parameters: tuple[Parameter, ...]
    make_policy: MakePolicy = zero_policy  # function from an environment to the policy
    digest: str = "zero"  # digest of the policy
    prepare: Prepare | None = None  # returns a callback of each episode, such as a fault of a robot

    def key(self) -> str:
        """Return a digest of everything that stored simulations depend on."""
        priors = [(p.name, p.low, p.high, p.scale) for p in self.parameters]
        content = task_content(self.task, self.environment, ())
        parts = [self.task, dict(self.environment), priors, self.digest, installed_versions(), content]
        return hashlib.blake2b(json.dumps(parts, sort_keys=True, default=str).encode(), digest_size=6).hexdigest()

    def simulate(
        self, quantiles: np.ndarray, seed: int, episodes: int = EPISODES
    ) -> tuple[list[Episode], list[dict[str, Any]]]:
        """Simulate episodes of one robot; return their recordings and their rows.

        Args:
            quantiles: Quantiles (d,) of the parameters in their priors.
            seed: Seed of the first episode; episode i has seed + i.
            episodes: Number of episodes.
        """
        changes = options_of(self.task, self.environment, self.parameters, quantiles)
        environment = {**self.environment, **changes}
        recordings, rows = [], []
        with closing(make_environment(self.task, environment)) as env:
            # The hidden values of a run belong to the robot, and are sampled again for each one.
            env.reset(seed=seed, options={"new_run": True} if has_constant_offset(self.task, environment) else None)
            act = self.make_policy(env)
            for index in range(episodes):
                callbacks = () if self.prepare is None else (self.prepare(env, index),)
                rows.append(rollout(env, act, *callbacks, index=index, seed=seed + index, held_out=True))
                recordings.append(Episode.of_trace(env.unwrapped.trace))  # type: ignore[attr-defined]
        return recordings, rows


@dataclass(frozen=True)
class Simulated:
    """Simulated episodes of one draw."""

    quantiles: np.ndarray  # quantiles of the parameters in their priors, (d,)
    episodes: Sequence[Episode]
    success: np.ndarray  # True for a success, (n,)
    peak_force: np.ndarray  # (n,) [N]


def simulate_all(
    simulator: Simulator,
    folder: Path,
    quantiles: np.ndarray,
    *,
    episodes: int = EPISODES,
    seed: int = PRIOR_SEED,
    processes: int = 2,
    label: str = "simulations",
) -> list[Simulated]:
    """Return the simulated episodes of all draws; those stored in the folder are read, not simulated again.

    Args:
        simulator: Simulator.
        folder: Folder of the stored simulations, one file for each draw.
        quantiles: Draws, (n, d).
        episodes: Number of episodes of each draw.
        seed: Seed, to which the seeds of all episodes belong.
        processes: Number of processes.
        label: Label of the progress on standard error.

    Raises:
        InputError: If a file cannot be read or written.
        KilledError: If a process is killed.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be written ({error.strerror}): name another folder with --out") from error
    files = [folder / f"{index:05d}.npz" for index in range(len(quantiles))]
    missing = [index for index, file in enumerate(files) if not file.is_file()]

    def compute(index: int) -> tuple[int, dict[str, Any]]:
        first = int(np.random.default_rng([seed, index]).integers(2**30))
        recordings, rows = simulator.simulate(quantiles[index], first, episodes)
        _write(files[index], quantiles[index], recordings, rows)
        return index, rows[-1]

    if missing:
        with EpisodeProgress(len(quantiles), name=label, window=None) as progress:
            done = len(quantiles) - len(missing)
            for _, row in _forked(compute, missing, processes):
                progress.update({**row, "episode": done})
                done += 1
    return [_read(file) for file in files]


def _forked(compute: Callable[[int], Any], indices: Sequence[int], processes: int) -> Iterator[Any]:
    """Yield the results for all indices as they are complete, computed in processes that are replaced after a batch."""
    if not can_fork():
        yield from map(compute, indices)
        return
    size = BATCH * processes
    for start in range(0, len(indices), size):
        batch = list(indices[start : start + size])
        with closing(Forks(compute, min(processes, len(batch)))) as forks:
            running = 0
            while batch or running:
                while batch and forks.has_idle:
                    forks.submit(batch.pop(0))
                    running += 1
                results = forks.collect()
                running -= len(results)
                yield from results


def _write(file: Path, quantiles: np.ndarray, episodes: Sequence[Episode], rows: Sequence[Mapping[str, Any]]) -> None:
    content = io.BytesIO()
    np.savez(
        content,
        quantiles=quantiles,
        lengths=np.array([len(episode) for episode in episodes]),
        signals=np.concatenate([np.hstack([e.desired, e.pose, e.wrench]) for e in episodes]).astype(np.float32),
        success=np.array([bool(row["success"]) for row in rows]),
        peak_force=np.array([float(row["peak_force"]) for row in rows]),
    )
    write_atomically(file, content.getvalue())


def _read(file: Path) -> Simulated:
    try:
        with np.load(file, allow_pickle=False) as data:
            ends = np.cumsum(data["lengths"])
            parts = [np.split(rows, [6, 12], axis=1) for rows in np.split(data["signals"], ends[:-1])]
            return Simulated(data["quantiles"], [Episode(*part) for part in parts], data["success"], data["peak_force"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{file} is damaged: delete it, and the same command simulates it again") from error


def draw_prior(number: int, dimensions: int, seed: int = PRIOR_SEED) -> np.ndarray:
    """Return quantiles (number, dimensions) of draws of the prior; a larger number begins with the same draws."""
    return np.stack([np.random.default_rng([seed, index, 7]).uniform(size=dimensions) for index in range(number)])
