import numpy as np

from guiderail.systems.movement_primitive import Residual


def test_desired_pose_is_reference_plus_scaled_action():
    system = Residual([0.1, 2.0])
    context = system.CreateDefaultContext()
    system.get_reference_input_port().FixValue(context, [1.0, 2.0])
    system.get_action_input_port().FixValue(context, [0.5, -1.0])
    np.testing.assert_allclose(system.get_desired_pose_output_port().Eval(context), [1.05, 0.0])
