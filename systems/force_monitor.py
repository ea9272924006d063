"""Forces of an impedance and of the contact, and saturation of the impedance."""

import numpy as np
from pydrake.systems.framework import Context, InputPort, LeafSystem

from guiderail.models.common.arrays import norm
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class ForceMonitor(LeafSystem):
    """Compute the magnitudes of an impedance's force and of the contact force, and detect a saturated wrench.

        impedance_force = ‖f‖,  at rest f = K (x_d − x);   contact_force = ‖f_c‖

    K is the stiffness, x_d the desired and x the measured pose. A bound of the impedance bounds the first of the two.
    At rest both are equal; in an impact the contact force is larger, and depends on the time step of a simulation.

    ``impedance_wrench`` and ``contact_wrench`` are (6,), force [N] first, then torque [Nm]. ``impedance_force`` and
    ``contact_force`` are (1,), the norms of their forces [N]. ``saturation`` (1,) is 1 if any of the six components of
    the impedance wrench is within 0.1 % of its limit, otherwise 0.

    Args:
        limits: Limit of the magnitude of each component of the impedance wrench, (6,) [N, Nm], positive.
    """

    def __init__(self, limits: np.ndarray):
        super().__init__()
        self._saturated = 0.999 * np.asarray(limits)  # magnitudes from which a component counts as saturated
        self._impedance_wrench_port = self.DeclareVectorInputPort("impedance_wrench", 6)
        self._declare_force("impedance_force", self._impedance_wrench_port)
        self._declare_force("contact_force", self.DeclareVectorInputPort("contact_wrench", 6))
        declare.scalar_output(self, "saturation", self._saturation, [self._impedance_wrench_port])

    get_impedance_wrench_input_port = input_getter("impedance_wrench", "wrench that the impedance applies, (6,)")
    get_contact_wrench_input_port = input_getter("contact_wrench", "wrench of the contact on the tool, (6,)")
    get_impedance_force_output_port = output_getter("impedance_force", "norm of the force of the impedance, (1,) [N]")
    get_contact_force_output_port = output_getter("contact_force", "norm of the force of the contact, (1,) [N]")
    get_saturation_output_port = output_getter("saturation", "flag that a component is at its limit, (1,)")

    def _declare_force(self, name: str, wrench: InputPort) -> None:
        declare.scalar_output(self, name, lambda context: norm(wrench.Eval(context)[:3]), [wrench])

    def _saturation(self, context: Context) -> float:
        return float((np.abs(self._impedance_wrench_port.Eval(context)) >= self._saturated).any())
