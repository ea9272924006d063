"""Several multilayer perceptrons of equal shape as one batched network with gradients written out, and their optimizer.

With a hundred units and batches of 64, calling one small layer after the other spends most of the time on the calls and
on autograd's bookkeeping. Here a layer of all networks is one call, forward and backward, and so is a step of Adam on
all parameters.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

_EPSILON = 1e-5  # default of `torch.nn.functional.layer_norm`
_MOMENTS = ("exp_avg", "exp_avg_sq")  # names in the state dictionary of `torch.optim.Adam`


class Linear:
    """The same affine layer of n networks, each with its own weights.

    Attributes:
        weight: Weights (n, outputs, inputs).
    """

    def __init__(self, values: torch.Tensor, gradient: torch.Tensor, inputs: int, outputs: int):
        """Construct the layer.

        Args:
            values: (n, outputs · inputs + outputs): weights and biases, a view of all parameters.
            gradient: The same view of their gradient, which `backward` writes.
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

        Args:
            x: Inputs of `forward`, (n or 1, batch, inputs).
            d: Gradient of its outputs, (n, batch, outputs).
        """
        torch.bmm(d.mT, x.expand(self._networks, -1, -1), out=self._weight_gradient)
        torch.sum(d, 1, out=self._bias_gradient)

    def input_gradient(self, d: torch.Tensor, shared: bool, columns: slice = slice(None)) -> torch.Tensor:
        """Return the gradient of `columns` of the input, (n or 1, batch, columns); summed if the input is shared."""
        by_network = torch.bmm(d, self.weight[:, :, columns])
        return by_network.sum(0, keepdim=True) if shared and self._networks > 1 else by_network


def _split(flat: torch.Tensor, inputs: int, outputs: int) -> tuple[torch.Tensor, torch.Tensor]:
    weight, bias = flat.split([outputs * inputs, outputs], dim=1)
    return weight.unflatten(1, (outputs, inputs)), bias


@dataclass
class ForwardCache:
    """Intermediate results of a forward pass that the backward pass needs.

    Attributes:
        inputs: Input of each layer, (n or 1, batch, inputs).
        normalized: Of each hidden layer with normalization: its output, mean and inverse standard deviation.
    """

    inputs: list[torch.Tensor]
    normalized: list[tuple[torch.Tensor, ...]]

    def first(self, rows: int) -> "ForwardCache":
        """Return the cache of the first `rows` of the batch."""
        return ForwardCache(
            [x[:, :rows] for x in self.inputs], [tuple(x[:, :rows] for x in layer) for layer in self.normalized]
        )


class BatchedMLP:
    """Rectified hidden layers and an affine output layer; the number of networks may grow from layer to layer."""

    def __init__(self, layers: Sequence[Linear], layer_norm: bool):
        """Construct the networks.

        Args:
            layers: Layers from input to output. A layer of one network is shared by all networks of the layers after
                it.
            layer_norm: Normalize hidden layers, without learned parameters, before they are rectified.
        """
        self._layers = list(layers)
        self._layer_norm = layer_norm

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ForwardCache]:
        """Map inputs (n or 1, batch, inputs) to outputs (n, batch, outputs), and return the cache too."""
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
        """Write the gradient of all parameters, given that of the output, (n, batch, outputs)."""
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
        """Return the gradient of the output of layer `index - 1`, given that of layer `index`."""
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
    flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    for parameter, part in zip(parameters, _parts(flat, [p.shape for p in parameters]), strict=True):
        parameter.data = part
    return flat


def _parts(flat: torch.Tensor, shapes: Sequence[torch.Size]) -> list[torch.Tensor]:
    sizes = [shape.numel() for shape in shapes]
    return [part.view(shape) for part, shape in zip(flat.split(sizes), shapes, strict=True)]


class FlatAdam:
    """Adam (Kingma and Ba, 2015) by PyTorch's fused kernel, with the state dictionary of `torch.optim.Adam`.

    It is not derived from `torch.optim.Optimizer`, because creating one imports PyTorch's compiler, which takes
    seconds.

    Attributes:
        values: All parameters, (P,); each parameter is a view of it.
        gradient: Gradient of the next step, (P,).
    """

    def __init__(self, parameters: Iterable[torch.Tensor], lr: float):
        """Construct the optimizer.

        Args:
            parameters: Parameters of one data type; they become views of `values`.
            lr: Learning rate.
        """
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
        """Return the moments of each parameter by its index, as `torch.optim.Adam` does; none before the first step."""
        if not self._steps:
            return {"state": {}, "param_groups": []}
        moments = [_parts(moment, self._shapes) for moment in self._moments]
        named = [dict(zip(_MOMENTS, pair, strict=True)) for pair in zip(*moments, strict=True)]
        return {"state": {i: {"step": self._steps, **one} for i, one in enumerate(named)}, "param_groups": []}

    def load_state_dict(self, stored: Mapping[str, Any]) -> None:
        """Set the state to that of a `state_dict`, also one of `torch.optim.Adam`.

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
