"""Configuration of a policy that guiderail trained."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamConfig


@PreTrainedConfig.register_subclass("guiderail")
@dataclass
class GuiderailConfig(PreTrainedConfig):
    """Network of a policy.

    Attributes:
        layers: Number of inputs, of the units of each hidden layer, and of outputs.
        activation: "relu", "normalized_relu" or "tanh".
        squash: "tanh" or "clip".
        action_low: Smallest action.
        action_high: Largest action.
    """

    layers: list[int] = field(default_factory=list)
    activation: str = "relu"
    squash: str = "tanh"
    action_low: list[float] = field(default_factory=list)
    action_high: list[float] = field(default_factory=list)

    @property
    def observation_delta_indices(self) -> None:
        """None: the policy uses only the current observation."""

    @property
    def action_delta_indices(self) -> None:
        """None: the policy returns one action."""

    @property
    def reward_delta_indices(self) -> None:
        """None: the policy is not trained here."""

    def get_optimizer_preset(self) -> AdamConfig:
        """Return the default configuration of Adam; LeRobot requires a value, which is not used."""
        return AdamConfig()

    def get_scheduler_preset(self) -> None:
        """Return None: there is no schedule."""

    def validate_features(self) -> None:
        """Accept all features."""
