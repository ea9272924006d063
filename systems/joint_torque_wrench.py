"""The wrench on a tool from what an arm's joints feel, for an arm without a wrist sensor."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem, ValueProducer

from guiderail.models.errors import InputError


class JointTorqueWrench(LeafSystem):
    """The wrench of the surroundings on a tool, F = (Jᵀ)⁺ τ_external, low-pass filtered.

    τ_external is what is left of the measured joint torques when the arm's own weight and inertia are taken out; an
    arm with torque sensors computes it itself. The pseudoinverse is damped: near a singular posture the estimate fades
    instead of exploding. The filter is y' = (u − y)/τ, sampled at `period`.

    .. pydrake_system::

        name: JointTorqueWrench
        input_ports:
        - positions
        - external_torque
        output_ports:
        - wrench

    `positions` and `external_torque` are (n,). `wrench` is (6,), at the tool centre P in the axes of T, [fx fy fz tx ty
    tz] in N and Nm. It is state: one sample old, zero after a reset, and never feeds through.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        target: Frame,
        tool_centre: Frame,
        *,
        period: float,
        time_constant: float,
        damping: float = 1e-4,
    ):
        """
        Args:
            plant: the arm alone, finalized.
            target: T, in whose axes the wrench is reported.
            tool_centre: P.
            period: of the sampling [s], positive.
            time_constant: τ of the filter [s]; 0 does not filter.
            damping: of the pseudoinverse, not negative.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        if not period > 0.0 or not 0.0 <= time_constant < np.inf or not damping >= 0.0:
            raise InputError("a wrench estimate's period must be positive, its time constant and damping not negative")
        num_joints = plant.num_positions()
        self._plant, self._target, self._tool_centre, self._damping = plant, target, tool_centre, damping
        self._kept = float(np.exp(-period / time_constant)) if time_constant > 0.0 else 0.0
        self._positions = self.DeclareVectorInputPort("positions", num_joints)
        self._torque = self.DeclareVectorInputPort("external_torque", num_joints)
        self._state = self.DeclareDiscreteState(6)
        self._wrench = self.DeclareStateOutputPort("wrench", self._state)
        self._kinematics = self.DeclareCacheEntry(
            "kinematics",
            ValueProducer(
                allocate=lambda: Value(plant.CreateDefaultContext()),
                calc=lambda context, value: plant.SetPositions(
                    value.get_mutable_value(), self._positions.Eval(context)
                ),
            ),
            {self._positions.ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)

    def get_positions_input_port(self):
        """Joint positions, (n,)."""
        return self._positions

    def get_external_torque_input_port(self):
        """Joint torques that the surroundings cause, (n,) [Nm]."""
        return self._torque

    def get_wrench_output_port(self):
        """The filtered wrench of the surroundings on the tool, (6,), force first."""
        return self._wrench

    def _sample(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        J = self._plant.CalcJacobianSpatialVelocity(
            self._kinematics.Eval(context),
            JacobianWrtVariable.kV,
            self._tool_centre,
            np.zeros(3),
            self._target,
            self._target,
        )
        # [torque, force], as the Jacobian's rows are [rotational, translational]
        F = np.linalg.solve(J @ J.T + self._damping * np.eye(6), J @ self._torque.Eval(context))
        newest = np.concatenate([F[3:], F[:3]])
        last = context.get_discrete_state(self._state).value()
        discrete_state.set_value(newest + self._kept * (last - newest))
        return EventStatus.Succeeded()
