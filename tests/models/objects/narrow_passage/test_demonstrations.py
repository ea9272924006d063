"""The nine demonstrations have the properties that the task needs."""

import numpy as np
import pytest

from guiderail.models.objects.narrow_passage import demonstrations as narrow_passage
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry

WORLD = PassageGeometry()


@pytest.fixture(scope="module")
def paths():
    """Return the positions (9, 400, 2)."""
    return np.stack(narrow_passage.load().outputs)


def test_generate_reproduces_the_shipped_file(paths):
    second = narrow_passage.generate()
    # Another BLAS may round the Cholesky factor differently.
    np.testing.assert_allclose(np.stack(second.outputs), paths, atol=1e-8)
    np.testing.assert_array_equal(second.times[0], narrow_passage.load().times[0])


def test_load_returns_nine_times_400_points(paths):
    assert paths.shape == (9, 400, 2)
    np.testing.assert_allclose(np.diff(narrow_passage.load().times[0]), narrow_passage.PERIOD)


def test_demonstrations_are_smooth(paths):
    speed = np.linalg.norm(np.diff(paths, axis=1), axis=2) / narrow_passage.PERIOD
    acceleration = np.linalg.norm(np.diff(paths, 2, axis=1), axis=2) / narrow_passage.PERIOD**2
    assert speed.max() < 1.0
    assert acceleration.max() < 2.0


def test_demonstrations_agree_only_in_the_passage(paths):
    middle = (paths[..., 1] > WORLD.wall_y[0]) & (paths[..., 1] < WORLD.wall_y[1])
    in_passage = [path[m, 0] for path, m in zip(paths, middle, strict=True)]
    assert np.std([x.mean() for x in in_passage]) < 0.005
    widest = paths.std(axis=0)[:, 0].max()
    assert widest > 0.07
    pairs = np.abs(paths[:, None] - paths[None]).max(axis=(2, 3)) + 9 * np.eye(9)
    assert pairs.min() > 0.02


def test_demonstrations_touch_no_wall(paths):
    lower, upper = WORLD.walls
    points = paths.reshape(-1, 1, 2)
    assert not ((points > lower - 0.01) & (points < upper + 0.01)).all(axis=2).any()


def test_mean_crosses_the_obstacle(paths):
    mean = paths.mean(axis=0)
    assert np.hypot(*(mean - WORLD.obstacle).T).min() < 0.6 * WORLD.obstacle_radius


def test_two_demonstrations_enter_the_zone_and_the_mean_does_not(paths):
    assert (paths[..., 0] > WORLD.zone_x).any(axis=1).sum() == 2
    assert paths.mean(axis=0)[:, 0].max() < WORLD.zone_x


def test_demonstrations_start_and_end_where_the_task_does(paths):
    assert np.hypot(*(paths[:, 0] - WORLD.start).T).max() < 0.03
    assert np.hypot(*(paths[:, -1] - WORLD.goal).T).max() < WORLD.goal_radius
