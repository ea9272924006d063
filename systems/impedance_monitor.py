"""Contact force and saturation of an impedance controller."""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.arrays import as_numbers, norm
from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class ImpedanceMonitor(LeafSystem):
    """Estimate the contact force from the wrench of an impedance, and detect that the wrench saturates.

        contact_force = ‖f‖,  at rest f = K (x_d − x)

    K is the stiffness, x_d the desired and x the measured pose. In a collision, this estimate is a better measure than
    the simulated contact force: the instantaneous force of an impact depends on the time step of the simulation, but
    the force of the impedance does not.

    .. pydrake_system::

        name: ImpedanceMonitor
        input_ports:
        - impedance_wrench
        output_ports:
        - contact_force
        - saturation

    ``impedance_wrench`` is (6,), force [N] first, then torque [Nm]. ``contact_force`` is (1,), the norm of the force
    [N]. ``saturation`` (1,) is 1 if any of the six components is within 0.1 % of its limit, otherwise 0.

    Args:
        limits: Limit of the magnitude of each component, (6,) [N, Nm], positive.

    Raises:
        InputError: If there are not six positive limits.
    """

    def __init__(self, limits: np.ndarray):
        super().__init__()
        checked = as_numbers(limits, "limits")
        if checked.shape != (6,) or not (checked > 0.0).all():
            raise InputError(f"an impedance monitor needs six positive limits, not {limits}")
        self._saturated = 0.999 * checked  # magnitudes from which a component counts as saturated
        self._impedance_wrench_port = self.DeclareVectorInputPort("impedance_wrench", 6)
        sources = [self._impedance_wrench_port]
        declare.scalar_output(self, "contact_force", self._contact_force, sources)
        declare.scalar_output(self, "saturation", self._saturation, sources)

    get_impedance_wrench_input_port = input_getter("impedance_wrench", "wrench that the impedance applies, (6,)")
    get_contact_force_output_port = output_getter("contact_force", "norm of the force of the impedance, (1,) [N]")
    get_saturation_output_port = output_getter("saturation", "flag that a component is at its limit, (1,)")

    def _contact_force(self, context: Context) -> float:
        return norm(self._impedance_wrench_port.Eval(context)[:3])

    def _saturation(self, context: Context) -> float:
        return float((np.abs(self._impedance_wrench_port.Eval(context)) >= self._saturated).any())
