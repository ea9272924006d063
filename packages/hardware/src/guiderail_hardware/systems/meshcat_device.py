"""Teleoperation input from Meshcat: gamepad, sliders and keys."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import output_getter

DEAD_ZONE = 0.1
"""Magnitude up to which the value of a gamepad axis is ignored; a released stick is rarely exactly at zero."""


class MeshcatDevice(LeafSystem):
    """Sample the input of an operator, which replaces the action of a policy.

    .. pydrake_system::

        name: MeshcatDevice
        output_ports:
        - action

    ``action`` is (n,), in [−1, 1], sampled once per period. Outside the dead zone, an entry is the value of its gamepad
    axis times its sign. Inside the dead zone, it is the value of its slider, which two keys move.

    Args:
        meshcat: Meshcat instance with the sliders and the gamepad.
        axes: Index and sign of the gamepad axis of each entry.
        keys: JavaScript codes of the keys that decrease and increase the slider of each entry.
        period: Sampling period [s], positive.

    Raises:
        InputError: If the period is not positive, there is no axis, or the numbers of axes and key pairs differ.
    """

    def __init__(
        self, meshcat: Meshcat, axes: Sequence[tuple[int, float]], keys: Sequence[tuple[str, str]], period: float
    ):
        super().__init__()
        if len(axes) != len(keys) or not axes:
            raise InputError(
                f"a device needs at least one axis and a pair of keys per axis, not {len(axes)} and {len(keys)}"
            )
        self._meshcat, self._axes = meshcat, tuple(axes)
        self._sliders = [f"input {i + 1}" for i in range(len(axes))]
        for name, (lower, higher) in zip(self._sliders, keys, strict=True):
            meshcat.AddSlider(name, -1.0, 1.0, 0.25, 0.0, lower, higher)
        self._state = self.DeclareDiscreteState(len(axes))
        self.DeclareStateOutputPort("action", self._state)
        declare.update(self, period, self._sample, self._sample)

    get_action_output_port = output_getter("action", "operator's input, (n,), in [−1, 1]")

    def read(self) -> np.ndarray:
        """Return the present input of the operator, (n,), in [−1, 1]."""
        gamepad = self._meshcat.GetGamepad()
        values = []
        for (axis, sign), slider in zip(self._axes, self._sliders, strict=True):
            stick = gamepad.axes[axis] if gamepad.index is not None and axis < len(gamepad.axes) else 0.0
            values.append(sign * stick if abs(stick) > DEAD_ZONE else self._meshcat.GetSliderValue(slider))
        return np.clip(values, -1.0, 1.0)

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self.read())
