"""Environment GridClamp: scripted policies, constraints, rewards, observation and options."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.grid_clamp import (
    CENTER,
    MAX_TRACKING_ERROR,
    SCALE,
    STIFFNESS,
    TEMPLATE,
    GridClampUncertainty,
    scripted_search,
    straight_descent,
)
from guiderail.diagrams.tasks.insertion import InsertionReset
from guiderail.diagrams.tasks.options import COLLISION_FORCE
from guiderail.models.common.transforms import MM
from guiderail.tools.evaluation.evaluate import evaluate_policy

NEW_RUN = {"new_run": True}  # the hidden offsets are sampled again in every episode

GUIDANCE = ("sct", "residual", "none")
DOWN = np.array([0.0, 0.0, -1.0])

RUN = {}


@pytest.fixture(autouse=True)
def new_run():
    """Clear the hidden values of a run before each test."""
    RUN.clear()


def play(env, policy, *, seed=None, options=None):
    """Run an episode; return the last info, the return, and the sum of each reward term."""
    observation, _ = env.reset(seed=seed, options=options)
    total, finished, info = 0.0, False, {}
    terms = dict.fromkeys(env.diagram.reward_terms, 0.0)
    while not finished:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        total += reward
        for name in terms:
            terms[name] += info[name]
        finished = terminated or truncated
    return info, total, terms


@pytest.fixture(scope="module")
def env():
    return make_env("GridClamp")


@pytest.fixture(scope="module")
def env_without_offsets():
    return make_env("GridClamp", fixture_offset="none")


@pytest.fixture(scope="module")
def arm():
    return make_env("GridClamp", station="arm", fixture_offset="none")


def test_straight_descent_inserts_without_offsets(env_without_offsets):
    info, total, terms = play(env_without_offsets, lambda _: DOWN, seed=0)
    assert info["termination"] == "success"
    assert env_without_offsets.trace.statistics()["peak_force"] <= 10.0
    assert total == pytest.approx(sum(terms.values()))
    assert terms["terminal_reward"] == 50.0
    # The reward is 300 per meter of descent, and the start height is 15 to 18 mm.
    assert 300.0 * 0.014 < terms["shaping"] < 300.0 * 0.0185


def test_aligned_reward_rewards_approach_not_collision():
    """A straight descent at an offset of 2 mm presses on the table until the force limit ends the episode."""
    env = make_env("GridClamp", reward="aligned", difficulty="hard", bounded_force=False)
    info, _, terms = play(env, lambda _: np.array([0.0, 0.0, -1.0]), seed=0, options={"offset": (2.0 * MM, 0.0)})
    assert info["termination"] == "collision"
    assert terms["collision_cost"] == -25.0
    _, _, sideways = play(env, lambda _: np.array([-0.3, 0.0, 0.3]), seed=0, options={"offset": (2.0 * MM, 0.0)})
    assert sideways["collision_cost"] == 0.0
    # The cuboid ends at 4 mm, so the clamp moves from 2 mm on one side of the hole to 2 mm on the other side.
    assert sideways["alignment"] == pytest.approx(0.0, abs=1.5)


def test_straight_descent_fails_with_offsets():
    """The clamp presses on the table with at most 12 N until the time limit of 4 s."""
    env = make_env("GridClamp", seconds=4.0)
    rows = evaluate_policy(env, straight_descent, episodes=1, seed=1, options=NEW_RUN)
    assert rows["success"].sum() == 0
    assert rows["peak_force"].max() < 1.2 * MAX_TRACKING_ERROR * STIFFNESS


def test_scripted_search_inserts_with_offsets(env):
    rows = evaluate_policy(env, scripted_search, episodes=2, seed=1, options=NEW_RUN)
    assert rows["success"].sum() == 2
    assert rows["peak_force"].max() < 15.0


@pytest.mark.parametrize("guidance", GUIDANCE)
def test_commands_stay_in_the_cuboid_under_any_action(guidance):
    """Repeated corner actions reach every corner of the cuboid and the surface of the table."""
    env = make_env("GridClamp", guidance=guidance)
    size = env.action_space.shape
    rng = np.random.default_rng(3)
    corner = rng.choice([-1.0, 1.0], size)

    def adversary(_):
        nonlocal corner
        if rng.uniform() < 0.15:
            corner = rng.choice([-1.0, 1.0], size)
        return corner

    info, _, _ = play(env, adversary, seed=5)
    parameters = TEMPLATE.parameters
    commanded = env.trace.commanded
    assert np.abs(commanded[:, :2]).max() <= parameters["width_m"] / 2 + 1e-9
    assert commanded[:, 2].min() >= -parameters["push_m"] - 1e-9
    assert commanded[:, 2].max() <= parameters["height_m"] - parameters["push_m"] + 1e-9
    assert np.abs(commanded[:, 3:]).max() <= 1e-9
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    assert info["termination"] != "collision"
    if guidance != "residual":  # the command of a residual descends even if the clamp is blocked
        assert env.trace.statistics()["peak_force"] < 1.2 * MAX_TRACKING_ERROR * STIFFNESS


def test_push_is_a_collision_without_the_cuboid():
    env = make_env("GridClamp", guidance="none", active_constraints=False, bounded_force=False)
    info, _, _ = play(env, lambda _: np.array([0, 0, -0.5, 0, 0, 0]), seed=0, options={"offset": (0.003, 0.0)})
    assert info["termination"] == "collision"
    assert info["impedance_force"] > COLLISION_FORCE


def test_returns_of_both_rewards_differ_by_the_force_cost(env_without_offsets):
    without = make_env("GridClamp", fixture_offset="none", reward="no_force")
    _, with_cost, terms = play(env_without_offsets, lambda _: DOWN, seed=1)
    _, without_cost, _ = play(without, lambda _: DOWN, seed=1)
    assert terms["force_cost"] < -0.5
    assert with_cost - without_cost == pytest.approx(terms["force_cost"])


def test_observation_has_position_and_force(env):
    """The clamp presses on the table next to the holes; its pegs are 12 mm long."""
    env.reset(seed=0, options={"offset": (0.0025, 0.001)})
    for _ in range(8):
        observation, _, _, _, info = env.step(DOWN)
    position, force = (SCALE * observation + CENTER)[[2, 5]]
    assert position == pytest.approx(12.0 * MM, abs=0.1 * MM)
    assert force == pytest.approx(info["impedance_force"], rel=0.25)
    assert force > 5.0


def test_arm_inserts_without_offsets(arm):
    """The clamp descends at 12 mm/s; at a higher speed the arm's lateral error exceeds the chamfer."""
    info, _, _ = play(arm, lambda _: 0.3 * DOWN, seed=1)
    assert info["is_success"]
    assert arm.trace.statistics()["peak_force"] <= 10.0
    assert arm.trace.statistics()["collisions"] == 0


class TestUncertainty:
    def test_run_has_six_grasp_offsets_and_one_table_offset(self):
        fixture_offset, rng = GridClampUncertainty("per_run"), np.random.default_rng(0)
        tables, grasps = (
            np.array(column)
            for column in zip(*[fixture_offset.draw(rng, InsertionReset(), RUN) for _ in range(60)], strict=True)
        )
        assert (tables == tables[0]).all()
        assert 1.8 * MM <= np.linalg.norm(tables[0]) <= 2.2 * MM
        # The six grasp offsets of a run vary only by the repeatability, so at most five gaps are larger.
        gaps = np.diff(np.sort(grasps[:, 0]))
        assert 0.8 * MM < np.ptp(grasps[:, 0]) < 2.4 * MM
        assert (gaps > 0.2 * MM).sum() <= 5

    @pytest.mark.parametrize("kind", ["per_run", "per_episode", "none"])
    def test_cuboid_contains_every_sampled_hole(self, kind):
        fixture_offset, rng = GridClampUncertainty(kind), np.random.default_rng(1)
        draws = [fixture_offset.draw(rng, InsertionReset(new_run=True), RUN) for _ in range(500)]
        worst = max(np.abs(table - grasp).max() for table, grasp in draws)
        assert worst < TEMPLATE.parameters["width_m"] / 2 - 0.2 * MM

    def test_held_out_episode_differs_only_in_the_grasp_offset(self):
        fixture_offset = GridClampUncertainty("per_run")
        table, grasp = fixture_offset.draw(np.random.default_rng(7), InsertionReset(), RUN)
        table_held_out, grasp_held_out = fixture_offset.draw(
            np.random.default_rng(7), InsertionReset(held_out=True), RUN
        )
        np.testing.assert_array_equal(table, table_held_out)
        assert (grasp != grasp_held_out).any()
