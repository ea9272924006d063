"""Pouring at difficulty `hard`: the template has an estimate of the mug's position with an error."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring import (
    HARD,
    MAX_MUG_ERROR,
    frames_of,
    make_template,
    scripted_pour_aimed,
    scripted_pour_blind,
)
from guiderail.models.common.transforms import pose_to_transform, transform_to_pose
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy

PERIOD = 0.01  # control period [s]
START_OF_SEED_3 = [-0.05165154964949667, -0.27188929363368947, 0.12006535135237559]  # at difficulty `standard` [m]
ERROR = (0.045, 0.0)  # estimated position of the mug minus its position [m]


@pytest.fixture(scope="module")
def env():
    return make_env("Pouring", difficulty="hard")


def run(env, policy, **options):
    """Run an episode of up to 60 actions; return the infos of the reset and of the last step."""
    observation, reset_info = env.reset(seed=1, options=options)
    for _ in range(60):
        observation, _, terminated, truncated, info = env.step(policy(observation))
        if terminated or truncated:
            break
    return reset_info, info


@pytest.mark.parametrize(
    ("shield", "policy", "termination"),
    [
        (True, scripted_pour_aimed, "success"),
        (True, scripted_pour_blind, "time_limit"),
        (False, scripted_pour_blind, "spill"),
    ],
)
def test_aimed_policy_pours_and_blind_policy_spills_without_the_shield(env, shield, policy, termination):
    env = env if shield else make_env("Pouring", difficulty="hard", shield=False)
    reset_info, info = run(env, policy, mug_error=ERROR)
    np.testing.assert_array_equal(reset_info["mug_error"], ERROR)
    assert info["termination"] == termination
    assert env.trace.statistics()["max_commanded_violation"] <= 1e-9
    assert env.trace.statistics()["collisions"] == 0.0


def command_states(template, frames, actions, X_TP):
    """Yield state and command of every control step from the pose `X_TP` on, where every command is reached."""
    state = template.state_at(X_TP, frames)
    for action in actions:
        request = template.displace(X_TP, template.map(state, action, X_TP, frames, PERIOD))
        command = template.command(state, X_TP, request, frames, PERIOD).X_WE
        X_TP = pose_to_transform(transform_to_pose(command))
        yield state, X_TP
        state = template.next_state(state, X_TP, frames)


@pytest.mark.parametrize("name", ["uniform_random", "random_hold", "bang_bang", "random_corner"])
def test_commands_satisfy_the_constraints_in_all_states(env, name):
    """The template without the simulated arm, for hundreds of control steps in all three states."""
    template = make_template(env.diagram.task.workcell(), aim=True)
    frames = frames_of(template, RigidTransform([0.02, -0.01, 0.0]))
    start = template.project(template.initial_state, RigidTransform([0.02, -0.27, 0.12]), frames)
    worst, reached = 0.0, set()
    for seed in range(2):
        act = BASELINES[name](np.random.default_rng(seed), 3)
        # With the first seed, 25 actions move forwards in addition, which reaches the state Pour.
        forwards = [np.array([0.0, 2.0 * (seed % 2 == 0 and k < 25), 0.0]) for k in range(45)]
        actions = np.repeat([np.clip(act(None) + bias, -1.0, 1.0) for bias in forwards], 10, axis=0)
        for state, X_TP in command_states(template, frames, actions, start):
            reached.add(state)
            worst = max(worst, template.violation(state, X_TP, frames))
    assert worst <= 1e-9
    assert reached == {0, 1, 2}


def test_commands_on_the_arm_satisfy_the_constraints():
    """The violation is computed from the command of every control step, without the diagram's own output."""
    stepwise = make_env("Pouring", difficulty="hard", action_repeat=1)
    diagram, context = stepwise.diagram.diagram, stepwise.simulator.get_context()
    corners = BaselinePolicy(BASELINES["bang_bang"], stepwise)
    corners.on_episode_start()
    task = stepwise.diagram.task
    template = make_template(task.workcell(), aim=True)
    _, info = stepwise.reset(seed=3)
    frames = frames_of(template, RigidTransform([*(info["mug_position"] + info["mug_error"]), 0.0]))
    for _ in range(60):
        stepwise.step(corners(None))
        state = int(diagram.GetOutputPort("state").Eval(context)[0])
        desired = pose_to_transform(diagram.GetOutputPort("desired_pose").Eval(context))
        assert template.violation(state, desired, frames) <= 1e-9


def test_mug_error_is_sampled_in_its_range_and_observed(env):
    errors = []
    for held_out in (False, True) * 4:
        observation, info = env.reset(options={"held_out": held_out})
        errors.append(info["mug_error"])
        np.testing.assert_allclose(observation[6:8] * MAX_MUG_ERROR, info["mug_error"], atol=1e-8)
        assert observation[8] == -1.0  # the state is not Pour
    lengths = np.linalg.norm(errors, axis=1)
    np.testing.assert_array_equal(np.clip(lengths, HARD["mug_error_least"], HARD["mug_error_most"]), lengths)
    assert len(np.unique(lengths)) == len(lengths)


def test_standard_has_its_observation_and_start():
    standard = make_env("Pouring")
    assert standard.observation_space.shape == (6,)
    assert standard.diagram.num_steps == 1500
    _, info = standard.reset(seed=3)
    assert "mug_error" not in info
    np.testing.assert_array_equal(info["start"], START_OF_SEED_3)
