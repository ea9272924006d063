"""SAC and TQC of Stable-Baselines3 with a faster training step: the same update in a fraction of the calls.

`FastTrainingStep` is a mixin that replaces `train` of a Stable-Baselines3 algorithm. All critics are evaluated as one
batched network, both batches of an update pass the actor at once, the parameters of a network are in one buffer, and
the gradients are written out, so that no unused gradient is computed. `FastSac` and `FastTqc` are the two algorithms
with it. `python -m research.benchmarks learner` compares the duration with Stable-Baselines3's; a test compares the
parameters.
"""

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN

from guiderail.tools.learning.batched_mlp import BatchedMLP, FlatAdam, Linear, flatten

_SQUASH_EPSILON = 1e-6  # Stable-Baselines3 adds it to the derivative of tanh before taking the logarithm
_MAX_GATHERED = 2**22  # most numbers in the batches of one gathering; observations without images need no second one

# SAC and TQC have no common interface that a type checker could use.
if TYPE_CHECKING:
    _Algorithm = Any
else:
    _Algorithm = object


class FastTrainingStep(_Algorithm):
    """Mixin that replaces the training step; list it before SAC or TQC among the base classes.

    A subclass implements `_target_value`, `_critic_gradient`, `_value_gradient` and `_critic_loss`.

    Attributes:
        records_metrics: Record losses, values and the entropy coefficient in the algorithm's logger.
    """

    ent_coef: Any
    ent_coef_tensor: Any
    ent_coef_optimizer: Any
    log_ent_coef: Any
    policy_kwargs: Any
    records_metrics = False

    def _setup_model(self) -> None:
        # A fixed coefficient keeps Stable-Baselines3 from creating an optimizer of its own.
        ent_coef, self.ent_coef = self.ent_coef, 1.0
        self.policy_kwargs = {**self.policy_kwargs, "optimizer_class": FlatAdam, "optimizer_kwargs": {}}
        super()._setup_model()
        self.ent_coef = ent_coef
        self.ent_coef_tensor = None
        if isinstance(ent_coef, str):
            initial = float(ent_coef.removeprefix("auto").removeprefix("_") or 1.0)
            self.log_ent_coef = torch.log(torch.ones(1) * initial)
            self.ent_coef_optimizer = FlatAdam([self.log_ent_coef], self.lr_schedule(1))
        else:
            self.ent_coef_tensor = torch.tensor([float(ent_coef)])
        self._build_networks()

    def _build_networks(self) -> None:
        """Build `BatchedMLP` networks on the parameters of actor, critics and target critics."""
        actor, critic = self.policy.actor, self.policy.critic
        layer_norm = getattr(actor.activation_fn, "kind", None) == "normalized_relu"
        if not layer_norm and actor.activation_fn is not torch.nn.ReLU:
            raise TypeError(f"gradients are written out for rectified layers, not for {actor.activation_fn.__name__}")
        for network in (actor, critic):
            if any(True for _ in network.features_extractor.parameters()):
                raise TypeError("gradients are written out for feature extractors without parameters")
        # A privileged critic has further features, after those of the actor.
        self._features, self._actions = critic.features_extractor.features_dim, self.action_space.shape[0]
        self._actor_features = actor.features_dim
        trunk, head = [self._actor_features, *actor.net_arch], [actor.net_arch[-1], self._actions]
        shared = sum(_num_parameters(*pair) for pair in pairwise(trunk))
        values, gradient = actor.optimizer.values, actor.optimizer.gradient
        # The mean and the logarithm of the standard deviation are two networks on one trunk.
        self._actor = BatchedMLP(
            _layers(values[:shared].view(1, -1), gradient[:shared].view(1, -1), trunk)
            + _layers(values[shared:].view(2, -1), gradient[shared:].view(2, -1), head),
            layer_norm,
        )
        sizes = [self._features + self._actions, *actor.net_arch, critic.q_networks[0][-1].out_features]

        def batched_critics(values: torch.Tensor, gradient: torch.Tensor) -> BatchedMLP:
            shape = (len(critic.q_networks), -1)
            return BatchedMLP(_layers(values.view(shape), gradient.view(shape), sizes), layer_norm)

        self._critic = batched_critics(critic.optimizer.values, critic.optimizer.gradient)
        self._target_parameters = flatten(self.policy.critic_target.parameters())
        self._target = batched_critics(self._target_parameters, torch.empty_like(self._target_parameters))

    @torch.inference_mode()
    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Take `gradient_steps` gradient steps, each on a batch of its own."""
        steps_at_once = max(1, _MAX_GATHERED // (2 * batch_size * (self._features + self._actions)))
        for done in range(0, gradient_steps, steps_at_once):
            steps = min(steps_at_once, gradient_steps - done)
            self._train_batches(self.replay_buffer.sample(steps * batch_size), steps, batch_size)
        self._n_updates += gradient_steps

    def _train_batches(self, data: ReplayBufferSamples, steps: int, batch_size: int) -> None:
        """Take `steps` gradient steps on consecutive batches of `data`."""
        critic, features = self.policy.critic, self._features
        now = critic.extract_features(data.observations, critic.features_extractor)
        following = critic.extract_features(data.next_observations, critic.features_extractor)
        taken = torch.cat([now, data.actions], dim=1).view(steps, batch_size, -1)
        states = torch.empty(steps, 2 * batch_size, taken.shape[-1])
        states[:, :batch_size, :features] = now.view(steps, batch_size, -1)
        states[:, batch_size:, :features] = following.view(steps, batch_size, -1)
        rewards = data.rewards.view(steps, batch_size, 1)
        gamma = self.gamma if data.discounts is None else data.discounts
        discounts = ((1 - data.dones) * gamma).view(steps, batch_size, 1)
        noise = torch.randn(steps, 2 * batch_size, self._actions)
        log_density = -(0.5 * noise.square() + 0.5 * math.log(2 * math.pi)).sum(dim=2, keepdim=True)
        for step in zip(states, taken, rewards, discounts, noise, log_density, strict=True):
            self._gradient_step(*step)

    def _gradient_step(
        self,
        states: torch.Tensor,
        taken: torch.Tensor,
        rewards: torch.Tensor,
        discounts: torch.Tensor,
        noise: torch.Tensor,
        log_density: torch.Tensor,
    ) -> None:
        """Take one gradient step on a batch of B transitions.

        Args:
            states: (2B, features + actions): features, next features, and room for actions.
            taken: (B, features + actions): features and actions of the transitions.
            rewards: (B, 1).
            discounts: (B, 1), the discount factor, and 0 after a terminal transition.
            noise: (2B, actions), standard normal.
            log_density: (2B, 1), logarithm of the density of the noise.
        """
        batch = len(taken)
        (mean, log_std), actor_cache = self._actor.forward(states[None, :, : self._actor_features])
        clamped = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        deviation = clamped.exp().mul_(noise)
        actions = torch.tanh(mean + deviation)
        slope = 1 - actions.square()
        log_prob = log_density - (clamped + (slope + _SQUASH_EPSILON).log_()).sum(dim=1, keepdim=True)
        states[:, self._features :] = actions
        ent_coef = self._ent_coef_step(log_prob[:batch])

        next_values, _ = self._target.forward(states[None, batch:])
        target = rewards + discounts * (self._target_value(next_values) - ent_coef * log_prob[batch:])
        values, critic_cache = self._critic.forward(taken[None])
        if self.records_metrics:
            self._record("critic_loss", self._critic_loss(values, target))
            self._record("q_value", values.mean())
            self._record("ent_coef", ent_coef)
        self._critic.backward(critic_cache, self._critic_gradient(values, target))
        self.policy.critic.optimizer.step()

        values, critic_cache = self._critic.forward(states[None, :batch])
        if self.records_metrics:
            self._record("actor_loss", (ent_coef * log_prob[:batch] - self._actor_value(values)).mean())
        d_values = self._value_gradient(values)
        d_action = self._critic.input_gradient(critic_cache, d_values, slice(self._features, None))[0]
        slope, weight = slope[:batch], ent_coef / batch
        d_mean = (d_action + 2 * weight * actions[:batch] / (slope + _SQUASH_EPSILON)) * slope
        d_log_std = (d_mean * deviation[:batch] - weight) * (log_std[:batch] == clamped[:batch])
        self._actor.backward(actor_cache.first(batch), torch.stack([d_mean, d_log_std]))
        self.policy.actor.optimizer.step()

        self._target_parameters.lerp_(self.policy.critic.optimizer.values, self.tau)

    def _record(self, name: str, value: torch.Tensor) -> None:
        self.logger.record_mean(f"train/{name}", float(value))

    def _ent_coef_step(self, log_prob: torch.Tensor) -> torch.Tensor:
        """Return the entropy coefficient, (1,), and then move a learned one towards its target."""
        if self.ent_coef_tensor is not None:
            return self.ent_coef_tensor
        ent_coef = self.ent_coef_optimizer.values.exp()
        self.ent_coef_optimizer.gradient.fill_(-(log_prob.mean() + float(self.target_entropy)))
        self.ent_coef_optimizer.step()
        return ent_coef

    def _target_value(self, values: torch.Tensor) -> torch.Tensor:
        """Return the value (B, …) of the next states from the outputs (n, B, outputs) of the target critics."""
        raise NotImplementedError

    def _critic_loss(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the critics' loss for a log, given their outputs (n, B, outputs) and the target (B, …)."""
        raise NotImplementedError

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the gradient of the critics' loss with respect to their outputs, (n, B, outputs)."""
        raise NotImplementedError

    def _actor_value(self, values: torch.Tensor) -> torch.Tensor:
        """Return the value (B, 1) that the actor maximizes, given the critics' outputs (n, B, outputs)."""
        raise NotImplementedError

    def _value_gradient(self, values: torch.Tensor) -> torch.Tensor:
        """Return the gradient of the negative mean of `_actor_value` with respect to the critics' outputs."""
        raise NotImplementedError


class FastSac(FastTrainingStep, SAC):
    """Soft actor-critic (Haarnoja et al., 2018): critics of one value each, of which the minimum counts."""

    def _target_value(self, values: torch.Tensor) -> torch.Tensor:
        return values.amin(dim=0)

    def _critic_loss(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return 0.5 * (values - target).square().mean(dim=(1, 2)).sum()

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return (values - target) / len(target)

    def _actor_value(self, values: torch.Tensor) -> torch.Tensor:
        return values.amin(dim=0)

    def _value_gradient(self, values: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(values).scatter_(0, values.argmin(dim=0, keepdim=True), -1 / values.shape[1])


class FastTqc(FastTrainingStep, TQC):
    """Truncated quantile critics (Kuznetsov et al., 2020): quantiles of all critics without the largest ones."""

    def _build_networks(self) -> None:
        super()._build_networks()
        critic = self.policy.critic
        self._num_kept = critic.quantiles_total - self.top_quantiles_to_drop_per_net * critic.n_critics
        # ½ − τ of each quantile.
        self._quantile_weights = 0.5 - (torch.arange(critic.n_quantiles) + 0.5) / critic.n_quantiles

    def _target_value(self, values: torch.Tensor) -> torch.Tensor:
        pooled = values.transpose(0, 1).flatten(1)
        np.ndarray.sort(pooled.numpy(), axis=1)  # in place; many times faster than PyTorch's sort
        return pooled[:, : self._num_kept]

    def _critic_loss(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        errors = target.T[:, None, :, None] - values
        distance = errors.abs()
        huber = torch.where(distance > 1, distance - 0.5, 0.5 * errors.square())
        return ((0.5 - self._quantile_weights - (errors < 0).float()).abs() * huber).mean()

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the gradient of the quantile Huber loss, for which errors beyond ±1 count as ±1.

        With such a clipped error e, the weight |τ − (e < 0)| gives e/2 − (½ − τ)|e|.
        """
        errors = (target.T[:, None, :, None] - values).clamp_(-1, 1)  # (kept, n, B, quantiles)
        half = errors.sum(dim=0).mul_(0.5)
        return errors.abs_().sum(dim=0).mul_(self._quantile_weights).sub_(half).div_(errors.numel())

    def _actor_value(self, values: torch.Tensor) -> torch.Tensor:
        return values.mean(dim=(0, 2))[:, None]

    def _value_gradient(self, values: torch.Tensor) -> torch.Tensor:
        return torch.full_like(values, -1 / values.numel())


def _num_parameters(inputs: int, outputs: int) -> int:
    return (inputs + 1) * outputs


def _layers(values: torch.Tensor, gradient: torch.Tensor, sizes: list[int]) -> list[Linear]:
    """Return the layers of n networks whose parameters are the rows of `values`, in the order of a module."""
    pairs = list(pairwise(sizes))
    counts = [_num_parameters(*pair) for pair in pairs]
    parts = zip(values.split(counts, dim=1), gradient.split(counts, dim=1), pairs, strict=True)
    return [Linear(value, derivative, *pair) for value, derivative, pair in parts]
