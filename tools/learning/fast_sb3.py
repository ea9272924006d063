"""SAC and TQC of Stable-Baselines3 with a faster training step: the same update in fewer PyTorch calls.

`FastTrainingStep` is a mixin that replaces `train` of a Stable-Baselines3 algorithm. All critics are evaluated as one
batched network. The actor evaluates the states and the next states of an update in one batch. The parameters of a
network are in one buffer. Gradients are explicit formulas, so that no unused gradient is computed. `FastSac` and
`FastTqc` have this mixin. `python -m research.benchmarks learner` compares their duration with that of
Stable-Baselines3, and a test compares the parameters.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.sac.policies import LOG_STD_MAX, LOG_STD_MIN
from torch.nn.utils import parameters_to_vector, vector_to_parameters

_EPSILON = 1e-5  # default of `torch.nn.functional.layer_norm`
_MOMENTS = ("exp_avg", "exp_avg_sq")  # names in the state dictionary of `torch.optim.Adam`


class Linear:
    """Affine layer of n networks with equal sizes and separate weights, evaluated as one batch.

    Attributes:
        weight: Weights (n, outputs, inputs).
    """

    def __init__(self, values: torch.Tensor, gradient: torch.Tensor, inputs: int, outputs: int):
        """Construct the layer.

        Args:
            values: (n, outputs · inputs + outputs): weights and biases, a view of the buffer of all parameters.
            gradient: View of the parameters' gradient, of the same shape, which `backward` writes.
            inputs: Number of inputs of one network.
            outputs: Number of outputs of one network.
        """
        self.weight, bias = _split(values, inputs, outputs)
        self._transposed, self._bias = self.weight.mT, bias[:, None]
        self._weight_gradient, self._bias_gradient = _split(gradient, inputs, outputs)
        self._networks = len(values)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map inputs (n or 1, batch, inputs) to outputs (n, batch, outputs)."""
        return torch.baddbmm(self._bias, x.expand(self._networks, -1, -1), self._transposed)

    def backward(self, x: torch.Tensor, d: torch.Tensor) -> None:
        """Write the gradient of weights and biases.

        `x` are the inputs of `forward`, and `d` is the gradient of the loss with respect to the outputs, (n, batch,
        outputs).
        """
        torch.bmm(d.mT, x.expand(self._networks, -1, -1), out=self._weight_gradient)
        torch.sum(d, 1, out=self._bias_gradient)

    def input_gradient(self, d: torch.Tensor, shared: bool, columns: slice = slice(None)) -> torch.Tensor:
        """Return the gradient with respect to `columns` of the input, (n or 1, batch, columns).

        `d` is the gradient with respect to the outputs, (n, batch, outputs). `shared` is True if the n networks have
        one common input; the gradient is then summed over them.
        """
        by_network = torch.bmm(d, self.weight[:, :, columns])
        return by_network.sum(0, keepdim=True) if shared and self._networks > 1 else by_network


def _split(flat: torch.Tensor, inputs: int, outputs: int) -> tuple[torch.Tensor, torch.Tensor]:
    weight, bias = flat.split([outputs * inputs, outputs], dim=1)
    return weight.unflatten(1, (outputs, inputs)), bias


@dataclass
class ForwardCache:
    """Intermediate results of a forward pass, which the backward pass reuses."""

    inputs: list[torch.Tensor]  # input of each layer, (n or 1, batch, inputs)
    # Affine output, its mean and its inverse standard deviation for each normalized hidden layer.
    normalized: list[tuple[torch.Tensor, ...]]

    def first(self, rows: int) -> "ForwardCache":
        """Return the cache of the first `rows` of the batch."""
        return ForwardCache(
            [x[:, :rows] for x in self.inputs], [tuple(x[:, :rows] for x in layer) for layer in self.normalized]
        )


class BatchedMLP:
    """Multilayer perceptrons with ReLU hidden layers, evaluated as one batch; the first layers may be shared."""

    def __init__(self, layers: Sequence[Linear], layer_norm: bool):
        """Construct the networks.

        Args:
            layers: Layers from input to output. A layer of one network is shared by all networks of the layers after
                it.
            layer_norm: Apply layer normalization, without learned parameters, before each ReLU.
        """
        self._layers = list(layers)
        self._layer_norm = layer_norm

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ForwardCache]:
        """Return the outputs (n, batch, outputs) for inputs (n or 1, batch, inputs), and the cache."""
        cache = ForwardCache([x], [])
        for layer in self._layers[:-1]:
            x = layer.forward(x)
            if self._layer_norm:
                before = x
                x, mean, scale = torch.native_layer_norm(before, before.shape[-1:], None, None, _EPSILON)
                cache.normalized.append((before, mean, scale))
            x = x.relu_()
            cache.inputs.append(x)
        return self._layers[-1].forward(x), cache

    def backward(self, cache: ForwardCache, d: torch.Tensor) -> None:
        """Write the gradient of all parameters, given the gradient `d` of the output, (n, batch, outputs)."""
        for index in reversed(range(1, len(self._layers))):
            self._layers[index].backward(cache.inputs[index], d)
            d = self._through(index, cache, d)
        self._layers[0].backward(cache.inputs[0], d)

    def input_gradient(self, cache: ForwardCache, d: torch.Tensor, columns: slice) -> torch.Tensor:
        """Return the gradient of `columns` of the input, (n or 1, batch, columns); no parameter's gradient changes."""
        for index in reversed(range(1, len(self._layers))):
            d = self._through(index, cache, d)
        return self._layers[0].input_gradient(d, len(cache.inputs[0]) == 1, columns)

    def _through(self, index: int, cache: ForwardCache, d: torch.Tensor) -> torch.Tensor:
        """Return the gradient with respect to the output of layer `index - 1`, given that of layer `index`."""
        x = cache.inputs[index]
        d = torch.ops.aten.threshold_backward(self._layers[index].input_gradient(d, len(x) == 1), x, 0)
        if not self._layer_norm:
            return d
        before, mean, scale = cache.normalized[index - 1]
        return torch.ops.aten.native_layer_norm_backward(
            d, before, before.shape[-1:], mean, scale, None, None, [True, False, False]
        )[0]


def flatten(parameters: Iterable[torch.Tensor]) -> torch.Tensor:
    """Return one buffer of all parameters, in their order; each parameter becomes a view of it."""
    parameters = list(parameters)
    flat = parameters_to_vector(parameters).detach()
    vector_to_parameters(flat, parameters)
    return flat


def _parts(flat: torch.Tensor, shapes: Sequence[torch.Size]) -> list[torch.Tensor]:
    sizes = [shape.numel() for shape in shapes]
    return [part.view(shape) for part, shape in zip(flat.split(sizes), shapes, strict=True)]


class FlatAdam:
    """Adam (Kingma and Ba, 2015) by PyTorch's fused kernel, whose `state_dict` has the moments of `torch.optim.Adam`.

    The class is not derived from `torch.optim.Optimizer`, whose construction imports PyTorch's compiler: that takes
    seconds.

    Attributes:
        values: All parameters, (P,); each parameter is a view of this buffer.
        gradient: Gradient of the next step, (P,).
    """

    def __init__(self, parameters: Iterable[torch.Tensor], lr: float):
        """Construct the optimizer with a learning rate; the parameters, of one data type, become views of `values`."""
        parameters = list(parameters)
        self._shapes = [parameter.shape for parameter in parameters]
        self.values = flatten(parameters)
        self.gradient = torch.zeros_like(self.values)
        self._lr = lr
        self._moments = [torch.zeros_like(self.values) for _ in _MOMENTS]
        self._steps = torch.zeros(())

    def step(self) -> None:
        """Take one step with `gradient`."""
        first, second = self._moments
        self._steps += 1
        torch._fused_adam_(
            [self.values], [self.gradient], [first], [second], [], [self._steps],
            lr=self._lr, beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-8, amsgrad=False, maximize=False,
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Return the moments of each parameter by its index, as `torch.optim.Adam` does; none before the first step.

        `param_groups` is empty.
        """
        if not self._steps:
            return {"state": {}, "param_groups": []}
        moments = [_parts(moment, self._shapes) for moment in self._moments]
        named = [dict(zip(_MOMENTS, pair, strict=True)) for pair in zip(*moments, strict=True)]
        return {"state": {i: {"step": self._steps, **values} for i, values in enumerate(named)}, "param_groups": []}

    def load_state_dict(self, stored: Mapping[str, Any]) -> None:
        """Set the state from a `state_dict` of this class or of `torch.optim.Adam`.

        Raises:
            KeyError: If the moments of a parameter are missing.
            ValueError: If the number of moments or a shape differs.
        """
        state = stored["state"]
        for moment in self._moments:
            moment.zero_()
        self._steps.zero_()
        if not state:
            return
        if len(state) != len(self._shapes):
            raise ValueError(f"moments of {len(state)} parameters for {len(self._shapes)}")
        for name, moment in zip(_MOMENTS, self._moments, strict=True):
            for index, part in enumerate(_parts(moment, self._shapes)):
                if state[index][name].shape != part.shape:
                    raise ValueError(f"the moment {name} of parameter {index} has another shape")
                part.copy_(state[index][name])
        self._steps.copy_(state[0]["step"].reshape(()))  # safetensors stores 0-d arrays as 1-d


_SQUASH_EPSILON = 1e-6  # added to the derivative of tanh before taking the logarithm, as in Stable-Baselines3
_MAX_GATHERED = 2**22  # largest number of values in the batches sampled at once; only images exceed it

# SAC and TQC have no common interface that a type checker could use.
if TYPE_CHECKING:
    _Algorithm = Any
else:
    _Algorithm = object


class FastTrainingStep(_Algorithm):
    """Mixin that replaces the training step; it must come before SAC or TQC in the list of base classes.

    A subclass implements `_target_value`, `_critic_gradient`, `_value_gradient`, and for the logger `_critic_loss` and
    `_actor_value`.

    Attributes:
        records_metrics: True to record losses, values and the entropy coefficient in the algorithm's logger.
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
        shared = sum((inputs + 1) * outputs for inputs, outputs in pairwise(trunk))
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
        """Take `gradient_steps` gradient steps, each on a new batch."""
        steps_at_once = max(1, _MAX_GATHERED // (2 * batch_size * (self._features + self._actions)))
        for first in range(0, gradient_steps, steps_at_once):
            steps = min(steps_at_once, gradient_steps - first)
            self._train_batches(self.replay_buffer.sample(steps * batch_size), steps, batch_size)
        self._n_updates += gradient_steps

    def _train_batches(self, data: ReplayBufferSamples, steps: int, batch_size: int) -> None:
        """Take `steps` gradient steps on consecutive batches of `data`."""
        critic, features = self.policy.critic, self._features
        current_features = critic.extract_features(data.observations, critic.features_extractor)
        next_features = critic.extract_features(data.next_observations, critic.features_extractor)
        transitions = torch.cat([current_features, data.actions], dim=1).view(steps, batch_size, -1)
        states = torch.empty(steps, 2 * batch_size, transitions.shape[-1])
        states[:, :batch_size, :features] = current_features.view(steps, batch_size, -1)
        states[:, batch_size:, :features] = next_features.view(steps, batch_size, -1)
        rewards = data.rewards.view(steps, batch_size, 1)
        discounts = ((1 - data.dones) * self.gamma).view(steps, batch_size, 1)
        noise = torch.randn(steps, 2 * batch_size, self._actions)
        log_density = -(0.5 * noise.square() + 0.5 * math.log(2 * math.pi)).sum(dim=2, keepdim=True)
        for step in zip(states, transitions, rewards, discounts, noise, log_density, strict=True):
            self._gradient_step(*step)

    def _gradient_step(
        self,
        states: torch.Tensor,
        transitions: torch.Tensor,
        rewards: torch.Tensor,
        discounts: torch.Tensor,
        noise: torch.Tensor,
        log_density: torch.Tensor,
    ) -> None:
        """Take one gradient step on a batch of B transitions.

        Args:
            states: (2B, features + actions): rows of features, then of next features; the actions are overwritten.
            transitions: (B, features + actions): features and actions of the transitions.
            rewards: Rewards (B, 1).
            discounts: Discount factors (B, 1), 0 for a terminal transition.
            noise: Standard normal noise (2B, actions).
            log_density: Logarithm of the density of the noise, (2B, 1).
        """
        batch = len(transitions)
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
        values, critic_cache = self._critic.forward(transitions[None])
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
        """Take a gradient step on the entropy coefficient if it is learned; return its value before the step, (1,)."""
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
        """Return the critics' loss, which is only logged, given their outputs (n, B, outputs) and the target (B, …)."""
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
    """Soft actor-critic (Haarnoja et al., 2018); a value is the minimum over the critics."""

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
    """Truncated quantile critics (Kuznetsov et al., 2020): the largest quantiles of all critics are dropped."""

    def _build_networks(self) -> None:
        super()._build_networks()
        critic = self.policy.critic
        self._num_kept = critic.quantiles_total - self.top_quantiles_to_drop_per_net * critic.n_critics
        # ½ − τ for the fraction τ of each quantile.
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
        """Return the gradient of the quantile Huber loss, in which errors are clipped to ±1.

        With a clipped error e, the weighted error |τ − (e < 0)| e equals e/2 − (½ − τ)|e|.
        """
        errors = (target.T[:, None, :, None] - values).clamp_(-1, 1)  # (kept, n, B, quantiles)
        half = errors.sum(dim=0).mul_(0.5)
        return errors.abs_().sum(dim=0).mul_(self._quantile_weights).sub_(half).div_(errors.numel())

    def _actor_value(self, values: torch.Tensor) -> torch.Tensor:
        return values.mean(dim=(0, 2))[:, None]

    def _value_gradient(self, values: torch.Tensor) -> torch.Tensor:
        return torch.full_like(values, -1 / values.numel())


def _layers(values: torch.Tensor, gradient: torch.Tensor, sizes: list[int]) -> list[Linear]:
    """Return the layers of n networks; each row of `values` has the parameters of one network, layer by layer."""
    pairs = list(pairwise(sizes))
    counts = [(inputs + 1) * outputs for inputs, outputs in pairs]
    parts = zip(values.split(counts, dim=1), gradient.split(counts, dim=1), pairs, strict=True)
    return [Linear(value, derivative, *pair) for value, derivative, pair in parts]
