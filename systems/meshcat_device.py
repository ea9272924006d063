"""A person's inputs from the browser view: a gamepad where there is one, sliders and keys everywhere."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem, OutputPort

from guiderail.systems.sampling import check_period

DEAD_ZONE = 0.1
"""A stick that nobody touches is rarely at zero."""


class MeshcatDevice(LeafSystem):
    """What a person asks for, in the place of what a policy asks for.

    .. pydrake_system::

        name: MeshcatDevice
        output_ports:
        - action

    ``action`` is (n,), in [−1, 1], sampled at the control period. An input follows its axis of the gamepad while that
    is out of its dead zone, and its slider otherwise; each slider has two keys.
    """

    def __init__(
        self, meshcat: Meshcat, axes: Sequence[tuple[int, float]], keys: Sequence[tuple[str, str]], period: float
    ):
        """
        Args:
            meshcat: the browser view.
            axes: for each input the number of the gamepad's axis and its sign.
            keys: for each input the keys that lower and raise its slider, in JavaScript's names.
            period: seconds between two looks, positive.

        Raises:
            ValueError: if the period is not positive, or axes and keys are not as many.
        """
        super().__init__()
        check_period(period)
        if len(axes) != len(keys) or not axes:
            raise ValueError(f"a device needs as many axes as pairs of keys, not {len(axes)} and {len(keys)}")
        self._meshcat, self._axes = meshcat, tuple(axes)
        self._sliders = [f"input {i + 1}" for i in range(len(axes))]
        for name, (lower, higher) in zip(self._sliders, keys, strict=True):
            meshcat.AddSlider(name, -1.0, 1.0, 0.25, 0.0, lower, higher)
        self._state = self.DeclareDiscreteState(len(axes))
        self._action_port = self.DeclareStateOutputPort("action", self._state)
        self.DeclareInitializationDiscreteUpdateEvent(self._look)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._look)

    def get_action_output_port(self) -> OutputPort:
        """What the person asks for, (n,), in [−1, 1]."""
        return self._action_port

    def read(self) -> np.ndarray:
        """What the person asks for now, (n,)."""
        gamepad = self._meshcat.GetGamepad()
        values = []
        for (axis, sign), slider in zip(self._axes, self._sliders, strict=True):
            stick = gamepad.axes[axis] if gamepad.index is not None and axis < len(gamepad.axes) else 0.0
            values.append(sign * stick if abs(stick) > DEAD_ZONE else self._meshcat.GetSliderValue(slider))
        return np.clip(values, -1.0, 1.0)

    def _look(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self.read())
        return EventStatus.Succeeded()
