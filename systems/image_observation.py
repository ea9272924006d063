"""Observation vector that contains a camera image and further entries."""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class ImageObservation(LeafSystem):
    """Concatenate a camera image and a vector.

        observation = [image / 255, state]

    The image is stored channel by channel (red, green, blue), each row by row.

    ``image`` is an abstract `ImageRgba8U` whose alpha channel is ignored. ``state`` is (n,). ``observation`` is
    (3 · height · width + n,).

    Args:
        width: Width of the image, at least 1 [pixels].
        height: Height of the image, at least 1 [pixels].
        state_size: Size n of the state, at least 1.
    """

    def __init__(self, width: int, height: int, state_size: int):
        super().__init__()
        self._image_port = self.DeclareAbstractInputPort("image", Value(ImageRgba8U(width, height)))
        self._state_port = self.DeclareVectorInputPort("state", state_size)
        size = 3 * height * width + state_size
        sources = [self._image_port, self._state_port]
        declare.output(self, "observation", size, self._observation, sources)

    get_image_input_port = input_getter("image", "color image, an abstract `ImageRgba8U`")
    get_state_input_port = input_getter("state", "further entries of the observation, (n,)")
    get_observation_output_port = output_getter("observation", "image in [0, 1] and state, (3 · height · width + n,)")

    def _observation(self, context: Context) -> np.ndarray:
        image = self._image_port.Eval(context).data[:, :, :3]
        pixels = np.moveaxis(image, -1, 0).ravel() / 255.0
        return np.concatenate([pixels, self._state_port.Eval(context)])
