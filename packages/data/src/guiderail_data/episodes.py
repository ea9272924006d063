"""Data sets of a policy's episodes: Minari for offline learning, LeRobot for imitation with forces."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from guiderail.diagrams.tasks.registry import environment_id
from guiderail.models.common.errors import InputError, brief, import_extra
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.transforms import POSE_NAMES, WRENCH_NAMES
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import Callback, EnvCallback, Transition
from guiderail.tools.evaluation.evaluate import check_num_episodes
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.files import check_new
from guiderail_data.formats.lerobot import Feature, write_features

FORMATS = ("lerobot", "minari")


def record_episodes(
    policy: Path | str,
    out: str,
    kind: str,
    *,
    task: str | None = None,
    environment: Mapping[str, Any] | None = None,
    episodes: int = 50,
    seed: int = 0,
) -> dict[str, Any]:
    """Run a policy in the conditions of training, and write its episodes as a data set.

    Args:
        policy: Run, `pretrained:NAME`, or the name of a baseline or scripted policy with `task`.
        out: LeRobot: folder to write. Minari: identifier of the data set, such as "guiderail/clamp/scripted-v0"; Minari
            stores it in the folder that the variable MINARI_DATASETS_PATH names.
        kind: "lerobot" or "minari".
        task: Task of a policy without a run.
        environment: Options of the environment that differ from the run's, or from the task's defaults.
        episodes: Number of episodes.
        seed: Seed of the first episode; episode i has seed + i.

    Returns:
        `out`, `to`, `episodes`, `control_steps` of all episodes, and `success_rate`.

    Raises:
        InputError: If a name is unknown, Minari is not installed, or the data set exists.
    """
    if kind not in FORMATS:
        raise InputError(f"there is no format {kind!r}: {did_you_mean(kind, FORMATS)}")
    subject = find_subject(policy, task, environment)
    if subject.config is None:
        raise InputError("episodes are recorded in a task of guiderail: name it with --task")
    config, number = subject.config, check_num_episodes(episodes)
    options = subject.changed_environment(environment or {})
    write = _write_minari if kind == "minari" else _write_lerobot
    rows = write(out, config.task, options, subject, number, seed)
    success = float(np.mean([row["success"] for row in rows]))
    steps = sum(int(row["steps"]) for row in rows)
    return {"out": out, "to": kind, "episodes": number, "control_steps": steps, "success_rate": success}


class _Buffers(Callback):
    """Callback that records episodes for Minari; its own collector would need JAX."""

    def __init__(self, env: Any, make_buffer: Any):
        self.episodes: list[Any] = []
        self._env, self._make_buffer = env, make_buffer
        self._transitions: list[Transition] = []

    def on_episode_start(self) -> None:
        self._transitions = []

    def on_step(self, transition: Transition) -> None:
        self._transitions.append(transition)

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        steps = self._transitions
        observations = [steps[0].observation, *(step.next_observation for step in steps)]
        buffer = self._make_buffer(
            id=len(self.episodes),
            observations=np.array(observations),
            actions=np.array([step.action for step in steps], self._env.action_space.dtype),
            rewards=[step.reward for step in steps],
            terminations=[step.terminated for step in steps],
            truncations=[step.truncated for step in steps],
            infos=None,
        )
        self.episodes.append(buffer)
        return {}


class _Signals(EnvCallback):
    """Callback that adds commanded and measured poses and the wrench of all control steps to the row of an episode."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        trace = self.base.trace
        signals = {"action": trace.commanded, "observation.state": trace.measured}
        if "wrench" in trace.signals:
            signals["observation.wrench"] = trace.signals["wrench"]
        return {name: values.copy() for name, values in signals.items()}


def _run(env: gymnasium.Env[Any, Any], config: Any, subject: Any, episodes: int, seed: int, *more: Callback) -> Any:
    """Yield the rows of a policy's episodes."""
    env.reset(seed=config.seed)  # samples the hidden values of the run
    act = subject.make_policy(env)
    for number in range(episodes):
        if hasattr(act, "start_episode"):
            act.start_episode(number)
        yield rollout(env, act, *more, index=number, seed=seed + number)


def _write_lerobot(
    out: str, task: str, options: Mapping[str, Any], subject: Any, episodes: int, seed: int
) -> list[dict[str, Any]]:
    """Write commanded and measured poses and the wrench of every control step."""
    folder = Path(out)
    check_new(folder, "folder")
    with closing(make_environment(task, options)) as env:
        rows = list(_run(env, subject.config, subject, episodes, seed, _Signals(env)))
        base: Any = env.unwrapped
        period = float(base.trace.period)
    names = {"action": POSE_NAMES, "observation.state": POSE_NAMES, "observation.wrench": WRENCH_NAMES}
    signals = {}
    for name in (name for name in names if name in rows[0]):
        size = rows[0][name].shape[1]
        named = names[name] if len(names[name]) == size else tuple(f"y{i + 1}" for i in range(size))
        signals[name] = Feature(tuple(named), [row[name] for row in rows])
    write_features(folder, signals, period, f"guiderail {task}")
    return rows


def _write_minari(
    out: str, task: str, options: Mapping[str, Any], subject: Any, episodes: int, seed: int
) -> list[dict[str, Any]]:
    """Write observations, actions, rewards and ends of every action."""
    minari = import_extra("minari")
    try:
        exists = minari.storage.get_dataset_path(out).exists()
        minari.dataset.minari_dataset.parse_dataset_id(out)
    except ValueError as error:
        raise InputError(
            f"{brief(out)} is no identifier of a data set: give one such as guiderail/clamp/scripted-v0"
        ) from error
    if exists:
        raise InputError(f"Minari has a data set {out}: give another identifier, or minari delete {out}")
    plain: dict[str, Any] = {
        name: list(value) if isinstance(value, tuple) else value for name, value in options.items()
    }
    with closing(gymnasium.make(environment_id(task), **plain)) as env:
        buffers = _Buffers(env, minari.data_collector.EpisodeBuffer)
        rows = list(_run(env, subject.config, subject, episodes, seed, buffers))
        minari.create_dataset_from_buffers(
            dataset_id=out,
            buffer=buffers.episodes,
            env=env,
            algorithm_name=subject.name,
            author="guiderail",
            author_email="unknown",
            code_permalink="unknown",
            description=f"Episodes of {subject.name} in {environment_id(task)}.",
            requirements=["guiderail"],
            data_format="arrow",
        )
    return rows
