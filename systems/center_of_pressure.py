"""Center of pressure of a contact, computed from its wrench."""

import numpy as np
from pydrake.systems.framework import LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import WRENCH_SIZE
from guiderail.models.control.wrench import center_of_pressure
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class CenterOfPressure(LeafSystem):
    """Center of pressure of a contact force along z, relative to the tool center.

        center_of_pressure = (−τ_y, τ_x) / f_z if f_z ≥ min_force, otherwise 0

    A point force along z at p has the torque τ = p × f, so the center of pressure is p for any magnitude of the force.

    ``wrench`` is (6,), force and torque about the tool center [N, Nm]. ``center_of_pressure`` is (2,), x and y [m].

    Args:
        min_force: Force along z below which the output is 0 [N], positive and finite.

    Raises:
        InputError: If `min_force` is out of range.
    """

    def __init__(self, min_force: float):
        super().__init__()
        if not 0.0 < min_force < np.inf:
            raise InputError(f"a center of pressure needs a positive, finite minimum force, not {min_force} N")
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        declare.output(
            self,
            "center_of_pressure",
            2,
            lambda context: center_of_pressure(self._wrench_port.Eval(context), min_force),
            [self._wrench_port],
        )

    get_wrench_input_port = input_getter("wrench", "wrench about the tool center, (6,) [N, Nm]")
    get_center_of_pressure_output_port = output_getter("center_of_pressure", "center of pressure, (2,) [m]")
