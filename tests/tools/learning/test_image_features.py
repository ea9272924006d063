"""Features of observed images with each encoder."""

import gymnasium
import numpy as np
import pytest
import torch

from guiderail.tools.learning.networks import ImageFeatures, pack_observation

HEIGHT, WIDTH = 20, 25


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def features_of(image, encoder):
    """Return the features of one image in evaluation mode."""
    space = gymnasium.spaces.Box(0, 255, (image.size,), np.uint8)
    extractor = ImageFeatures(space, image.shape, encoder).eval()
    packed = torch.as_tensor(pack_observation(image, image.shape))[None]
    with torch.no_grad():
        features = extractor(packed)[0].numpy()
    assert len(features) == extractor.features_dim
    return features


def test_pixels_are_the_image_divided_by_255(image):
    assert features_of(image, "pixels") == pytest.approx(np.moveaxis(image, -1, 0).ravel() / 255)


def test_pooled_features_are_means_of_squares(image):
    squares = image.reshape(HEIGHT // 5, 5, WIDTH // 5, 5, 3).mean((1, 3)) / 255
    assert features_of(image, "average_pooling") == pytest.approx(np.moveaxis(squares, -1, 0).ravel(), abs=1e-6)
