import numpy as np

from guiderail.systems import SpatialForceFromWrench


def test_spatial_force_has_the_force_and_the_torque_of_the_wrench():
    system = SpatialForceFromWrench()
    context = system.CreateDefaultContext()
    system.get_wrench_input_port().FixValue(context, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    force = system.get_spatial_force_output_port().Eval(context)
    np.testing.assert_array_equal(force.translational(), [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(force.rotational(), [4.0, 5.0, 6.0])
