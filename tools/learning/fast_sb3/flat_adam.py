"""Adam on parameters in one buffer: a step is one call, independent of the number of layers."""

from collections.abc import Iterable, Mapping
from typing import Any

import torch

_MOMENTS = ("exp_avg", "exp_avg_sq")


def flatten(parameters: Iterable[torch.Tensor]) -> torch.Tensor:
    """Return one buffer of all parameters, in their order; each parameter becomes a view of it."""
    parameters = list(parameters)
    flat = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    for parameter, part in zip(parameters, _parts(flat, [p.shape for p in parameters]), strict=True):
        parameter.data = part
    return flat


def _parts(flat: torch.Tensor, shapes: Iterable[torch.Size]) -> list[torch.Tensor]:
    shapes = list(shapes)
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
            [self.values],
            [self.gradient],
            [first],
            [second],
            [],
            [self._steps],
            lr=self._lr,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-8,
            amsgrad=False,
            maximize=False,
        )

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
