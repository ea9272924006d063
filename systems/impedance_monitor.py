"""What an impedance's wrench says about contact and about the controller's limits."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from guiderail.models.errors import InputError


class ImpedanceMonitor(LeafSystem):
    """The contact force that an impedance stands for, and whether it is at a limit.

    At rest the impedance's force is the contact force, K(x_d − x) = f. In a collision it is the better measure of the
    two: an impact's instantaneous force depends on a simulation's step, the impedance's does not.

    .. pydrake_system::

        name: ImpedanceMonitor
        input_ports:
        - impedance_wrench
        output_ports:
        - contact_force
        - saturation

    `impedance_wrench` is (6,), force [N] first, then torque [Nm]. `contact_force` is (1,) [N], the norm of its force.
    `saturation` is (1,): 1 if any of the six is within 0.1 % of its limit, otherwise 0.
    """

    def __init__(self, limits: np.ndarray):
        """
        Args:
            limits: of the wrench's magnitudes, (6,) [N, Nm], positive.

        Raises:
            InputError: if there are not six positive limits.
        """
        super().__init__()
        self._limits = np.array(limits, dtype=float)
        if self._limits.shape != (6,) or not (self._limits > 0.0).all():
            raise InputError(f"an impedance monitor needs six positive limits, not {limits}")
        self._wrench = self.DeclareVectorInputPort("impedance_wrench", 6)
        prerequisites = {self._wrench.ticket()}
        self._contact_force = self.DeclareVectorOutputPort("contact_force", 1, self._calc_contact_force, prerequisites)
        self._saturation = self.DeclareVectorOutputPort("saturation", 1, self._calc_saturation, prerequisites)

    def get_impedance_wrench_input_port(self):
        """The wrench that the impedance applies, (6,)."""
        return self._wrench

    def get_contact_force_output_port(self):
        """The norm of the impedance's force, (1,) [N]."""
        return self._contact_force

    def get_saturation_output_port(self):
        """1 at a limit, otherwise 0, (1,)."""
        return self._saturation

    def _calc_contact_force(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(np.linalg.norm(self._wrench.Eval(context)[:3])))

    def _calc_saturation(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float((np.abs(self._wrench.Eval(context)) >= 0.999 * self._limits).any()))
