"""Option `difficulty` of BncConnector and GridClamp, and the options that `hard` sets."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks import bnc_connector, grid_clamp
from guiderail.diagrams.tasks.bnc_connector import BncUncertainty, reference_trajectory, scripted_center_of_pressure
from guiderail.diagrams.tasks.grid_clamp import scripted_fast_search, straight_descent
from guiderail.diagrams.tasks.insertion import InsertionReset
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail.models.objects.grid_clamp import GridClampDimensions
from guiderail.tools.evaluation.baselines import zero_policy
from guiderail.tools.evaluation.evaluate import evaluate_policy

HARD = {"BncConnector": bnc_connector.HARD, "GridClamp": grid_clamp.HARD}
NEW_RUN = {"options": {"new_run": True}, "seed": 300_000}

RUN = {}


@pytest.fixture(autouse=True)
def new_run():
    """Clear the hidden values of a run before each test."""
    RUN.clear()


@pytest.fixture(scope="module")
def connector():
    return make_env("BncConnector", difficulty="hard", guidance="kgrl")


@pytest.fixture(scope="module")
def clamp():
    return make_env("GridClamp", difficulty="hard")


@pytest.mark.parametrize("task", HARD)
def test_hard_equals_its_options_set_separately(task):
    standard, hard = (EnvConfig.resolve(task, {"difficulty": name}).options for name in ("standard", "hard"))
    assert {name for name in hard if hard[name] != standard[name]} == {"difficulty", *HARD[task]}
    assert {name: hard[name] for name in HARD[task]} == HARD[task]
    assert EnvConfig.resolve(task, HARD[task]).options == hard | {"difficulty": "standard"}
    arguments = {"difficulty": "hard", "force_limit": 30.0}
    assert EnvConfig.resolve(task, arguments).options == hard | {"force_limit": 30.0}


@pytest.mark.parametrize("task", HARD)
def test_standard_has_the_default_dimensions_and_limits(task):
    config = EnvConfig.resolve(task, {})
    declared = config.declared
    dimensions = {"BncConnector": BncDimensions(), "GridClamp": GridClampDimensions()}[task]
    assert declared.workcell() == type(declared.workcell())(dimensions)
    assert declared.collision.above == 35.0
    assert config.num_steps == {"BncConnector": 400, "GridClamp": 500}[task]
    assert declared.observation == "state"
    if task == "BncConnector":
        assert declared.reference() is reference_trajectory("insert")
        np.testing.assert_array_equal(declared.constraints().c, -2.0 * MM)


JACK, PLUG = [0.08709568301284622, 1.0485589162894264], [0.12997660481050205, 0.19223467197202893]  # offsets [mm]


def test_seed_samples_the_same_offsets_in_every_version():
    """The samples of a seed must not change, because stored results depend on them."""
    fixture_offset, rng = BncUncertainty("per_run"), np.random.default_rng(3)
    jack, plug = fixture_offset.draw(rng, InsertionReset(), RUN)
    np.testing.assert_allclose(1e3 * jack, JACK, atol=1e-12)
    np.testing.assert_allclose(1e3 * plug, PLUG, atol=1e-12)


def test_hard_connector_has_its_dimensions_and_offsets(connector):
    declared = connector.unwrapped.diagram.task
    assert declared.workcell().dimensions.mouth_chamfer == 0.1 * MM
    assert declared.collision.above == 20.0
    radii = []
    for seed in range(20):
        _, info = connector.reset(seed=seed)
        radii.append(np.linalg.norm(info["jack_offset"]))
    assert 2.6 * MM <= min(radii) < max(radii) <= 3.0 * MM
    assert connector.observation_space.shape == (19,)
    assert connector.unwrapped.diagram.symmetry.observations.shape == (1, 19, 19)


def test_center_of_pressure_points_to_the_jack(connector):
    """The plug stands on the rim. The observation also contains the commanded position."""
    observation, info = connector.reset(seed=4)
    while observation[9] < 0.15:
        observation, _, _, _, _ = connector.step(np.zeros(2))
    center_of_pressure, commanded = observation[13:15] * 3.0 * MM, observation[15:17] * 2.0 * MM
    np.testing.assert_allclose(commanded, connector.unwrapped.trace.commanded[-1, :2], atol=1e-6)
    assert center_of_pressure @ info["jack_offset"] > 0.3 * np.linalg.norm(center_of_pressure) * np.linalg.norm(
        info["jack_offset"]
    )


def test_scripted_policy_locks_at_hard_and_zero_policy_fails(connector):
    row = evaluate_policy(connector, scripted_center_of_pressure, episodes=1, **NEW_RUN).iloc[0]
    assert row["success"]
    assert row["max_commanded_violation"] <= 1e-9
    assert not evaluate_policy(connector, zero_policy(connector), episodes=1, **NEW_RUN)["success"].any()


def test_pressed_bayonet_is_turned_by_a_robot_with_twice_the_stiffness():
    """The spring presses with nearly the whole force bound, along z and on the wall of the bore."""
    env = make_env("BncConnector", guidance="kgrl", difficulty="hard", disturbances={"stiffness_factor": 2.0})
    row = evaluate_policy(env, scripted_center_of_pressure, episodes=1, **NEW_RUN).iloc[0]
    assert row["success"]
    assert row["peak_force"] > 0.7 * env.diagram.task.force_limit


def test_fast_search_succeeds_at_hard_and_descent_fails(clamp):
    assert evaluate_policy(clamp, scripted_fast_search, episodes=3, **NEW_RUN)["success"].all()
    assert not evaluate_policy(clamp, straight_descent, episodes=1, **NEW_RUN)["success"].any()


def test_clamp_has_the_given_time_limit():
    env = make_env("GridClamp", seconds=2.0)
    env.reset(seed=0)
    info, truncated = {}, False
    while not truncated:
        *_, truncated, info = env.step(np.zeros(3))
    assert info["control_steps"] == 100
