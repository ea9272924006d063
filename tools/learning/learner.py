"""Interface of a learner, the registry of learners, and the log of losses and values that they record.

A learner is one file: a subclass of `Learner` (or of `guiderail.tools.learning.off_policy.OffPolicyLearner`, for an
algorithm of Stable-Baselines3) that is registered by `register_learner` or by an entry point "learner:NAME"
of the group `guiderail`.
"""

from __future__ import annotations

import hashlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, cast

import gymnasium
import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass, is_pydantic_dataclass

from guiderail.diagrams.envs.options import Integer
from guiderail.models.common.errors import InputError, brief, require_extra
from guiderail.models.common.registry import Registry, check_class, check_methods, did_you_mean
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Callback, has_image

INTERFACE_OPTIONS = ("guidance", "observation")  # options on which the meaning of observation and action depends

LOG_FORMATS = ("tensorboard", "wandb", "csv", "json", "log", "stdout")
# Columns of an episode's row that are logged, and their names in the log.
LOGGED_COLUMNS = {
    "return": "rollout/return",
    "success": "rollout/success",
    "steps": "rollout/steps",
    "peak_force": "rollout/peak_force",
    "max_commanded_violation": "rollout/max_commanded_violation",
}


Positive = Annotated[Integer, Field(ge=1, le=10**9)]
NonNegative = Annotated[Integer, Field(ge=0, le=10**9)]
Symmetries = bool | Literal["near"]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LearnerConfig:
    """Base class of the learners' configurations: the settings that every learner has.

    A learner adds its own settings in a derived pydantic dataclass, which is its attribute `Config`. The training loop
    also reads the settings below that have no annotation here. A learner that supports one of them declares it as a
    field of its configuration.

    Attributes:
        algorithm: Registered name of the learner.
        stop_after_successes: Training ends early once the learner's own episodes succeeded this often in a row; 0:
            never. Resuming such a run runs no further episodes.
        demonstration_episodes: Number of episodes at the start in which a demonstrator acts; the learner trains on
            their transitions.
        demonstrator: Run or `pretrained:NAME` whose policy demonstrates; by default the task's scripted policy.
        symmetry: Symmetry data augmentation, for tasks that have a symmetry; "near" also uses approximate ones.
        num_envs: Number N of processes that simulate episodes while the main process learns. Episode k uses the
            weights learned from the episodes before k − N: the result depends on N, not on the timing. 0: simulate and
            learn in turn.
        takes_images: True if the learner's networks accept observations with images.
        entries: Names of the fields that are entries of a structured setting; see `Options.entries`.
    """

    takes_images: ClassVar[bool] = True
    entries: ClassVar[Mapping[str, str]] = {}

    algorithm: str
    stop_after_successes: NonNegative = 0

    demonstration_episodes = 0
    demonstrator = ""
    symmetry = cast("Symmetries", False)
    num_envs = 0


class Learner(Callback, ABC):
    """Base class of learners: acts in training episodes and learns from their transitions.

    The training loop constructs it as `Learner(config, env, action_repeat=…, seed=…, max_transitions=…, symmetry=…)`:
    the configuration, the environment (for its spaces), the control steps that an action lasts, the seed, the largest
    number of transitions of the run, and the task's `Symmetry` or None. It is a callback of every training episode:
    `on_episode_start`, then `act` and `on_step` for every transition, then `on_episode_end`, then `submit_episode`.

    Attributes:
        Config: Configuration class, a pydantic dataclass derived from `LearnerConfig`.
        stored: Names of the attributes that a resumed run continues from: arrays of at least one dimension, random
            generators, and JSON-serializable values. None if the learner has its own `state` and `restore`.
        records_metrics: True if `metrics` will be read; set by the training loop.
    """

    Config: ClassVar[type[LearnerConfig]] = LearnerConfig
    stored: ClassVar[tuple[str, ...] | None] = None
    records_metrics: bool = False

    @abstractmethod
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation.

        Args:
            observation: Observation, of the shape of the observation space.

        Returns:
            Action of the shape and in the units of the action space.
        """

    def submit_episode(self) -> None:
        """Submit the finished episode to training; called after the checkpoint, if it is due, has been written."""

    def finish(self) -> None:
        """Block until everything is learned; called after the last episode."""

    def close(self) -> None:
        """Release resources such as processes; called even if training fails."""

    def metrics(self) -> Mapping[str, float]:
        """Return scalars recorded since the last call, such as losses, by their names in a log."""
        return {}

    @abstractmethod
    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the learned policy; also called once before the first episode of a learner of another package.

        Args:
            description: Description of the policy: the observation's shape and the limits of an action. A learner may
                add entries; see `Policy`.
        """

    def has_diverged(self) -> bool:
        """Return True if a learned parameter is NaN or infinite; by default, if a stored array has such a number."""
        return not all(np.isfinite(array).all() for array in self.state()[0].values())

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from, by default `stored`; called between two episodes.

        Returns:
            Arrays of numbers by name (a 0-d array is restored with the shape (1,)), and JSON-serializable values.

        Raises:
            InputError: If `stored` is None and the class does not override this method.
        """
        if self.stored is None:
            raise InputError(f"{type(self).__name__} names nothing in stored, and has no state() and restore()")
        if missing := [name for name in self.stored if not hasattr(self, name)]:
            raise InputError(f"{type(self).__name__} has no attribute {missing[0]!r}, which it names in stored")
        own = {name: getattr(self, name) for name in self.stored}
        arrays = {name: value for name, value in own.items() if isinstance(value, np.ndarray)}
        values = {name: value for name, value in own.items() if name not in arrays}
        return arrays, {
            name: value.bit_generator.state if isinstance(value, np.random.Generator) else value
            for name, value in values.items()
        }

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`.

        Args:
            arrays: Arrays by name, of the shapes that `state` returned.
            values: Values by name.

        Raises:
            KeyError: If an entry is missing.
            RuntimeError, ValueError: If the state does not fit this learner.
        """
        for name in self.stored or ():
            if isinstance(generator := getattr(self, name), np.random.Generator):
                generator.bit_generator.state = values[name]
            else:
                setattr(self, name, arrays[name] if isinstance(generator, np.ndarray) else values[name])


def _check_learner(name: str, learner: Any) -> None:
    """Raise an InputError if a learner's name cannot name a file, or the learner has no class of settings."""
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise InputError(f"the name of a learner has letters, digits, '_', '-' and '.', unlike {brief(name)}")
    if isinstance(learner, type) and issubclass(learner, Learner):
        check_class(name, learner, Learner)
        for base in (Learner, Callback):
            check_methods(learner, base)
    config = getattr(learner, "Config", None)
    if not (isinstance(config, type) and issubclass(config, LearnerConfig) and is_pydantic_dataclass(config)):
        raise InputError(f"Config of {name} must be a pydantic dataclass based on LearnerConfig, not {brief(config)}")


# An entry is a class derived from `Learner`, or a callable with the same arguments and an attribute `Config`. PyTorch
# takes seconds to import: the plug-in "learner_config:NAME" is the `Config` without it.
LEARNERS: Registry[Any] = Registry(
    "algorithm", plugin="learner", check=_check_learner,
)  # fmt: skip
register_learner = LEARNERS.register


def describe_interface(env: gymnasium.Env) -> dict[str, Any]:
    """Return the entries of a policy's description for an environment's observations and actions."""
    space, actions = env.observation_space, cast(gymnasium.spaces.Box, env.action_space)
    image = getattr(space, "image_shape", None)
    described = {"observation_shape": list(space.shape or ())} | ({} if image is None else {"image_shape": list(image)})
    return described | {"action_low": actions.low.tolist(), "action_high": actions.high.tolist()}


def describe_policy(config: Any, env: gymnasium.Env) -> dict[str, Any]:
    """Return the description of a policy for the `RunConfig` of its run and the run's environment.

    `environment` has the options on which the meaning of observation and action depends, so that the policy can act in
    another task.
    """
    options = {key: config.environment[key] for key in INTERFACE_OPTIONS if key in config.environment}
    return {"task": config.task, **describe_interface(env), "environment": options}


def divergence_error() -> InputError:
    """Return the error for a learner that `has_diverged`."""
    return InputError("learning diverged: train again with other settings, such as a smaller --set learning_rate=...")


def learner_arguments(config: Any, task: Any) -> dict[str, Any]:
    """Return the keyword arguments of a learner for the `RunConfig` and the task of a run.

    If a supervisor or via-points correct the demonstrations, the symmetry is None.
    """
    if not config.learner.takes_images and has_image(task.observation_space):
        name = config.learner.algorithm
        raise InputError(f"{name} takes no images: give --env observation=... without one, or --algorithm tqc")
    symmetry = task.near_symmetry if config.learner.symmetry == "near" else task.symmetry
    is_corrected = config.human_in_the_loop or bool(config.environment.get("via_points"))
    return {
        "action_repeat": config.action_repeat,
        "seed": config.seed,
        "max_transitions": config.episodes * -(-task.num_steps // config.action_repeat),
        "symmetry": None if is_corrected else symmetry,
    }


def check_log_formats(formats: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of log formats; raise an InputError if one is unknown, or its package is not installed."""
    names = (formats,) if isinstance(formats, str) else tuple(formats)
    for name in names:
        if name not in LOG_FORMATS:
            raise InputError(f"there is no log format {brief(name)}: {did_you_mean(name, LOG_FORMATS)}")
    for package in {"tensorboard", "wandb"}.intersection(names):
        require_extra(package)
    return names


class LearningLog:
    """Learning log of a run in formats of Stable-Baselines3's logger, with an entry per episode.

    An entry has columns of the episode's row and the learner's metrics; its step is the number of control steps so far.
    Nothing is written if no format is given.
    """

    def __init__(self, folder: Path, formats: str | Sequence[str] = ()):
        """Construct the log, which opens files in `folder` at the first entry."""
        self._folder, self._formats = folder, check_log_formats(formats)
        self._logger: Any = None

    def record(
        self,
        rows: Sequence[Mapping[str, Any]],
        metrics: Callable[[], Mapping[str, float]],
        *,
        is_finished: bool = False,
    ) -> None:
        """Write the entry of the last episode.

        Args:
            rows: Rows of all episodes so far.
            metrics: Function that returns the learner's metrics, `Learner.metrics`.
            is_finished: True after the learner's `finish`; the entry then has only metrics, and none of the row.
        """
        if not self._formats:
            return
        row = rows[-1]
        entry = {} if is_finished else {name: row[column] for column, name in LOGGED_COLUMNS.items() if column in row}
        entry |= metrics()
        if not entry:
            return
        if self._logger is None:
            from stable_baselines3.common.logger import Logger, make_output_format  # imports PyTorch: slow

            # A resumed run must not overwrite the files of its first part.
            suffix = f"-from-{row['episode']}" if row["episode"] else ""
            self._folder.mkdir(parents=True, exist_ok=True)
            folder = str(self._folder.resolve())
            outputs = [
                _make_wandb_output(folder) if name == "wandb" else make_output_format(name, folder, suffix)
                for name in self._formats
            ]
            self._logger = Logger(str(self._folder), outputs)
        for name, value in entry.items():
            self._logger.record(name, value)
        self._logger.dump(sum(int(row["steps"]) for row in rows))

    def close(self) -> None:
        """Close the files."""
        if self._logger is not None:
            self._logger.close()


def _make_wandb_output(folder: str) -> Any:
    """Return an output format that logs to Weights & Biases; one folder always continues one W&B run."""
    import wandb
    from stable_baselines3.common.logger import KVWriter

    identifier = hashlib.blake2b(folder.encode(), digest_size=8).hexdigest()
    run = wandb.init(project="guiderail", name=Path(folder).parent.name, id=identifier, dir=folder, resume="allow")

    class WandbOutput(KVWriter):
        def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
            run.log(dict(key_values), step=step)  # a copy, because the logger clears the dictionary

        def close(self) -> None:
            run.finish()

    return WandbOutput()
