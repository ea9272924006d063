"""SAC and TQC of Stable-Baselines3 with a gradient step of their own: the same law, in a fraction of the calls.

All critics are evaluated as one, both batches of an update go through the actor at once, parameters lie in one buffer
a network, and the gradients are written out, so that nothing is computed that no gradient needs. `guiderail bench
learner` compares it with Stable-Baselines3's own; a test holds both to the same parameters.
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

from guiderail.tools.learning.fast_sb3.batched_mlp import BatchedMLP, Linear
from guiderail.tools.learning.fast_sb3.flat_adam import FlatAdam, flatten

_SQUASHED = 1e-6  # Stable-Baselines3 adds it to a tanh's slope before it takes the logarithm
_MOST_NUMBERS = 2**22  # of states that are gathered at once: all of a training's, unless they are images

# SAC and TQC have no interface in common that a type checker knows.
if TYPE_CHECKING:
    _Algorithm = Any
else:
    _Algorithm = object


class Ensemble(_Algorithm):
    """What SAC and TQC have in common; a mixin before either of them."""

    ent_coef: Any
    ent_coef_tensor: Any
    ent_coef_optimizer: Any
    log_ent_coef: Any
    policy_kwargs: Any

    def _setup_model(self) -> None:
        # A coefficient that is not learned keeps Stable-Baselines3 from creating an optimizer of its own.
        entropy, self.ent_coef = self.ent_coef, 1.0
        self.policy_kwargs = {**self.policy_kwargs, "optimizer_class": FlatAdam, "optimizer_kwargs": {}}
        super()._setup_model()
        self.ent_coef = entropy
        self.ent_coef_tensor = None
        if isinstance(entropy, str):
            initial = float(entropy.removeprefix("auto").removeprefix("_") or 1.0)
            self.log_ent_coef = torch.log(torch.ones(1) * initial)
            self.ent_coef_optimizer = FlatAdam([self.log_ent_coef], self.lr_schedule(1))
        else:
            self.ent_coef_tensor = torch.tensor([float(entropy)])
        self._stack()

    def _stack(self) -> None:
        """The networks as `BatchedMLP` on the same numbers."""
        actor, critic = self.policy.actor, self.policy.critic
        layer_norm = getattr(actor.activation_fn, "kind", None) == "normalized_relu"
        if not layer_norm and actor.activation_fn is not torch.nn.ReLU:
            raise TypeError(f"gradients are written out for rectified layers, not for {actor.activation_fn.__name__}")
        for network in (actor, critic):
            if any(True for _ in network.features_extractor.parameters()):
                raise TypeError("gradients are written out for features that have no parameters of their own")
        self._features, self._actions = actor.features_dim, self.action_space.shape[0]
        trunk, head = [self._features, *actor.net_arch], [actor.net_arch[-1], self._actions]
        shared = sum(_count(*pair) for pair in pairwise(trunk))
        values, gradient = actor.optimizer.values, actor.optimizer.gradient
        # The mean and the logarithm of the standard deviation are two networks on one trunk.
        self._actor = BatchedMLP(
            _layers(values[:shared].view(1, -1), gradient[:shared].view(1, -1), trunk)
            + _layers(values[shared:].view(2, -1), gradient[shared:].view(2, -1), head),
            layer_norm,
        )
        outputs = critic.q_networks[0][-1].out_features
        sizes = [self._features + self._actions, *actor.net_arch, outputs]
        networks = len(critic.q_networks)
        self._critic = BatchedMLP(
            _layers(critic.optimizer.values.view(networks, -1), critic.optimizer.gradient.view(networks, -1), sizes),
            layer_norm,
        )
        self._target_values = flatten(self.policy.critic_target.parameters())
        unused = torch.empty_like(self._target_values)
        self._target = BatchedMLP(
            _layers(self._target_values.view(networks, -1), unused.view(networks, -1), sizes), layer_norm
        )

    @torch.inference_mode()
    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """So many gradient steps, each on a batch of its own."""
        at_once = max(1, _MOST_NUMBERS // (2 * batch_size * (self._features + self._actions)))
        for done in range(0, gradient_steps, at_once):
            steps = min(at_once, gradient_steps - done)
            self._train(self.replay_buffer.sample(steps * batch_size), steps, batch_size)
        self._n_updates += gradient_steps

    def _train(self, data: ReplayBufferSamples, steps: int, batch: int) -> None:
        """The same on batches that lie one behind the other."""
        actor, features = self.policy.actor, self._features
        seen = actor.extract_features(data.observations, actor.features_extractor)
        then = actor.extract_features(data.next_observations, actor.features_extractor)
        taken = torch.cat([seen, data.actions], dim=1).view(steps, batch, -1)
        states = torch.empty(steps, 2 * batch, taken.shape[-1])
        states[:, :batch, :features] = seen.view(steps, batch, -1)
        states[:, batch:, :features] = then.view(steps, batch, -1)
        rewards = data.rewards.view(steps, batch, 1)
        discounts = self.gamma if data.discounts is None else data.discounts
        follows = ((1 - data.dones) * discounts).view(steps, batch, 1)
        noise = torch.randn(steps, 2 * batch, self._actions)
        likely = -(0.5 * noise.square() + 0.5 * math.log(2 * math.pi)).sum(dim=2, keepdim=True)
        for step in zip(states, taken, rewards, follows, noise, likely, strict=True):
            self._step(*step)

    def _step(
        self,
        states: torch.Tensor,
        taken: torch.Tensor,
        rewards: torch.Tensor,
        follows: torch.Tensor,
        noise: torch.Tensor,
        likely: torch.Tensor,
    ) -> None:
        """One gradient step.

        Args:
            states: (2B, features + actions): what was seen, what was seen next, and room for actions.
            taken: (B, features + actions): what was seen and done.
            rewards: (B, 1).
            follows: (B, 1), the discount, and 0 where nothing follows.
            noise: (2B, actions), of a standard normal distribution.
            likely: (2B, 1), the logarithm of its density.
        """
        batch = len(taken)
        (mean, log_std), acted = self._actor.forward(states[None, :, : self._features])
        clamped = log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        spread = clamped.exp().mul_(noise)
        actions = torch.tanh(mean + spread)
        slope = 1 - actions.square()
        log_prob = likely - (clamped + (slope + _SQUASHED).log_()).sum(dim=1, keepdim=True)
        states[:, self._features :] = actions
        entropy = self._entropy_step(log_prob[:batch])

        following, _ = self._target.forward(states[None, batch:])
        target = rewards + follows * (self._believed(following) - entropy * log_prob[batch:])
        values, judged = self._critic.forward(taken[None])
        self._critic.backward(judged, self._critic_gradient(values, target))
        self.policy.critic.optimizer.step()

        values, judged = self._critic.forward(states[None, :batch])
        d_action = self._critic.input_gradient(judged, self._acting_gradient(values), slice(self._features, None))[0]
        slope, weight = slope[:batch], entropy / batch
        d_mean = (d_action + 2 * weight * actions[:batch] / (slope + _SQUASHED)) * slope
        d_log_std = (d_mean * spread[:batch] - weight) * (log_std[:batch] == clamped[:batch])
        self._actor.backward(acted.first(batch), torch.stack([d_mean, d_log_std]))
        self.policy.actor.optimizer.step()

        self._target_values.lerp_(self.policy.critic.optimizer.values, self.tau)

    def _entropy_step(self, log_prob: torch.Tensor) -> torch.Tensor:
        """The entropy's coefficient, (1,), as it was before it is moved to its target, where it is learned."""
        if self.ent_coef_tensor is not None:
            return self.ent_coef_tensor
        entropy = self.ent_coef_optimizer.values.exp()
        self.ent_coef_optimizer.gradient.fill_(-(log_prob.mean() + float(self.target_entropy)))
        self.ent_coef_optimizer.step()
        return entropy

    def _believed(self, values: torch.Tensor) -> torch.Tensor:
        """What the target networks' outputs, (n, B, outputs), say of a state's value: (B, …)."""
        raise NotImplementedError

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """That of the critics' loss to their outputs, (n, B, outputs)."""
        raise NotImplementedError

    def _acting_gradient(self, values: torch.Tensor) -> torch.Tensor:
        """That of the mean value's negative to the critics' outputs, (n, B, outputs)."""
        raise NotImplementedError


class EnsembleSac(Ensemble, SAC):
    """Soft actor-critic (Haarnoja et al., 2018): critics of one value each, of which the least is believed."""

    def _believed(self, values: torch.Tensor) -> torch.Tensor:
        return values.amin(dim=0)

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return (values - target) / len(target)

    def _acting_gradient(self, values: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(values).scatter_(0, values.argmin(dim=0, keepdim=True), -1 / values.shape[1])


class EnsembleTqc(Ensemble, TQC):
    """Truncated quantile critics (Kuznetsov et al., 2020): quantiles of all critics, without the largest ones."""

    def _stack(self) -> None:
        super()._stack()
        critic = self.policy.critic
        self._kept = critic.quantiles_total - self.top_quantiles_to_drop_per_net * critic.n_critics
        # ½ − τ of each quantile.
        self._lean = 0.5 - (torch.arange(critic.n_quantiles) + 0.5) / critic.n_quantiles

    def _believed(self, values: torch.Tensor) -> torch.Tensor:
        together = values.transpose(0, 1).flatten(1)
        np.ndarray.sort(together.numpy(), axis=1)  # in place, and many times faster than PyTorch's
        return together[:, : self._kept]

    def _critic_gradient(self, values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Of the quantile Huber loss, for which errors beyond ±1 count as ±1.

        With an error e, cut so, the weight |τ − (e < 0)| gives e/2 − (½ − τ)|e|.
        """
        errors = (target.T[:, None, :, None] - values).clamp_(-1, 1)  # (kept, n, B, quantiles)
        half = errors.sum(dim=0).mul_(0.5)
        return errors.abs_().sum(dim=0).mul_(self._lean).sub_(half).div_(errors.numel())

    def _acting_gradient(self, values: torch.Tensor) -> torch.Tensor:
        return torch.full_like(values, -1 / values.numel())


def _count(inputs: int, outputs: int) -> int:
    return (inputs + 1) * outputs


def _layers(values: torch.Tensor, gradient: torch.Tensor, sizes: list[int]) -> list[Linear]:
    """Of n networks whose parameters are the rows of `values`, in the order in which a module has them."""
    pairs = list(pairwise(sizes))
    counts = [_count(*pair) for pair in pairs]
    parts = zip(values.split(counts, dim=1), gradient.split(counts, dim=1), pairs, strict=True)
    return [Linear(value, derivative, *pair) for value, derivative, pair in parts]
