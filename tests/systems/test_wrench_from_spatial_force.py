import numpy as np
from pydrake.multibody.math import SpatialForce

from guiderail.systems import WrenchFromSpatialForce


def test_wrench_has_the_force_first():
    system = WrenchFromSpatialForce()
    context = system.CreateDefaultContext()
    force = SpatialForce(tau=np.array([4.0, 5.0, 6.0]), f=np.array([1.0, 2.0, 3.0]))
    system.get_spatial_force_input_port().FixValue(context, force)
    np.testing.assert_array_equal(system.get_wrench_output_port().Eval(context), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
