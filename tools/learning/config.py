"""How a learner learns: named settings, the thesis's and our own, and single ones replaced."""

import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.dataclasses import dataclass

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.learning.learner import LEARNERS


def _usable_entropy(ent_coef: str) -> str:
    initial = ent_coef.removeprefix("auto").removeprefix("_")
    if ent_coef != "auto" and not 0 < float(initial) < math.inf:
        raise ValueError("it is auto, auto_<initial value> or a positive number")
    return ent_coef


def _no_truth(value: Any) -> Any:
    """True is no number."""
    if isinstance(value, bool):
        raise ValueError("it is a number")
    return value


# What takes memory or time is bounded by what no machine has.
Count = Annotated[int, Field(ge=1, le=10**9), BeforeValidator(_no_truth)]
Batch = Annotated[int, Field(ge=1, le=10**6), BeforeValidator(_no_truth)]
Width = Annotated[int, Field(ge=1, le=10**4), BeforeValidator(_no_truth)]
Least = Annotated[int, Field(ge=0, le=10**9), BeforeValidator(_no_truth)]
Share = Annotated[float, Field(ge=0, le=1), BeforeValidator(_no_truth)]
Factor = Annotated[float, Field(gt=0, le=1), BeforeValidator(_no_truth)]
Rate = Annotated[float, Field(gt=0, allow_inf_nan=False), BeforeValidator(_no_truth)]
Entropy = Annotated[str, BeforeValidator(str), AfterValidator(_usable_entropy)]
NetArch = Annotated[
    tuple[Width, ...],
    Field(min_length=1, max_length=20),
    BeforeValidator(lambda v: v.split(",") if isinstance(v, str) else v),
]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LearnerConfig:
    """How a learner learns. A decision is one action of the policy; it lasts `action_repeat` control steps."""

    algorithm: str = "tqc"  # a learner's name
    learning_rate: Rate = 3e-4  # of actor, critics and entropy
    gamma: Factor = 0.995  # of one control step, so that it means the same whatever the hold, or of one decision
    gamma_per: Literal["control_step", "decision"] = "control_step"  # what the discount is of
    tau: Factor = 0.02  # how far the target critics follow at each gradient step
    train_freq: Count = 8  # decisions between two trainings
    gradient_steps: Count = 24  # in one training
    batch_size: Batch = 64  # decisions
    n_steps: Annotated[Count, Field(le=1000)] = 1  # decisions after which a return is guessed, and until which known
    buffer_size: Count = 1_000_000  # decisions that are remembered
    learning_starts: Count = 100  # decisions, uniformly random, before the first training
    ent_coef: Entropy = "auto_0.1"  # "auto", "auto_<initial value>", or a number
    net_arch: NetArch = (256, 256)  # of the hidden layers
    demonstration_episodes: Least = 0  # the first ones, in which a demonstrator acts; what it did is replayed, too
    constant_episodes: Least = 0  # the next ones, in each of which one uniform action is repeated all the time
    ez_greedy: Share = 0.0  # how likely an exploring decision begins a temporally extended action (εz-greedy)
    ez_greedy_longest: Count = 8  # decisions that such an action lasts at most
    ez_greedy_until: Least = 0  # greedy successes in a row after which there are no more; 0 for never
    greedy_episode_fraction: Share = 0.0  # part of the episodes, evenly spread, that do not explore
    layer_norm: bool = False  # of the hidden layers, before their activation
    # Remember what was seen as seen from the other sides too, where the task has any; "near": from those, too, from
    # which only most of an episode is the same.
    symmetry: bool | Literal["near"] = False
    selection_window: Least = 0  # greedy successes before and after an actor that select it; 0 takes the last actor
    # Learn in a process of its own while the next episode is simulated, and so an episode later: deterministic too.
    pipelined: bool = False
    actor_ema: Share = 0.003  # how far the averaged actor follows at each gradient step; 0 for no averaged actor


_TABLE_4_1 = LearnerConfig(
    learning_rate=1e-3, gamma=0.99, gradient_steps=8, batch_size=256, ent_coef="auto", actor_ema=0.0
)  # batch and buffer of table 3.2, as table 4.1 has none
_TABLE_3_2 = replace(_TABLE_4_1, learning_rate=8e-4, gamma=0.95, gamma_per="decision", learning_starts=1000)
_QUICK = LearnerConfig(learning_rate=1e-3, gamma=0.998, gradient_steps=8, ent_coef="auto")

# What each was measured with is in docs/experiments.md.
PRESETS = {
    # For contact, where learning swings: small batches, a moderate learning rate and normalized layers keep the swings
    # small, greedy episodes tell the critic what the mean is worth, and checkpoint selection takes an actor that lasts.
    "tqc_contact": LearnerConfig(
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
    # For a cost of force, which is known long before a success is: a large entropy and temporally extended actions lead
    # back to contact, and end once greedy episodes succeed, as they are what pushes hardest.
    "sac_gridclamp": LearnerConfig(
        algorithm="sac",
        learning_rate=7e-4,
        gamma=0.99,
        gamma_per="decision",
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
    # Cheap enough to watch: the narrow passage within a minute.
    "tqc_fast": _QUICK,
    # sKGRL reacts slowly: actions sampled anew at every decision seldom lead it around an obstacle.
    "tqc_cheap_correlated": replace(_QUICK, constant_episodes=10),
    "table_4_1_simulation": _TABLE_4_1,
    "table_4_1_robot": replace(_TABLE_4_1, tau=0.01, gamma=0.995, ent_coef="auto_0.1"),
    "table_3_2_iiwa": _TABLE_3_2,
    # An episode of pouring has at most 150 decisions.
    "pouring": replace(_TABLE_3_2, learning_starts=300),
    "table_3_2_sara": replace(_TABLE_3_2, algorithm="sac", learning_rate=1e-3, gamma=0.98),
}


def action_gamma(preset: LearnerConfig, action_repeat: int) -> float:
    """The discount of one decision that lasts `action_repeat` control steps."""
    return preset.gamma**action_repeat if preset.gamma_per == "control_step" else preset.gamma


def resolve_preset(name: str, algorithm: str, settings: Mapping[str, Any] | None = None) -> LearnerConfig:
    """The preset of that name for an algorithm, with single settings replaced.

    Raises:
        InputError: for an unknown preset, algorithm or setting, or a value out of range.
    """
    if name not in PRESETS:
        raise InputError(f"there is no preset {brief(name)}: {did_you_mean(name, PRESETS)}")
    LEARNERS.get(algorithm)
    known = {field.name for field in fields(LearnerConfig)} - {"algorithm"}
    values = asdict(PRESETS[name]) | {"algorithm": algorithm}
    for key, value in (settings or {}).items():
        if key not in known:
            raise InputError(f"a learner has no setting {brief(key)}: {did_you_mean(key, known)}")
        values[key] = value
    try:
        return LearnerConfig(**values)
    except ValidationError as error:
        wrong = error.errors()[0]
        key, example = str(wrong["loc"][0]), getattr(PRESETS[name], str(wrong["loc"][0]))
        said = f"the learner's {key} cannot be {brief(values[key])} ({wrong['msg'].lower()})"
        raise InputError(f"{said}: give a value such as {example!r}") from None
