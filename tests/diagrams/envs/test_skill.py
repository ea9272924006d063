"""Skill diagrams of a policy: motion equal to that of the environment, observations and refused policies."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_env, make_skill

CASES = {
    "NarrowPassage": {"guidance": "skgrl", "action_repeat": 5},
    "BncConnector": {"guidance": "kgrl", "action_repeat": 10, "fixture_offset": "per_episode"},
    "GridClamp": {"guidance": "sct", "action_repeat": 5},
    "Pouring": {"guidance": "sct", "action_repeat": 10},
}
NUM_ACTIONS = 8


def policy(size):
    """Return a deterministic policy with `size` actions, which depend on every observed number."""
    return lambda observation: np.tanh(np.outer(np.arange(1, size + 1), np.sin(observation)).sum(axis=1)).astype(float)


@pytest.mark.parametrize("task", CASES)
def test_skill_diagram_matches_the_environment_bit_for_bit(task):
    env = make_env(task, **CASES[task])
    act = policy(env.action_space.shape[0])
    observation, _ = env.reset(seed=3)
    for _ in range(NUM_ACTIONS):
        observation, *_ = env.step(act(observation))

    skill = make_skill(task, act, **CASES[task])
    simulator = Simulator(skill.diagram)
    context = simulator.get_mutable_context()
    skill.randomize(context, np.random.Generator(np.random.PCG64(np.random.SeedSequence(3))), {})
    simulator.Initialize()
    desired, measured = [], []
    for step in range(1, NUM_ACTIONS * env.action_repeat + 1):
        simulator.AdvanceTo(step * skill.control_period)
        desired.append(skill.diagram.GetOutputPort("desired_pose").Eval(context).copy())
        measured.append(skill.diagram.GetOutputPort("pose").Eval(context).copy())
    np.testing.assert_array_equal(desired[: len(env.trace)], env.trace.commanded)
    np.testing.assert_array_equal(measured[: len(env.trace)], env.trace.measured)


def test_skill_diagram_has_named_parts_and_no_reward():
    skill = make_skill("NarrowPassage", policy(2), guidance="kgrl")
    assert all(skill.diagram.HasSubsystemNamed(name) for name in ("observation", "policy", "guidance", "station"))
    assert not skill.diagram.HasOutputPort("reward")


def test_policy_receives_the_image_of_the_camera():
    shapes = []

    def act(image):
        shapes.append(image.shape)
        return np.zeros(2)

    skill = make_skill("NarrowPassage", act, guidance="kgrl", observation="image")
    simulator = Simulator(skill.diagram)
    skill.randomize(simulator.get_mutable_context(), np.random.default_rng(0), {})
    simulator.AdvanceTo(0.05)
    assert shapes == [(110, 144, 3)]
