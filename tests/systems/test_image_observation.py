import numpy as np
from pydrake.systems.sensors import ImageRgba8U

from guiderail.systems.policy_system import ImageObservation


def test_observation_is_the_channels_of_the_image_and_the_state():
    system = ImageObservation(width=4, height=3, state_size=2)
    context, image = system.CreateDefaultContext(), ImageRgba8U(4, 3)
    image.mutable_data[:] = np.arange(48).reshape(3, 4, 4)
    system.get_image_input_port().FixValue(context, image)
    system.get_state_input_port().FixValue(context, [0.5, -2.0])
    observation = system.get_observation_output_port().Eval(context)
    np.testing.assert_array_equal(observation[12:24], (np.arange(12) * 4 + 1) / 255)
    np.testing.assert_array_equal(observation[36:], [0.5, -2.0])
