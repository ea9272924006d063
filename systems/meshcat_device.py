"""Teleoperation from Meshcat: by a gamepad where there is one, by sliders and keys everywhere."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period

DEAD_ZONE = 0.1
"""Of a gamepad's axes: a stick that is released is rarely at zero."""


class MeshcatDevice(LeafSystem):
    """Samples a person's inputs, to take the place of a policy's actions.

    .. pydrake_system::

        name: MeshcatDevice
        output_ports:
        - action

    ``action`` is (n,), in [−1, 1], sampled at the control period. An input is its gamepad axis while that is out of its
    dead zone, and its slider otherwise; each slider has two keys.
    """

    def __init__(
        self, meshcat: Meshcat, axes: Sequence[tuple[int, float]], keys: Sequence[tuple[str, str]], period: float
    ):
        """
        Args:
            meshcat: that shows the sliders and reads the gamepad.
            axes: for each input the number of the gamepad's axis and its sign.
            keys: for each input the keys that lower and raise its slider, by JavaScript's codes.
            period: between two samples [s], positive.

        Raises:
            InputError: if the period is not positive, or there are not as many axes as pairs of keys.
        """
        super().__init__()
        check_period(period)
        if len(axes) != len(keys) or not axes:
            raise InputError(f"a device needs as many axes as pairs of keys, not {len(axes)} and {len(keys)}")
        self._meshcat, self._axes = meshcat, tuple(axes)
        self._sliders = [f"input {i + 1}" for i in range(len(axes))]
        for name, (lower, higher) in zip(self._sliders, keys, strict=True):
            meshcat.AddSlider(name, -1.0, 1.0, 0.25, 0.0, lower, higher)
        self._state = self.DeclareDiscreteState(len(axes))
        self._action_port = self.DeclareStateOutputPort("action", self._state)
        self.DeclareInitializationDiscreteUpdateEvent(self._sample)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)

    def get_action_output_port(self) -> OutputPort:
        """The person's inputs, (n,), in [−1, 1]."""
        return self._action_port

    def read(self) -> np.ndarray:
        """The person's inputs at this moment, (n,), in [−1, 1]."""
        gamepad = self._meshcat.GetGamepad()
        values = []
        for (axis, sign), slider in zip(self._axes, self._sliders, strict=True):
            stick = gamepad.axes[axis] if gamepad.index is not None and axis < len(gamepad.axes) else 0.0
            values.append(sign * stick if abs(stick) > DEAD_ZONE else self._meshcat.GetSliderValue(slider))
        return np.clip(values, -1.0, 1.0)

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self.read())
        return EventStatus.Succeeded()
