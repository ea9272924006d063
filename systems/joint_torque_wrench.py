"""Estimate of the wrench on a tool from external joint torques, for an arm without a wrist sensor."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_plant

MAX_TORQUE = 1e4  # torque to which samples are clipped [Nm], far above the joint torques of an arm


class JointTorqueWrench(LeafSystem):
    """Estimate the wrench of the environment on a tool from external joint torques, low-pass filtered.

        F = (Jᵀ)⁺ τ_external,  t_f y' = F − y

    J is the Jacobian of the tool center, and y the output. τ_external are the measured joint torques minus the torques
    of the arm's weight and inertia. The controller of an arm with torque sensors provides τ_external. The pseudoinverse
    is damped, so that the estimate tends to zero near a singular posture instead of diverging.

    ``positions`` [rad] and ``external_torque`` [Nm] are (n,), in the order of the plant's joint positions. ``wrench``
    is (6,), at the tool center P in the axes of T, [fx fy fz tx ty tz] in N and Nm. It is a discrete state without
    direct feedthrough, delayed by one sample, and zero after an initialization. The first sample initializes the
    filter, because a filter that starts at zero would not have settled when the wrench is tared. Samples that are not
    finite are skipped. Torques are clipped to `MAX_TORQUE`, so that the effect of a single false sample of any size
    decays within a few time constants.

    Args:
        plant: Finalized model of only the arm.
        target: Frame T.
        tool_center: Frame P.
        period: Sampling period [s], positive.
        time_constant: Time constant t_f of the filter [s], not negative, finite; 0 disables it.
        damping: Damping of the pseudoinverse, not negative, finite; positive if a posture may be singular.

    Raises:
        InputError: If an argument is out of range.
        LinAlgError: At an update, if the damping is 0 and the posture is singular.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_center: Frame,
        *,
        period: float,
        time_constant: float,
        damping: float = 1e-4,
    ):
        super().__init__()
        if not (0.0 <= time_constant < np.inf and 0.0 <= damping < np.inf):
            raise InputError("a wrench estimate's time constant and damping must be finite and not negative")
        check_plant(plant, target=target, tool_center=tool_center)
        num_joints = plant.num_positions()
        self._plant, self._target, self._tool_center = plant, target, tool_center
        self._damping = damping * np.eye(6)
        self._decay = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0
        self._positions_port = self.DeclareVectorInputPort("positions", num_joints)
        self._external_torque_port = self.DeclareVectorInputPort("external_torque", num_joints)
        self._state = self.DeclareDiscreteState(6)
        self._has_sample = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("wrench", self._state)
        self._plant_context = declare.plant_context(self, plant, self._positions_port.Eval, [self._positions_port])
        declare.update(self, period, self._sample, declare.reset_to_default(self))

    get_positions_input_port = input_getter("positions", "measured joint positions, (n,) [rad]")
    get_external_torque_input_port = input_getter("external_torque", "external joint torques, (n,) [Nm]")
    get_wrench_output_port = output_getter("wrench", "filtered wrench on the tool, (6,), force first")

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        external_torque = self._external_torque_port.Eval(context)
        # NaN would remain in the state of the filter.
        if not is_finite(self._positions_port.Eval(context)) or not is_finite(external_torque):
            return EventStatus.DidNothing()
        plant_context, target = self._plant_context.Eval(context), self._target
        J = self._plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, self._tool_center, np.zeros(3), target, target
        )
        # [torque, force], because the rows of the Jacobian are [rotational, translational]
        F = np.linalg.solve(J @ J.T + self._damping, J @ np.clip(external_torque, -MAX_TORQUE, MAX_TORQUE))
        newest = np.concatenate([F[3:], F[:3]])
        if context.get_discrete_state().value(self._has_sample)[0]:
            last = context.get_discrete_state().value(self._state)
            newest = newest + self._decay * (last - newest)
        discrete_state.set_value(self._state, newest)
        discrete_state.set_value(self._has_sample, np.ones(1))
        return EventStatus.Succeeded()
