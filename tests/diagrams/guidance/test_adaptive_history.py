"""SKGRL with a history that shrinks in contact: quicker there, and without a jump when it changes."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.diagrams.guidance.registry import build_guidance
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory

PERIOD, STEPS, TOUCH = 0.02, 60, slice(20, 40)


@pytest.fixture(scope="module")
def skill():
    phase = np.linspace(0, 1, STEPS)
    means = np.column_stack([0.1 * np.sin(3 * phase), 0.3 * phase])
    reference = ReferenceTrajectory(PERIOD * np.arange(STEPS), means, np.tile(0.03**2 * np.eye(2), (STEPS, 1, 1)))
    constraints = LinearConstraints([[-1.0, 0.0]], [-0.11])
    return PrimitiveConfig(reference, constraints, PERIOD, horizon=10, history_variance=1e-8, wrench_size=3)


def rollout(skill, actions, forces, kind="skgrl"):
    """Commands and history lengths of every control step; the robot is where it was commanded."""
    guidance = build_guidance(kind, PriorKnowledge(PERIOD, demonstrations=skill))
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
            own = schedule.GetMyContextFromRoot(context)
            lengths.append(int(schedule.get_history_length_output_port().Eval(own)[0]))
    return np.array(commands), np.array(lengths)


def touching():
    forces = np.zeros(STEPS)
    forces[TOUCH] = 5.0
    return forces


def late_step(at):
    actions = np.zeros((STEPS, 2))
    actions[at:, 1] = 1.0
    return actions


def test_without_contact_it_is_skgrl(skill):
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 2))
    plain, _ = rollout(skill, actions, np.zeros(STEPS))
    adaptive, lengths = rollout(replace(skill, adaptive_history=True), actions, np.zeros(STEPS))
    np.testing.assert_array_equal(adaptive, plain)
    assert set(lengths) == {10}


def test_in_contact_it_answers_sooner(skill):
    """Return how far a sudden action has moved the command after one and after four control steps."""
    moved = {}
    for name, one in (("plain", skill), ("adaptive", replace(skill, adaptive_history=True))):
        still, _ = rollout(one, np.zeros((STEPS, 2)), touching())
        acted, _ = rollout(one, late_step(30), touching())
        moved[name] = np.abs(acted - still)[[30, 33], 1]
    assert (moved["adaptive"] > 2.0 * moved["plain"]).all()


def test_the_command_does_not_jump_when_the_history_changes(skill):
    adaptive = replace(skill, adaptive_history=True)
    constant = np.tile([0.0, 1.0], (STEPS, 1))
    commands, lengths = rollout(adaptive, constant, touching())
    assert set(lengths) == {10, 5, 2, 1}
    changes = np.flatnonzero(np.diff(lengths)) + 1
    assert len(changes) >= 4
    moved = np.linalg.norm(np.diff(commands, axis=0), axis=1)  # moved[n - 1] leads to command n
    assert (moved[changes - 1] < 1.1 * moved[changes - 2]).all()
    # What it would be to switch to no history at all.
    kgrl, _ = rollout(skill, constant, touching(), kind="kgrl")
    assert (np.linalg.norm(kgrl - commands, axis=1)[changes[:2]] > 1.1 * moved[changes[:2] - 1]).all()


def test_constraints_hold_for_every_history_length(skill):
    rng = np.random.default_rng(1)
    for _ in range(3):
        forces = 5.0 * (rng.random(STEPS) < 0.5)
        actions = rng.choice([-1.0, 1.0], (STEPS, 2))
        commands, _ = rollout(replace(skill, adaptive_history=True), actions, forces)
        assert commands[:, 0].max() <= 0.11 + 1e-9
