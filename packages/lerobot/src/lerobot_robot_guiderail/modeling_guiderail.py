"""LeRobot policy with a network that guiderail trained."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn
from torch.nn.functional import layer_norm

from lerobot_robot_guiderail.configuration_guiderail import GuiderailConfig


class GuiderailPolicy(PreTrainedPolicy):
    """Deterministic policy; its observation is the first part of the robot's `observation.state`."""

    config_class = GuiderailConfig
    name = "guiderail"

    def __init__(self, config: GuiderailConfig, **_: Any):
        super().__init__(config)
        self.layers = nn.ModuleList(nn.Linear(into, out) for into, out in pairwise(config.layers))
        low, high = (torch.tensor(limit) for limit in (config.action_low, config.action_high))
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)

    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return the action of each observation, (B, n)."""
        with torch.no_grad():
            return self._evaluate(batch[OBS_STATE][..., : self.config.layers[0]])

    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """Return a chunk of one action, (B, 1, n)."""
        return self.select_action(batch).unsqueeze(-2)

    def _evaluate(self, features: Tensor) -> Tensor:
        *hidden, last = self.layers
        for layer in hidden:
            features = layer(features)
            if self.config.activation == "normalized_relu":
                features = layer_norm(features, features.shape[-1:], eps=1e-5)
            features = torch.tanh(features) if self.config.activation == "tanh" else torch.relu(features)
        output = last(features)
        if self.config.squash == "clip":
            return torch.minimum(torch.maximum(output, self.low), self.high)
        return self.low + 0.5 * (torch.tanh(output) + 1.0) * (self.high - self.low)

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """Raise an error: guiderail trains the policy.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError("train the policy by guiderail train")

    def get_optim_params(self) -> dict[str, Any]:
        """Return no parameters: guiderail trains the policy."""
        return {}
