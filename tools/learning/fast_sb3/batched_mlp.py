"""Several multilayer perceptrons of equal shape as one batched network, with gradients written out.

At a hundred units and batches of 64, a gradient step that calls one small layer after the other mostly pays for the
calls and for autograd's bookkeeping. Here a layer of all networks is one call, forward and backward.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

_EPSILON = 1e-5  # default of `torch.nn.functional.layer_norm`


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
