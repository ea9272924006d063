"""Several equal multilayer perceptrons as one, and their gradients written out.

At a hundred units and batches of 64 a gradient step of one small layer after the other is mostly the cost of calling
them, and of autograd's book of what was called. Here a layer of all networks is one call, forward and backward.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

_EPSILON = 1e-5  # of `torch.nn.functional.layer_norm`


class Linear:
    """The same layer of n networks: affine, with n sets of weights.

    Attributes:
        weight: (n, outputs, inputs).
    """

    def __init__(self, values: torch.Tensor, gradient: torch.Tensor, inputs: int, outputs: int):
        """
        Args:
            values: (n, outputs · inputs + outputs): weights and biases, as a view of all parameters.
            gradient: the same of their gradient, which `backward` writes.
            inputs: of one network.
            outputs: of one network.
        """
        self.weight, bias = _split(values, inputs, outputs)
        self._transposed, self._bias = self.weight.mT, bias[:, None]
        self._weight_gradient, self._bias_gradient = _split(gradient, inputs, outputs)
        self._networks = len(values)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(n or 1, batch, inputs) to (n, batch, outputs)."""
        return torch.baddbmm(self._bias, x.expand(self._networks, -1, -1), self._transposed)

    def backward(self, x: torch.Tensor, d: torch.Tensor) -> None:
        """Writes the weights' gradient, given that of what `forward` made of `x`."""
        torch.bmm(d.mT, x.expand(self._networks, -1, -1), out=self._weight_gradient)
        torch.sum(d, 1, out=self._bias_gradient)

    def input_gradient(self, d: torch.Tensor, shared: bool, columns: slice = slice(None)) -> torch.Tensor:
        """That of so many columns of the input: (n or 1, batch, columns), added up if the networks share it."""
        by_network = torch.bmm(d, self.weight[:, :, columns])
        return by_network.sum(0, keepdim=True) if shared and self._networks > 1 else by_network


def _split(flat: torch.Tensor, inputs: int, outputs: int) -> tuple[torch.Tensor, torch.Tensor]:
    weight, bias = flat.split([outputs * inputs, outputs], dim=1)
    return weight.unflatten(1, (outputs, inputs)), bias


@dataclass
class ForwardCache:
    """What a forward pass leaves for the backward one: by layer, its input, and what the normalization knows."""

    inputs: list[torch.Tensor]
    normalized: list[tuple[torch.Tensor, ...]]

    def first(self, rows: int) -> "ForwardCache":
        """Of the first rows of the batch only."""
        return ForwardCache(
            [x[:, :rows] for x in self.inputs], [tuple(x[:, :rows] for x in kept) for kept in self.normalized]
        )


class BatchedMLP:
    """Hidden layers that are rectified, and one that is not; the number of networks may differ from layer to layer."""

    def __init__(self, layers: Sequence[Linear], layer_norm: bool):
        """
        Args:
            layers: from the input to the output. Networks that share what is before them share it throughout: one
                followed by n.
            layer_norm: whether hidden layers are normalized, without learned parameters, before they are rectified.
        """
        self._layers = list(layers)
        self._layer_norm = layer_norm

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ForwardCache]:
        """(n or 1, batch, inputs) to (n, batch, outputs)."""
        done = ForwardCache([x], [])
        for layer in self._layers[:-1]:
            x = layer.forward(x)
            if self._layer_norm:
                before = x
                x, mean, scale = torch.native_layer_norm(before, before.shape[-1:], None, None, _EPSILON)
                done.normalized.append((before, mean, scale))
            x = x.relu_()
            done.inputs.append(x)
        return self._layers[-1].forward(x), done

    def backward(self, done: ForwardCache, d: torch.Tensor) -> None:
        """Writes the gradient of all weights, given that of the output, (n, batch, outputs)."""
        for index in reversed(range(1, len(self._layers))):
            self._layers[index].backward(done.inputs[index], d)
            d = self._through(index, done, d)
        self._layers[0].backward(done.inputs[0], d)

    def input_gradient(self, done: ForwardCache, d: torch.Tensor, columns: slice) -> torch.Tensor:
        """That of so many columns of the input, (n or 1, batch, columns); no weight's gradient is touched."""
        for index in reversed(range(1, len(self._layers))):
            d = self._through(index, done, d)
        return self._layers[0].input_gradient(d, len(done.inputs[0]) == 1, columns)

    def _through(self, index: int, done: ForwardCache, d: torch.Tensor) -> torch.Tensor:
        """From behind a layer to behind the one before it."""
        x = done.inputs[index]
        d = torch.ops.aten.threshold_backward(self._layers[index].input_gradient(d, len(x) == 1), x, 0)
        if not self._layer_norm:
            return d
        before, mean, scale = done.normalized[index - 1]
        return torch.ops.aten.native_layer_norm_backward(
            d, before, before.shape[-1:], mean, scale, None, None, [True, False, False]
        )[0]
