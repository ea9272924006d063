"""The nine demonstrations of the narrow passage have the properties that the task requires."""

import numpy as np
import pytest

from guiderail.models.objects.narrow_passage import PassageGeometry, load_demonstrations
from research.generate.narrow_passage import PERIOD, generate

GEOMETRY = PassageGeometry()


@pytest.fixture(scope="module")
def paths():
    """Return the positions (9, 400, 2)."""
    return np.stack(load_demonstrations().outputs)


def test_generate_reproduces_the_shipped_file(paths):
    generated = generate()
    # The tolerance allows for BLAS libraries that round the Cholesky factor differently.
    np.testing.assert_allclose(np.stack(generated.outputs), paths, atol=1e-8)
    np.testing.assert_array_equal(generated.times[0], load_demonstrations().times[0])


def test_load_returns_nine_demonstrations_of_400_points(paths):
    assert paths.shape == (9, 400, 2)
    np.testing.assert_allclose(np.diff(load_demonstrations().times[0]), PERIOD)


def test_demonstrations_are_smooth(paths):
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=2) / PERIOD
    acceleration = np.linalg.norm(np.diff(paths, 2, axis=1), axis=2) / PERIOD**2
    assert speed.max() < 1.0
    assert acceleration.max() < 2.0


def test_demonstrations_agree_only_in_the_passage(paths):
    in_passage = (paths[..., 1] > GEOMETRY.wall_y[0]) & (paths[..., 1] < GEOMETRY.wall_y[1])
    assert np.std([x[mask].mean() for x, mask in zip(paths[..., 0], in_passage, strict=True)]) < 0.005
    assert paths.std(axis=0)[:, 0].max() > 0.07
    differences = np.abs(paths[:, None] - paths[None]).max(axis=(2, 3)) + 9 * np.eye(9)  # 9 on the diagonal
    assert differences.min() > 0.02


def test_demonstrations_touch_no_wall(paths):
    lower, upper = GEOMETRY.walls
    points = paths.reshape(-1, 1, 2)
    assert not ((points > lower - 0.01) & (points < upper + 0.01)).all(axis=2).any()


def test_mean_crosses_the_obstacle(paths):
    mean = paths.mean(axis=0)
    assert np.hypot(*(mean - GEOMETRY.obstacle).T).min() < 0.6 * GEOMETRY.obstacle_radius


def test_two_demonstrations_enter_the_zone_but_not_the_mean(paths):
    assert (paths[..., 0] > GEOMETRY.zone_x).any(axis=1).sum() == 2
    assert paths.mean(axis=0)[:, 0].max() < GEOMETRY.zone_x
