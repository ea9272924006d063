"""Configuration of learners: the settings, named presets, and their validation.

A learner names its configuration class as `Learner.Config`, a pydantic dataclass derived from `LearnerConfig`. A
setting given by `--set name=value` is validated against that class.
"""

import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, cast

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from guiderail.diagrams.envs.options import Integer, Number, entries_of, flat_options, option_fields
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean, find_plugins
from guiderail.tools.learning.learner import LEARNERS, LearnerConfig, NonNegative, Positive, Symmetries
from guiderail.tools.pretrained import PRETRAINED

DEFAULT_PRESET = "tqc_contact"
MAX_EPISODES = 10**9  # largest number of episodes of a run


def _check_ent_coef(ent_coef: str) -> str:
    initial = ent_coef.removeprefix("auto_")
    if ent_coef != "auto" and not 0 < float(initial) < math.inf:
        raise ValueError("it must be auto, auto_<initial value> or a positive number")
    return ent_coef


def _absolute(run: str) -> str:
    return run if not run or run.startswith(PRETRAINED) else str(Path(run).resolve())


# Upper bounds exclude values that would exhaust memory or never finish.
BatchSize = Annotated[Integer, Field(ge=1, le=10**6)]
NumUnits = Annotated[Integer, Field(ge=1, le=10**4)]
Fraction = Annotated[Number, Field(ge=0, le=1)]
Dropout = Annotated[Number, Field(ge=0, lt=1)]
Factor = Annotated[Number, Field(gt=0, le=1)]
Noise = Annotated[Number, Field(ge=0, le=10)]
Rate = Annotated[Number, Field(gt=0, allow_inf_nan=False)]
EntCoef = Annotated[str, BeforeValidator(str), AfterValidator(_check_ent_coef)]
# The path is made absolute, so that a run can be resumed from another working directory.
RunName = Annotated[str, AfterValidator(_absolute)]
NetArch = Annotated[
    tuple[NumUnits, ...],
    Field(min_length=1, max_length=20),
    BeforeValidator(lambda v: v.split(",") if isinstance(v, str) else v),
]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OffPolicyConfig(LearnerConfig):
    """Settings of an off-policy learner, by the names of Stable-Baselines3 where it has them.

    An action of the policy lasts `action_repeat` control steps and makes one transition.
    """

    entries: ClassVar[Mapping[str, str]] = {
        "gamma_per": "gamma.per",
        **entries_of("net_arch", "layer_norm", "dropout", "image_encoder"),
        **entries_of("exploration", "constant_episodes", "ez_greedy", "ez_greedy_longest", "ez_greedy_until"),
        **entries_of("exploration", "greedy_episode_fraction", "base_motion_steps"),
        "selection_window": "selection.window",
        "actor_ema": "selection.actor_ema",
    }

    algorithm: str = "tqc"  # registered name of the learner
    demonstration_episodes: NonNegative = 0  # first episodes, in which a demonstrator acts
    demonstrator: RunName = ""  # run or pretrained:NAME whose policy demonstrates; default: the scripted policy
    symmetry: Symmetries = False  # symmetry data augmentation; "near" also uses approximate symmetries of the task
    num_envs: Annotated[NonNegative, Field(le=1024)] = 0  # processes that simulate episodes; 0: only this one
    learning_rate: Rate = 3e-4  # learning rate of actor, critics and entropy coefficient
    gamma: Factor = 0.995  # discount factor per `gamma_per`
    gamma_per: Literal["control_step", "action"] = "control_step"  # interval that gamma discounts
    tau: Factor = 0.02  # Polyak factor of the target critics per gradient step
    train_freq: Positive = 8  # transitions between two trainings
    gradient_steps: Positive = 24  # gradient steps per training
    batch_size: BatchSize = 64  # transitions
    buffer_size: Positive = 1_000_000  # transitions in the replay buffer
    learning_starts: Positive = 100  # transitions before the first training; until then, actions are random
    ent_coef: EntCoef = "auto_0.1"  # "auto", "auto_<initial value>", or a number
    net_arch: NetArch = (256, 256)  # units of the hidden layers
    constant_episodes: NonNegative = 0  # episodes after the demonstrations, each of which repeats one random action
    ez_greedy: Fraction = 0.0  # probability that an exploring action starts a temporally extended action (εz-greedy)
    ez_greedy_longest: Positive = 8  # maximum number of actions that an extended action lasts
    ez_greedy_until: NonNegative = 0  # greedy successes in a row that pause εz-greedy until a greedy failure; 0: never
    greedy_episode_fraction: Fraction = 0.0  # fraction of the episodes, evenly spread, that do not explore
    privileged_critic: bool = False  # critics also observe hidden values and the exact wrench; the policy never does
    layer_norm: bool = False  # normalize hidden layers before their activation
    selection_window: NonNegative = 0  # maximum greedy successes counted before and after an actor; 0: last actor
    actor_ema: Fraction = 0.003  # weight of the newest actor in the averaged actor per gradient step; 0 for no average
    base_motion_steps: NonNegative = 0  # transitions over which the probability of a zero action falls from 1 to 0
    demonstration_fraction: Fraction = 0.0  # fraction of each batch from demonstrations (RLPD: 0.5); 0: no mixing
    image_encoder: Literal["average_pooling", "convolutional", "pixels"] = "average_pooling"  # features of images
    device: Literal["cpu", "cuda"] = "cpu"  # device that learns; only "cpu" gives the same result bit for bit
    dropout: Dropout = 0.0  # dropout probability of the critics' layers, before normalization (DroQ: 0.01)
    init_from: RunName = ""  # run whose networks, optimizers, replay buffer and episode count training starts from

    def __post_init__(self) -> None:
        if self.demonstration_fraction and not self.demonstration_episodes:
            raise InputError("demonstration_fraction needs demonstrations: give --set demonstration_episodes=... too")
        if self.demonstrator and not self.demonstration_episodes:
            raise InputError("demonstrator acts in the demonstrations: give --set demonstration_episodes=... too")
        if self.init_from and self.demonstration_episodes:
            raise InputError("demonstration_episodes does not work with init_from: leave one of them out")
        if self.device == "cuda" and self.num_envs:
            raise InputError("parallel actors are forks, which cannot use cuda: leave num_envs or device=cuda out")
        if self.dropout and self.algorithm == "crossq":
            raise InputError(
                "crossq has no dropout, which replaces its batch normalization: leave "
                f"net_arch.dropout={self.dropout:g} out"
            )


_TABLE_4_1 = OffPolicyConfig(
    learning_rate=1e-3, gamma=0.99, gradient_steps=8, batch_size=256, ent_coef="auto", actor_ema=0.0
)  # table 4.1 of the thesis has no batch size and no buffer size; both are from table 3.2
_TABLE_3_2 = replace(_TABLE_4_1, learning_rate=8e-4, gamma=0.95, gamma_per="action", learning_starts=1000)
_FAST = OffPolicyConfig(learning_rate=1e-3, gamma=0.998, gradient_steps=8, ent_coef="auto")

# The measurements behind each preset are in research/experiments.md.
PRESETS = {
    # Contact makes learning oscillate. Small batches, a moderate learning rate and layer normalization reduce the
    # oscillation. Greedy episodes train the critics on returns of the mean action. Checkpoint selection exports the
    # actor in the middle of a long streak of greedy successes.
    "tqc_contact": OffPolicyConfig(
        learning_rate=3e-4,
        train_freq=4,
        gradient_steps=16,
        net_arch=(128, 128),
        layer_norm=True,
        constant_episodes=8,
        greedy_episode_fraction=0.8,
        symmetry=True,
        selection_window=8,
        actor_ema=0.003,
    ),
    # The force cost is learned long before a success, so policies avoid contact. A large entropy coefficient and
    # temporally extended actions restore contact. Extended actions cause the largest forces, so they pause while greedy
    # episodes succeed.
    "sac_gridclamp": OffPolicyConfig(
        algorithm="sac",
        learning_rate=7e-4,
        gamma=0.99,
        gamma_per="action",
        train_freq=4,
        gradient_steps=48,
        learning_starts=200,
        ent_coef="auto_2.0",
        net_arch=(128, 128),
        layer_norm=True,
        ez_greedy=0.1,
        ez_greedy_until=3,
        greedy_episode_fraction=0.75,
        actor_ema=0.002,
    ),
    # Learns the narrow passage within a minute.
    "tqc_fast": _FAST,
    # sKGRL low-pass filters actions: actions resampled at every transition average out and seldom avoid an obstacle.
    "tqc_cheap_correlated": replace(_FAST, constant_episodes=10),
    "table_4_1_simulation": _TABLE_4_1,
    "table_4_1_robot": replace(_TABLE_4_1, tau=0.01, gamma=0.995, ent_coef="auto_0.1"),
    "table_3_2_iiwa": _TABLE_3_2,
    # An episode of pouring has at most 150 transitions: 1000 uniformly random ones would take at least seven episodes.
    "pouring": replace(_TABLE_3_2, learning_starts=300),
    "table_3_2_sara": replace(_TABLE_3_2, algorithm="sac", learning_rate=1e-3, gamma=0.98),
}


def action_gamma(config: Any, action_repeat: int) -> float:
    """Return the discount factor of an action that lasts `action_repeat` control steps.

    `config` has the settings `gamma` and `gamma_per` of `OffPolicyConfig`.
    """
    return float(config.gamma**action_repeat if config.gamma_per == "control_step" else config.gamma)


def resolve_preset(
    preset: str | None, algorithm: str | None = None, settings: Mapping[str, Any] | None = None
) -> LearnerConfig:
    """Return the configuration of a learner: a preset with some settings replaced.

    Args:
        preset: Name of a preset; `default_preset` by default.
        algorithm: Name of the learner; the preset's by default.
        settings: Values by name that replace those of the preset; numbers or text.
    """
    if preset is not None and preset not in PRESETS:
        raise InputError(f"there is no preset {brief(preset)}: {did_you_mean(preset, PRESETS)}")
    algorithm = algorithm or PRESETS[preset or DEFAULT_PRESET].algorithm
    kind = config_class(algorithm)
    if preset is None:
        preset = default_preset(algorithm)
    elif not issubclass(kind, OffPolicyConfig):
        raise InputError(f"the preset {preset} has settings that {algorithm} does not have: leave --preset out")
    base = {} if preset is None else setting_values(PRESETS[preset])
    return make_config(algorithm, base | flat_options(settings or {}))


def config_class(algorithm: str) -> type[LearnerConfig]:
    """Return the class of a learner's settings; for a plug-in `learner_config`, PyTorch is not imported."""
    if not LEARNERS.is_loaded(algorithm):
        for name, point in find_plugins("learner_config"):
            if name == algorithm:
                return cast("type[LearnerConfig]", point.load())
    return cast("type[LearnerConfig]", LEARNERS.get(algorithm).Config)


def default_preset(algorithm: str) -> str | None:
    """Return the preset used if none is chosen; None for a learner that is not off-policy."""
    return DEFAULT_PRESET if issubclass(config_class(algorithm), OffPolicyConfig) else None


def make_config(algorithm: str, settings: Mapping[str, Any]) -> LearnerConfig:
    """Validate settings against the configuration class of a learner; missing settings get its defaults."""
    kind = config_class(algorithm)
    names = option_fields(kind)
    values = {**flat_options(settings), "algorithm": algorithm}
    for name in values:
        if name not in names:
            known = names.keys() - {"algorithm"}
            raise InputError(f"the learner {algorithm} has no setting {brief(name)}: {did_you_mean(name, known)}")
    try:
        return TypeAdapter(kind).validate_python({names[name]: value for name, value in values.items()})
    except ValidationError as error:
        first = error.errors()[0]
        if not first["loc"]:  # an error of `__post_init__`
            raise InputError(str(first.get("ctx", {}).get("error", first["msg"]))) from None
        name = kind.entries.get(str(first["loc"][0]), str(first["loc"][0]))
        defaults = {kind.entries.get(f.name, f.name): getattr(f.default, "default", f.default) for f in fields(kind)}
        example = f" such as {defaults[name]!r}" if name in defaults else ""
        raise InputError(
            f"the learner's {name} cannot be {brief(values.get(name))} ({first['msg'].lower()}): give a value{example}"
        ) from None


def check_episodes(episodes: object) -> int:
    """Return a number of episodes as an int; raise an InputError unless it is a whole number in [1, `MAX_EPISODES`]."""
    return as_whole(episodes, "the number of episodes", 1, MAX_EPISODES)


def setting_values(config: LearnerConfig) -> dict[str, Any]:
    """Return the settings of a configuration by name."""
    return {name: getattr(config, field) for name, field in option_fields(type(config)).items()}


def config_values(config: LearnerConfig) -> dict[str, Any]:
    """Return the settings of a configuration by name, as YAML-serializable values."""
    values = TypeAdapter(type(config)).dump_python(config, mode="json")
    return {name: values[field] for name, field in option_fields(type(config)).items()}
