from importlib import import_module

import numpy as np
import pytest

from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import rms_gains
from guiderail.tools.figures import FIGURES, reproduce
from guiderail.tools.figures.properties import LOWER, UPPER, synthetic_demonstrations, whole_trajectory
from guiderail.tools.learning.run_folder import read_table
from guiderail.tools.viewing.passage import avoided_from


@pytest.fixture(scope="module")
def reference():
    return ReferenceTrajectory.from_demonstrations(synthetic_demonstrations(), components=6, num_steps=60)


@pytest.mark.parametrize("figure", FIGURES)
def test_every_figure_has_a_function(figure):
    module, function = FIGURES[figure]
    assert callable(getattr(import_module(f"guiderail.tools.figures.{module}"), function))


def test_a_whole_trajectory_is_a_window_that_spans_it(reference):
    constraints = LinearConstraints.box(LOWER, UPPER)
    primitive = LcNsKmp(reference, horizon=reference.num_steps - 1, constraints=constraints)
    for scale in (0.0, 1.0, 20.0):
        action = scale * rms_gains(primitive) * [0.3, 1.0]
        expected = primitive.predict(0, action).trajectory
        np.testing.assert_allclose(whole_trajectory(primitive, 0, action), expected, atol=1e-7)


def test_figure_4_2_shows_a_primitive_that_keeps_its_constraints(tmp_path):
    result = reproduce("4.2", out=tmp_path)
    rows = read_table(tmp_path / "figure_4_2.csv")
    assert max(row["worst_violation"] for row in rows) <= 1e-9
    assert any(row["worst_violation"] > -1e-9 for row in rows if row["panel"].startswith("A2"))
    assert result["exploration_follows_the_demonstrated_spread"] > 0.8
    assert (tmp_path / "figure_4_2.png").stat().st_size > 10_000


def test_figure_5_4_shows_that_pushes_are_recovered_from(tmp_path):
    reproduce("5.4", out=tmp_path)
    rows = read_table(tmp_path / "figure_5_4.csv")
    assert all(row["success"] for row in rows)
    assert all(row["steps_measured_in_the_zone"] <= 1 for row in rows)
    assert max(row["worst_commanded_violation"] for row in rows) <= 1e-9
    wide, narrow = ([row["steps_to_half"] for row in rows if row["y"] == y] for y in (0.20, 0.54))
    assert max(narrow) < max(wide)


def test_avoided_is_the_first_of_five_without_cost():
    costs = [-90, 0, 0, -30, -0.2, 0, 0, 0, 0, -50]
    assert avoided_from([{"reward_obstacle_cost": cost} for cost in costs]) == 5
    assert avoided_from([{"reward_obstacle_cost": -80.0}] * 9) is None
