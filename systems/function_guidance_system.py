"""Guidance that is one function of what is asked for and what is measured, once a control period."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period

GuidanceFunction = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class FunctionGuidanceSystem(LeafSystem):
    """Samples a policy's action and the measurements once a control period, and commands what a law makes of them.

        desired_pose[k] = law(action[k], pose[k], wrench[k])

    Where the law returns anything but O finite numbers, the last desired pose stays commanded, at first the measured
    pose, and ``fallback`` is 1: a robot is never sent NaN.

    .. pydrake_system::

        name: FunctionGuidanceSystem
        input_ports:
        - action
        - pose
        - wrench
        output_ports:
        - desired_pose
        - held_action
        - fallback

    ``action`` and ``held_action`` are (A,), ``pose`` and ``desired_pose`` (O,), ``wrench`` (W,), ``fallback`` (1,). The
    outputs are state: no input feeds through, so that a station's measured pose can close the loop.
    """

    def __init__(self, law: GuidanceFunction, action_size: int, pose_size: int, wrench_size: int, period: float):
        """
        Args:
            law: (action, pose, wrench) to a desired pose, a pure function: a reset can't restore a memory of its own.
            action_size: A, at least 1.
            pose_size: O, at least 1.
            wrench_size: W, at least 1.
            period: between two control steps [s], positive.

        Raises:
            InputError: if a size or the period is out of range.
        """
        super().__init__()
        check_period(period)
        if min(action_size, pose_size, wrench_size) < 1:
            raise InputError(f"guidance needs sizes of at least 1, not {action_size}, {pose_size} and {wrench_size}")
        self._law = law
        self._action_port = self.DeclareVectorInputPort("action", action_size)
        self._pose_port = self.DeclareVectorInputPort("pose", pose_size)
        self._wrench_port = self.DeclareVectorInputPort("wrench", wrench_size)
        self._desired = self.DeclareDiscreteState(pose_size)
        self._held = self.DeclareDiscreteState(action_size)
        self._lost = self.DeclareDiscreteState(1)
        self._desired_pose_port = self.DeclareStateOutputPort("desired_pose", self._desired)
        self._held_action_port = self.DeclareStateOutputPort("held_action", self._held)
        self._fallback_port = self.DeclareStateOutputPort("fallback", self._lost)
        self.DeclareInitializationDiscreteUpdateEvent(self._start)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._step)

    def get_action_input_port(self) -> InputPort:
        """The policy's action in [−1, 1], (A,)."""
        return self._action_port

    def get_pose_input_port(self) -> InputPort:
        """The measured pose, (O,)."""
        return self._pose_port

    def get_wrench_input_port(self) -> InputPort:
        """The measured wrench, (W,)."""
        return self._wrench_port

    def get_desired_pose_output_port(self) -> OutputPort:
        """What to command, (O,)."""
        return self._desired_pose_port

    def get_held_action_output_port(self) -> OutputPort:
        """The action that acts now, (A,)."""
        return self._held_action_port

    def get_fallback_output_port(self) -> OutputPort:
        """1 where the law gave nothing that can be commanded, (1,)."""
        return self._fallback_port

    def _start(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value(self._desired, self._pose_port.Eval(context))
        return self._step(context, discrete_state)

    def _step(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        action = self._action_port.Eval(context)
        returned = self._law(
            action.copy(), self._pose_port.Eval(context).copy(), self._wrench_port.Eval(context).copy()
        )
        try:
            desired = np.asarray(returned)
        except ValueError:
            desired = np.empty(0)
        usable = (
            desired.shape == (self._desired_pose_port.size(),)
            and desired.dtype.kind in "fiu"
            and bool(np.isfinite(desired).all())
        )
        if usable:
            discrete_state.set_value(self._desired, desired)
        discrete_state.set_value(self._held, action)
        discrete_state.set_value(self._lost, [0.0 if usable else 1.0])
        return EventStatus.Succeeded()
