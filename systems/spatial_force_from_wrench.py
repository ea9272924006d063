"""Spatial force of a wrench vector."""

from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class SpatialForceFromWrench(LeafSystem):
    """Convert a wrench, force first, into Drake's `SpatialForce`, whose vector has the torque first.

    ``wrench`` is (6,) [fx fy fz tx ty tz] in N and Nm. ``spatial_force`` is an abstract `SpatialForce` at the same
    point and in the same axes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        zero = Value(SpatialForce.Zero())
        declare.abstract_output(self, "spatial_force", zero, self._spatial_force, [self._wrench_port])

    get_wrench_input_port = input_getter("wrench", "wrench, (6,), force first")
    get_spatial_force_output_port = output_getter("spatial_force", "spatial force")

    def _spatial_force(self, context: Context) -> SpatialForce:
        wrench = self._wrench_port.Eval(context)
        return SpatialForce(tau=wrench[3:], f=wrench[:3])
