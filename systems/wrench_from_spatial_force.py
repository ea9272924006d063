"""Wrench vector of a spatial force."""

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class WrenchFromSpatialForce(LeafSystem):
    """Convert Drake's `SpatialForce` into a wrench, force first; the inverse of `SpatialForceFromWrench`.

    ``spatial_force`` is an abstract `SpatialForce`. ``wrench`` is (6,) [fx fy fz tx ty tz] in N and Nm, at the same
    point and in the same axes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._spatial_force_port = self.DeclareAbstractInputPort("spatial_force", Value(SpatialForce.Zero()))
        declare.output(self, "wrench", WRENCH_SIZE, self._wrench, [self._spatial_force_port])

    get_spatial_force_input_port = input_getter("spatial_force", "spatial force")
    get_wrench_output_port = output_getter("wrench", "wrench, (6,), force first")

    def _wrench(self, context: Context) -> np.ndarray:
        force = self._spatial_force_port.Eval(context)
        return np.concatenate([force.translational(), force.rotational()])
