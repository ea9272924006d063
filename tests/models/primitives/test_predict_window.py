import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory

TIMES = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.5])  # the clock is not uniform


@pytest.fixture
def primitive():
    means = np.column_stack([TIMES, np.sin(TIMES)])
    reference = ReferenceTrajectory(TIMES, means, np.tile(0.01 * np.eye(2), (6, 1, 1)))
    return LcNsKmp(reference, history=2, horizon=3)


@pytest.mark.parametrize("step", [0, 3, 5, 9])
def test_predict_window_equals_predict_for_the_reference(primitive, step):
    window = np.minimum(np.minimum(step, 5) + np.arange(4), 5)
    means, covariances = primitive.reference.means[window], primitive.reference.covariances[window]
    history = np.array([[0.3, 0.1], [0.4, 0.2]])
    expected = primitive.predict(step, np.array([0.5, -1.0]), history).output
    found = primitive.predict_window(step, means, covariances, np.array([0.5, -1.0]), history).output
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_predict_window_refuses_asymmetric_covariances(primitive):
    covariances = np.tile(np.eye(2), (4, 1, 1))
    covariances[2, 0, 1] = 0.1
    with pytest.raises(InputError, match="the covariance of point 2 of a window is not symmetric"):
        primitive.predict_window(0, np.zeros((4, 2)), covariances, history=np.zeros((2, 2)))


@pytest.mark.parametrize("step", [-1, 0.5, np.nan, "a", None])
def test_predict_window_refuses_an_invalid_step(primitive, step):
    with pytest.raises(InputError, match="step"):
        primitive.predict_window(step, np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1)), history=np.zeros((2, 2)))
