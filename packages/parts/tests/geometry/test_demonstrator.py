"""Scripted demonstrator: variance, turns and repeatability of its motions."""

import numpy as np

from guiderail.models.common.transforms import MM
from guiderail_parts.geometry.demonstrator import (
    NUM_DEMONSTRATIONS,
    SPREAD,
    demonstrator_motions,
    plan_search,
    plan_straight_insertion,
    socket_offsets,
    socket_turns,
)

RIM, PRESS = 20.0 * MM, 2.5 * MM


def test_motions_have_the_variance_of_the_socket_offsets():
    script = plan_search(30.0 * MM, RIM, 0.0, 4.0 * MM, PRESS)
    times = np.arange(0.0, script[0][-1], 0.02)
    press_from = RIM - PRESS - 1.0 * MM
    motions = demonstrator_motions(0, script, press_from, times)
    assert motions.shape == (NUM_DEMONSTRATIONS, len(times), 6)
    heights = np.interp(times, script[0], script[1][:, 2])
    inserted = heights < press_from - 3.0 * MM
    assert inserted.sum() > 20
    np.testing.assert_allclose(motions[:, inserted, :2].mean(axis=1), socket_offsets(), atol=0.3 * MM)
    deviations = motions[:, :, :2].std(axis=0)
    assert deviations.min() > 0.5 * SPREAD / np.sqrt(2.0)  # the reach of an action is proportional to the deviation
    assert deviations.max() < 1.6 * SPREAD / np.sqrt(2.0)
    np.testing.assert_allclose(socket_offsets().mean(axis=0), 0.0, atol=1e-12)


def test_plans_advance_during_the_turn_of_a_screw():
    """Without an advance, the command is at the bottom before the turn begins."""
    turn, push, advance = -np.pi, 4.0 * MM, 1.0 * MM
    for plan, press in ((plan_straight_insertion, ()), (plan_search, (PRESS,))):
        _, poses = plan(30.0 * MM, RIM, turn, push, *press, advance)
        first = np.flatnonzero(poses[:, 3] == -turn)[-1]
        np.testing.assert_allclose(poses[first : first + 2, 2], [advance - push, -push])
        np.testing.assert_allclose(poses[first + 1 :, 3], 0.0)
        without_advance = plan(30.0 * MM, RIM, turn, push, *press)[1]
        assert np.isclose(without_advance[:, 2], -push).sum() > np.isclose(poses[:, 2], -push).sum()


def test_motions_depend_on_the_seed_alone():
    script = plan_search(30.0 * MM, RIM, 0.5, 4.0 * MM, PRESS)
    times = np.arange(0.0, script[0][-1], 0.02)
    first, again, different = (demonstrator_motions(seed, script, RIM, times) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - different).max() > 0.1 * MM


def test_socket_turns_are_uncorrelated_with_the_offsets():
    turns = socket_turns(0.08)
    assert np.abs(turns).max() == 0.08
    assert turns.std() > 0.7 * 0.08  # the reach of an action is proportional to the deviation
    np.testing.assert_allclose(np.column_stack([np.ones(len(turns)), socket_offsets()]).T @ turns, 0.0, atol=1e-12)
    script = plan_search(30.0 * MM, RIM, 0.0, 4.0 * MM, PRESS)
    times = np.arange(0.0, script[0][-1], 0.02)
    straight, turned = (demonstrator_motions(0, script, RIM, times, turn) for turn in (0.0, 0.08))
    expected = np.zeros((NUM_DEMONSTRATIONS, 1, 6))
    expected[:, 0, 3] = turns
    np.testing.assert_allclose(turned - straight, np.broadcast_to(expected, straight.shape), atol=1e-12)
