"""Guidance skgrl with a history that becomes shorter in contact: response time and continuity of the command."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.diagrams.guidance.registry import build_guidance
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory

PERIOD, STEPS = 0.02, 60
CONTACT_STEPS = slice(20, 40)


@pytest.fixture(scope="module")
def skill():
    phase = np.linspace(0, 1, STEPS)
    means = np.column_stack([0.1 * np.sin(3 * phase), 0.3 * phase])
    reference = ReferenceTrajectory(PERIOD * np.arange(STEPS), means, np.tile(0.03**2 * np.eye(2), (STEPS, 1, 1)))
    constraints = LinearConstraints([[-1.0, 0.0]], [-0.11])
    return PrimitiveConfig(reference, constraints, PERIOD, horizon=10, history_variance=1e-8, wrench_size=3)


def rollout(skill, actions, forces, kind="skgrl"):
    """Return commands and history lengths of every control step; the measured pose is the commanded pose."""
    guidance = build_guidance(kind, PriorKnowledge(PERIOD, primitive=skill))
    simulator = Simulator(guidance)
    context = simulator.get_mutable_context()
    action = guidance.GetInputPort("action").FixValue(context, [0.0, 0.0])
    pose = guidance.GetInputPort("pose").FixValue(context, skill.reference.means[0])
    wrench = guidance.GetInputPort("wrench").FixValue(context, np.zeros(3))
    adaptive = guidance.HasSubsystemNamed("history_length")
    schedule = guidance.GetSubsystemByName("history_length") if adaptive else None
    simulator.Initialize()
    commands, lengths = [], []
    for n in range(STEPS):
        action.GetMutableData().set_value(actions[n])
        wrench.GetMutableData().set_value([0.0, 0.0, forces[n]])
        simulator.AdvanceTo((n + 0.5) * PERIOD)
        commands.append(guidance.GetOutputPort("desired_pose").Eval(context).copy())
        pose.GetMutableData().set_value(commands[-1])
        if schedule is not None:
            port = schedule.get_history_length_output_port()
            lengths.append(int(port.Eval(schedule.GetMyContextFromRoot(context))[0]))
    return np.array(commands), np.array(lengths)


def contact_forces():
    """Return the contact force [N] of every control step: 5 N during contact."""
    forces = np.zeros(STEPS)
    forces[CONTACT_STEPS] = 5.0
    return forces


def step_action(start):
    """Return actions that are 0 before the control step `start` and (0, 1) from there on."""
    actions = np.zeros((STEPS, 2))
    actions[start:, 1] = 1.0
    return actions


def test_history_has_full_length_without_contact(skill):
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2))
    plain, _ = rollout(skill, actions, np.zeros(STEPS))
    adaptive, lengths = rollout(replace(skill, adaptive_history=True), actions, np.zeros(STEPS))
    np.testing.assert_array_equal(adaptive, plain)
    assert set(lengths) == {10}


def test_adaptive_history_responds_faster_in_contact(skill):
    # Displacement of the command one and four control steps after a step of the action.
    displacement = {}
    for name, config in (("plain", skill), ("adaptive", replace(skill, adaptive_history=True))):
        without_action, _ = rollout(config, np.zeros((STEPS, 2)), contact_forces())
        with_action, _ = rollout(config, step_action(30), contact_forces())
        displacement[name] = np.abs(with_action - without_action)[[30, 33], 1]
    assert (displacement["adaptive"] > 2.0 * displacement["plain"]).all()


def test_command_is_continuous_when_the_history_changes(skill):
    adaptive = replace(skill, adaptive_history=True)
    constant = np.tile([0.0, 1.0], (STEPS, 1))
    commands, lengths = rollout(adaptive, constant, contact_forces())
    assert set(lengths) == {10, 5, 2, 1}
    changes = np.flatnonzero(np.diff(lengths)) + 1
    assert len(changes) >= 4
    distances = np.linalg.norm(np.diff(commands, axis=0), axis=1)  # distances[n - 1]: from command n - 1 to command n
    assert (distances[changes - 1] < 1.1 * distances[changes - 2]).all()
    # A change to kgrl, which has no history, would move the command farther.
    kgrl, _ = rollout(skill, constant, contact_forces(), kind="kgrl")
    assert (np.linalg.norm(kgrl - commands, axis=1)[changes[:2]] > 1.1 * distances[changes[:2] - 1]).all()


def test_constraint_is_satisfied_for_every_history_length(skill):
    rng = np.random.default_rng(1)
    for _ in range(3):
        forces = 5.0 * (rng.random(STEPS) < 0.5)
        actions = rng.choice([-1.0, 1.0], (STEPS, 2))
        commands, _ = rollout(replace(skill, adaptive_history=True), actions, forces)
        assert commands[:, 0].max() <= 0.11 + 1e-9
