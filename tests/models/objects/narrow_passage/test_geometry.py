import numpy as np
import pytest

from guiderail.models.objects.narrow_passage import PassageGeometry, action_cost

GEOMETRY = PassageGeometry()


def test_obstacle_cost_is_equation_4_24():
    edge = np.array(GEOMETRY.obstacle) + [GEOMETRY.obstacle_radius, 0.0]
    assert GEOMETRY.obstacle_distance(edge) == pytest.approx(0.0)
    assert GEOMETRY.obstacle_cost(edge) == pytest.approx(-4.0)
    assert GEOMETRY.obstacle_cost(edge + [0.01, 0.0]) == pytest.approx(-3.0)
    assert GEOMETRY.obstacle_cost(edge + [0.04, 0.0]) == pytest.approx(0.0)
    assert GEOMETRY.obstacle_cost(edge + [0.5, 0.0]) == 0.0


def test_action_cost_is_equation_4_23():
    assert action_cost(np.array([0.3, -0.4])) == pytest.approx(-2.5)


def test_zone_is_the_constraint_of_the_thesis():
    np.testing.assert_array_equal(GEOMETRY.constraints.G, [[-1.0, 0.0]])
    np.testing.assert_array_equal(GEOMETRY.constraints.c, [-0.6])
    assert GEOMETRY.constraints.violation(np.array([0.7, 0.0])) == pytest.approx(0.1)


def test_walls_leave_only_the_gap():
    lower, upper = GEOMETRY.walls
    assert upper[0, 0] == GEOMETRY.gap_x[0]
    assert lower[1, 0] == GEOMETRY.gap_x[1]
    assert upper[0, 0] - lower[0, 0] >= 5
    assert upper[1, 0] - lower[1, 0] >= 5


def test_at_goal_and_in_passage_are_true_inside_only():
    assert not GEOMETRY.at_goal(np.array(GEOMETRY.start))
    assert GEOMETRY.at_goal(np.array(GEOMETRY.goal))
    assert not GEOMETRY.in_passage(np.array(GEOMETRY.start))
    assert GEOMETRY.in_passage(np.array([0.35, 0.55]))
