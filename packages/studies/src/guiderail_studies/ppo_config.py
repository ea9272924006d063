"""Settings of the learner PPO, in a module without PyTorch, so that they are checked before this slow import."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from guiderail.tools.learning.learner import LearnerConfig, Positive
from guiderail.tools.learning.learner_config import BatchSize, Factor, Fraction, NetArch, Rate


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PpoConfig(LearnerConfig):
    """Settings of proximal policy optimization (PPO), by the names of Stable-Baselines3 where it has them."""

    takes_images: ClassVar[bool] = False
    entries: ClassVar[Mapping[str, str]] = {"gamma_per": "gamma.per"}

    algorithm: str = "ppo"
    learning_rate: Rate = 3e-4
    gamma: Factor = 0.995  # discount factor per `gamma_per`
    gamma_per: Literal["control_step", "action"] = "control_step"
    n_steps: Annotated[Positive, Field(ge=2, le=10**6)] = 256  # transitions between two trainings
    batch_size: BatchSize = 64  # transitions
    net_arch: NetArch = (64, 64)  # units of the hidden layers
    n_epochs: Positive = 10  # passes through the transitions of a training
    ent_coef: Fraction = 0.0  # weight of the entropy in the loss
    cost_limit: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = None  # mean cost of an episode; None: any
    multiplier_rate: Rate = 0.035  # learning rate of the cost's Lagrange multiplier, as in OmniSafe
