"""Settings of the learners from demonstrations and from a teacher."""

from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.learner import LearnerConfig, NonNegative, Positive, Symmetries
from guiderail.tools.learning.learner_config import BatchSize, Fraction, NetArch, Noise, Rate, RunName


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BcConfig(LearnerConfig):
    """Settings of behavior cloning (BC)."""

    takes_images: ClassVar[bool] = False

    algorithm: str = "bc"
    demonstration_episodes: NonNegative = 10  # first episodes in which the demonstrator acts, at least 1
    demonstrator: RunName = ""  # run or pretrained:NAME whose policy demonstrates; default: the scripted policy
    symmetry: Symmetries = False  # symmetry data augmentation; "near" also uses approximate symmetries of the task
    learning_rate: Rate = 1e-3
    gradient_steps: Positive = 5000  # gradient steps of the one training, after the last demonstration
    batch_size: BatchSize = 64  # transitions
    net_arch: NetArch = (256, 256)  # units of the hidden layers

    def __post_init__(self) -> None:
        if not self.demonstration_episodes:
            raise InputError("bc learns from demonstrations: give --set demonstration_episodes=... of at least 1")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ChunkConfig(BcConfig):
    """Settings of chunk cloning, which trains a base policy."""

    algorithm: str = "chunk"
    demonstration_episodes: NonNegative = 30  # first episodes in which the demonstrator acts, at least 1
    gradient_steps: Positive = 3000  # gradient steps of each network, after the last demonstration
    net_arch: NetArch = (64, 64)  # units of the hidden layers of each network
    members: Annotated[Positive, Field(le=50)] = 5  # E, networks of the ensemble
    chunk_steps: Annotated[Positive, Field(le=1000)] = 16  # K, control steps of a chunk
    observation_noise: Noise = 0.1  # standard deviation of the noise of observations in training


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DistillationConfig(ChunkConfig):
    """Settings of policy distillation, which trains a base policy on the commands of a trained KGRL policy."""

    algorithm: str = "distillation"
    demonstration_episodes: NonNegative = 0  # always 0: the teacher acts in every episode
    teacher: str = ""  # folder of the teacher's run, or pretrained:NAME
    action_noise: Fraction = 0.2  # standard deviation of the noise of the teacher's actions
    noisy_copies: NonNegative = 4  # noisy copies of each observation, labeled by the teacher
    copy_noise: Noise = 0.2  # standard deviation of a copy's noise, in standard deviations of each entry
    members: Annotated[Positive, Field(le=50)] = 1  # E, networks of the ensemble
    net_arch: NetArch = (128, 128)  # units of the hidden layers
    batch_size: BatchSize = 256  # observations
    gradient_steps: Positive = 8000  # gradient steps after the last episode
    observation_noise: Noise = 0.0  # standard deviation of further noise in training; labels do not change

    def __post_init__(self) -> None:
        if self.demonstration_episodes:
            raise InputError("distillation learns from its teacher: leave demonstration_episodes out")
