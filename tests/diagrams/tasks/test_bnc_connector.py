"""Environment BncConnector: scripted policies, constraints, rewards, symmetry, demonstrations and images."""

from functools import cache

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env, make_prior_knowledge
from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.guidance.primitive import make_law
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.bnc_connector import (
    ALIGNMENT,
    NUM_STEPS,
    BncUncertainty,
    reference_trajectory,
    scripted_torque_search,
)
from guiderail.diagrams.tasks.insertion import ALIGNMENT_REWARD, DEPTH_REWARD, InsertionReset
from guiderail.diagrams.tasks.options import COLLISION_FORCE
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import demonstrations as shipped_demonstrations
from guiderail.models.primitives import Demonstrations
from guiderail.tools.evaluation.baselines import zero_policy
from guiderail.tools.evaluation.evaluate import evaluate_policy

NEW_RUN = {"new_run": True}  # the hidden offsets are sampled again in every episode

RUN = {}


@pytest.fixture(autouse=True)
def new_run():
    """Clear the hidden values of a run before each test."""
    RUN.clear()


def play(env, policy, *, seed=None, options=None, steps=np.inf):
    """Run an episode or its first control steps; return the last info, the return, and all observations."""
    observation, _ = env.reset(seed=seed, options=options)
    observations, total, finished, info = [observation], 0.0, False, {}
    while not finished and len(env.trace) < steps:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        observations.append(observation)
        total += reward
        finished = terminated or truncated
    return info, total, np.array(observations)


@pytest.fixture(scope="module")
def kmp():
    return make_env("BncConnector", guidance="kmp", fixture_offset="none")


@pytest.fixture(scope="module")
def kgrl():
    return make_env("BncConnector", guidance="kgrl", fixture_offset="per_episode")


@pytest.fixture(scope="module")
def skgrl():
    return make_env("BncConnector", guidance="skgrl", fixture_offset="per_run")


def test_spaces_have_the_documented_shapes(skgrl):
    assert skgrl.action_space.shape == (2,)
    assert skgrl.observation_space.shape == (13,)
    observation, _ = skgrl.reset(seed=0)
    assert observation in skgrl.observation_space
    assert observation[0] == -1.0


def test_demonstration_locks_when_the_offset_is_small(kmp):
    info, total, _ = play(kmp, zero_policy(kmp), seed=0, options={"offset": np.array([-0.2, -0.2]) * MM})
    assert info["termination"] == "success"
    assert info["control_steps"] < NUM_STEPS
    assert total > 50.0


def test_demonstration_fails_when_the_offset_is_hidden(skgrl):
    """Over many runs at most 20 % of the episodes succeed; the episode of this seed fails."""
    assert evaluate_policy(skgrl, zero_policy(skgrl), episodes=1, options=NEW_RUN)["success"].sum() == 0


@pytest.mark.parametrize("guidance", ["skgrl", "kgrl"])  # offset sampled per run and per episode
def test_torque_search_locks_when_the_offset_is_hidden(guidance, request):
    rows = evaluate_policy(request.getfixturevalue(guidance), scripted_torque_search, episodes=1, options=NEW_RUN)
    assert rows["success"].sum() == 1
    assert rows["max_commanded_violation"].max() <= 1e-9


@pytest.fixture(scope="module")
def safe_residual():
    return make_env("BncConnector", guidance="safe_residual", action_scale=3.0)


@pytest.mark.parametrize("guidance", ["kgrl", "skgrl", "safe_residual"])
def test_commands_satisfy_the_constraint_under_any_action(guidance, request):
    """Random corners of the square of actions, which change at every step, for 5 s: approach, search and insertion."""
    env = request.getfixturevalue(guidance)
    rng = np.random.default_rng(3)
    info, _, observations = play(env, lambda _: rng.choice([-1.0, 1.0], 2), seed=5, steps=250)
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    assert np.abs(env.trace.commanded[:, :2]).max() <= ALIGNMENT + 1e-9
    assert np.isfinite(observations).all()
    assert "simulation_failure" not in info


@pytest.fixture(scope="module")
def observe_on_rim(kmp):
    """Return a function from the offset of the jack [mm] to the mean observation of a plug on the rim."""

    @cache
    def observe(x_mm, y_mm):
        observation, _ = kmp.reset(seed=0, options={"offset": (x_mm * MM, y_mm * MM)})
        observations = [observation]
        for _ in range(13):
            observations.append(kmp.step(np.zeros(2))[0])
        return np.mean(observations[6:], axis=0)

    return observe


def test_contact_on_the_rim_is_invariant_under_a_half_turn(kmp, observe_on_rim):
    signs = np.diag(kmp.diagram.symmetry.observations[0])
    is_reversed = signs < 0
    direct, turned = observe_on_rim(1.0, 0.5), signs * observe_on_rim(-1.0, -0.5)
    torques = slice(10, 12)
    axis = np.array([0.5, -1.0]) / np.hypot(0.5, 1.0)  # of the torque of a contact force at the jack's offset
    # The torques are not equal, because the demonstrated motion and the contact crescent are not symmetric.
    for torque in (direct[torques], turned[torques]):
        assert np.linalg.norm(torque) > 0.3
        assert torque @ axis > 0.7 * np.linalg.norm(torque)
    np.testing.assert_allclose(direct[~is_reversed], turned[~is_reversed], atol=0.1)


def test_episode_ends_by_collision_when_force_is_not_bounded():
    """A residual commands the plug 24 mm down onto the rim of the jack, and neither pose nor force is bounded."""
    env = make_env(
        "BncConnector",
        guidance="residual",
        fixture_offset="per_episode",
        action_dims=(0, 1, 2),
        action_scale=20.0,
        bounded_force=False,
    )
    info, total, _ = play(env, lambda _: np.array([0.0, 0.0, -1.0]), seed=0, options={"offset": (0.0015, 0.0)})
    assert info["termination"] == "collision"
    assert info["impedance_force"] > COLLISION_FORCE
    assert env.trace.statistics()["collisions"] == 1
    assert total < -45.0


PRIOR_STD = (1.73 * MM, 1.73 * MM, 0.5 * MM, 0.02, 0.005, 0.005)


def test_single_demonstration_requires_prior_std(tmp_path):
    with pytest.raises(InputError, match="give prior_std"):
        make_env("BncConnector", guidance="kgrl", num_demonstrations=1)
    with pytest.raises(InputError, match="there are 5, which have"):
        make_env("BncConnector", guidance="kgrl", prior_std=PRIOR_STD)
    with pytest.raises(InputError, match="from 1 to 5, not 6"):
        make_env("BncConnector", guidance="kgrl", num_demonstrations=6)
    with pytest.raises(InputError, match="give meters and radians"):
        make_env("BncConnector", guidance="kgrl", num_demonstrations=1, prior_std=(1.7, *PRIOR_STD[1:]))
    single = Demonstrations.load(shipped_demonstrations.PATH).first(1)
    single.save(tmp_path / "single.npz")
    shipped = make_prior_knowledge("BncConnector", num_demonstrations=1, prior_std=PRIOR_STD).primitive.reference
    file = str(tmp_path / "single.npz")
    stored = make_prior_knowledge("BncConnector", demonstrations=file, prior_std=PRIOR_STD).primitive.reference
    np.testing.assert_allclose(stored.means, shipped.means, atol=1e-6)
    np.testing.assert_allclose(shipped.means[:, 2], single.outputs[0][:, 2], atol=2.5 * MM)
    assert (shipped.standard_deviations[:, :2] >= 1.73 * MM).all()


def test_action_displaces_the_command_by_the_prior_std():
    """An action of 1 displaces the command by √3 standard deviations: 3 mm for a prior of 1.73 mm."""
    law = make_law(make_prior_knowledge("BncConnector", num_demonstrations=1, prior_std=PRIOR_STD, bound=6.0 * MM))
    pose, commands = law.primitive.reference.means[0], []
    for action in (0.0, 1.0):
        state, columns = law.start(pose), []
        for _ in range(300):
            command = law.command(state, np.array([action, 0.0]), pose, np.zeros(6))
            state = law.next(state, command, pose)
            columns.append(command.pose[0])
        commands.append(np.array(columns))
    assert np.mean(commands[1] - commands[0]) == pytest.approx(3.0 * MM, rel=0.15)


def test_reward_is_the_sum_of_its_terms(kgrl):
    kgrl.reset(seed=2)
    action = np.array([0.5, -1.0])
    _, reward, _, _, info = kgrl.step(action)
    assert reward == pytest.approx(info["action_cost"] + info["force_cost"] + info["terminal_reward"])
    assert info["action_cost"] == pytest.approx(-0.01 * kgrl.action_repeat * action @ action)


def test_shaped_reward_is_proportional_to_the_depth():
    env = make_env("BncConnector", guidance="kmp", reward="shaped", fixture_offset="none", action_repeat=10)
    env.reset(seed=0)
    start = reference_trajectory("insert").means[0, 2]
    depth = 0.0
    for _ in range(12):
        depth += env.step(np.zeros(2))[4]["depth"]
    assert depth == pytest.approx(DEPTH_REWARD * (start - env.trace.measured[-1, 2]) / MM, abs=0.5)


def test_aligned_reward_is_proportional_to_the_approach():
    """A constant action, from an initial distance of 2 mm between the axes of plug and jack."""
    env = make_env("BncConnector", guidance="kgrl", reward="aligned", fixture_offset="none", action_repeat=10)
    env.reset(seed=0, options={"offset": (2.0 * MM, 0.0)})
    reward = sum(env.step(np.array([1.0, 0.0]))[4]["alignment"] for _ in range(10))
    approach = 2.0 * MM - np.linalg.norm(env.trace.measured[-1, :2] - [2.0 * MM, 0.0])
    assert reward > 1.0
    assert reward == pytest.approx(ALIGNMENT_REWARD * approach / MM, abs=0.5)


class TestUncertainty:
    def test_per_run_jack_offset_is_constant_during_a_run(self):
        fixture_offset, rng = BncUncertainty("per_run"), np.random.default_rng(0)
        draws = [fixture_offset.draw(rng, InsertionReset(), RUN) for _ in range(20)]
        jacks, grasps = (np.array(column) for column in zip(*draws, strict=True))
        assert (jacks == jacks[0]).all()
        assert 1.0 * MM <= np.linalg.norm(jacks[0]) <= 1.5 * MM
        assert len({tuple(grasp) for grasp in grasps}) == 20
        assert np.linalg.norm(grasps, axis=1).max() <= 0.3 * MM

    def test_new_run_samples_another_jack_offset(self):
        fixture_offset, rng = BncUncertainty("per_run"), np.random.default_rng(0)
        first, _ = fixture_offset.draw(rng, InsertionReset(), RUN)
        second, _ = fixture_offset.draw(rng, InsertionReset(new_run=True), RUN)
        assert (first != second).any()

    def test_held_out_episode_differs_only_in_the_grasp_offset(self):
        fixture_offset = BncUncertainty("per_run")
        jack, grasp = fixture_offset.draw(np.random.default_rng(7), InsertionReset(), RUN)
        jack_held_out, grasp_held_out = fixture_offset.draw(
            np.random.default_rng(7), InsertionReset(held_out=True), RUN
        )
        np.testing.assert_array_equal(jack, jack_held_out)
        assert (grasp != grasp_held_out).any()

    def test_per_episode_jack_offset_is_uniform_in_a_disc(self):
        fixture_offset, rng = BncUncertainty("per_episode"), np.random.default_rng(1)
        radii = np.array([np.linalg.norm(fixture_offset.draw(rng, InsertionReset(), RUN)[0]) for _ in range(2000)])
        assert radii.max() <= 1.5 * MM
        # A disc of 1/√2 of the radius has half the area.
        assert np.mean(radii < 1.5 * MM / np.sqrt(2)) == pytest.approx(0.5, abs=0.04)

    @pytest.mark.parametrize(
        "options",
        [
            {"ofset": 1},
            {"offset": (1, 2, 3)},
            {"offset": "far"},
            {"offset": (0, np.nan)},
            {"offset": (1.5, 0.0)},  # millimeters instead of meters
            {"offset": (0.0, -0.5)},
        ],
    )
    def test_reset_option_is_refused_when_invalid(self, kmp, options):
        with pytest.raises(InputError):
            kmp.reset(options=options)


def test_contact_on_the_rim_is_similar_after_a_quarter_turn(kmp, observe_on_rim):
    """The contact is not equal, because the demonstrations search along the rim in one direction of rotation."""
    near = kmp.diagram.near_symmetry
    assert len(near.actions) == 7
    quarter = near.observations[0]
    direct, turned = observe_on_rim(1.0, 0.5), observe_on_rim(-0.5, 1.0)
    torques = slice(10, 12)
    expected = (quarter @ direct)[torques]
    assert np.linalg.norm(expected - turned[torques]) < 0.5 * np.linalg.norm(expected)


def test_near_symmetry_contains_the_exact_symmetry(kmp):
    exact, near = kmp.diagram.symmetry, kmp.diagram.near_symmetry
    sides = [k for k in range(7) if np.array_equal(near.actions[k], exact.actions[0])]
    assert any(np.array_equal(near.observations[k], exact.observations[0]) for k in sides)


@pytest.mark.parametrize("station", ["gantry", "arm"])
def test_wrist_image_changes_with_the_offset_of_the_jack(station):
    images = {}
    for name in ("image", "image_and_state"):
        env = make_env("BncConnector", guidance="kgrl", station=station, observation=name)
        for offset in ((0.0, 0.0), (0.0015, 0.0), (0.0, 0.0015)):
            images[name, offset] = env.reset(seed=0, options={"offset": offset})[0]
            assert env.observation_space.contains(images[name, offset])
        assert env.diagram.symmetry is env.diagram.near_symmetry is None
    image, both = images["image", (0.0, 0.0)], images["image_and_state", (0.0, 0.0)]
    np.testing.assert_allclose(both[:-13], np.moveaxis(image, -1, 0).ravel() / 255, atol=1e-6)
    for offset in ((0.0015, 0.0), (0.0, 0.0015)):
        is_changed = np.abs(images["image", offset].astype(int) - image).max(-1) > 30
        assert is_changed.sum() > 20
        np.testing.assert_allclose(images["image_and_state", offset][-13:-6], both[-13:-6], atol=1e-6)


@pytest.mark.parametrize("time_step", [0.01, 0.005])
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.1])
def test_plug_that_meets_the_bore_within_a_step_is_not_ejected(time_step, angle):
    """It has slipped off the rim, is 0.06 mm in the bore's wall, and becomes no faster."""
    task = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared
    workcell, direction = task.workcell(), np.array([np.cos(angle), np.sin(angle)])
    pose = np.array([0.0, 0.0, task.rim_contact().height - 0.22 * MM, np.pi / 2, 0.0, 0.0])
    pose[:2] = (workcell.dimensions.bore_clearance + 0.06 * MM) * direction
    station = STATIONS.get("gantry").build(workcell, time_step=time_step)
    driven = DrivenStation(station, linear_motion(np.array([0.0, 1.0]), np.array([pose, pose])), 5)
    driven.start(pose)
    velocities = np.array([*(18e-3 * direction), -15e-3, 0.0, 0.0, 0.0])
    station.plant.SetVelocities(driven.plant_context, velocities)
    speeds = []

    def record(context):
        found = station.plant.GetVelocities(station.plant.GetMyContextFromRoot(context))
        speeds.append(np.linalg.norm(found[:3]))

    driven.simulator.set_monitor(record)
    driven.run()
    assert len(speeds) > 5 * 0.02 / time_step
    assert max(speeds) <= np.linalg.norm(velocities)
