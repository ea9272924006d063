"""Conversion of systems to AutoDiffXd and Expression: gradients against finite differences, and refusals."""

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Expression, Variable
from pydrake.systems.framework import DiagramBuilder

from guiderail import systems
from guiderail.models.common.errors import InputError
from oracles.systems import check_stale_outputs

STEP = 1e-6


def test_diagram_of_residual_and_reward_has_derivatives():
    """The reward with respect to the action equals central differences."""
    builder = DiagramBuilder()
    residual = builder.AddNamedSystem("residual", systems.Residual(np.full(6, 0.05)))
    terms = [
        systems.RewardTerm("effort", {"pose": 6}, lambda pose: -0.01 * pose @ pose),
        systems.RewardTerm("nearness", {"pose": 6}, lambda pose: np.exp(-np.linalg.norm(pose[:3]))),
        systems.RewardTerm("time", {}, lambda: -1.0),
    ]
    reward = builder.AddNamedSystem("reward", systems.RewardSystem(terms))
    builder.Connect(residual.get_desired_pose_output_port(), reward.get_signal_input_port("pose"))
    builder.ExportInput(residual.get_reference_input_port(), "reference")
    builder.ExportInput(residual.get_action_input_port(), "action")
    builder.ExportOutput(reward.get_reward_output_port(), "reward")
    diagram, pose = builder.Build(), np.linspace(0.1, 0.6, 6)

    def evaluate(action, diagram):
        context = diagram.CreateDefaultContext()
        diagram.GetInputPort("reference").FixValue(context, pose)
        diagram.GetInputPort("action").FixValue(context, action)
        return diagram.GetOutputPort("reward").Eval(context)

    action, steps = np.array([0.1, -0.2, 0.3, 0.0, 0.2, -0.1]), STEP * np.eye(6)
    found = evaluate(InitializeAutoDiff(action).ravel(), diagram.ToAutoDiffXd())
    np.testing.assert_allclose(ExtractValue(found).ravel(), evaluate(action, diagram), rtol=1e-9)
    differences = [(evaluate(action + step, diagram) - evaluate(action - step, diagram)) / (2 * STEP) for step in steps]
    np.testing.assert_allclose(ExtractGradient(found), np.column_stack(differences), rtol=1e-6, atol=1e-9)


def test_no_output_of_a_converted_system_is_stale():
    reward = systems.RewardSystem([systems.RewardTerm("cost", {"pose": 2}, lambda pose: -pose @ pose)])
    for system in (systems.Residual([2.0, 3.0]), reward):
        for converted in (system.ToAutoDiffXd(), system.ToSymbolic()):
            check_stale_outputs(converted)


def test_residual_and_reward_are_formulas():
    action, pose = (np.array([Expression(Variable(f"{name}{i}")) for i in range(2)]) for name in "ap")
    residual = systems.Residual([2.0, 3.0]).ToSymbolic()
    context = residual.CreateDefaultContext()
    residual.GetInputPort("reference").FixValue(context, pose)
    residual.GetInputPort("action").FixValue(context, action)
    sums = residual.GetOutputPort("desired_pose").Eval(context)
    assert all(entry.EqualTo(p + k * a) for entry, p, k, a in zip(sums, pose, (2.0, 3.0), action, strict=True))
    term = systems.RewardTerm("cost", {"pose": 2}, lambda pose: -pose @ pose)
    reward = systems.RewardSystem([term]).ToSymbolic()
    context = reward.CreateDefaultContext()
    reward.GetInputPort("pose").FixValue(context, pose)
    assert reward.GetOutputPort("reward").Eval(context)[0].EqualTo(-(pose @ pose))
    assert reward.GetOutputPort("cost").Eval(context)[0].EqualTo(-(pose @ pose))


@pytest.mark.parametrize(
    "value", [lambda pose: float(pose[0]), lambda pose: pose[0] if pose[0] > 0 else 0.0, lambda pose: pose]
)
def test_term_that_is_no_formula_is_refused(value):
    reward = systems.RewardSystem([systems.RewardTerm("cost", {"pose": 2}, value)]).ToSymbolic()
    context = reward.CreateDefaultContext()
    reward.GetInputPort("pose").FixValue(context, np.array([Expression(Variable("p")), Expression(1.0)]))
    with pytest.raises(InputError, match="reward term 'cost' cannot be computed with Expression: use operators"):
        reward.GetOutputPort("reward").Eval(context)


def test_other_systems_are_refused_by_name():
    history = systems.HistoryBuffer(2, 3, 0.1)
    history.set_name("history")
    builder = DiagramBuilder()
    builder.AddSystem(history)
    builder.ExportInput(history.get_output_input_port())
    diagram = builder.Build()
    for convert in (diagram.ToAutoDiffXd, diagram.ToSymbolic):
        with pytest.raises(RuntimeError, match=r"System ::_::history of type \S+HistoryBuffer does not support scalar"):
            convert()


def test_conversion_back_to_floats_has_the_same_law():
    residual = systems.Residual([2.0, 3.0]).ToAutoDiffXd().ToScalarType[float]()
    context = residual.CreateDefaultContext()
    residual.GetInputPort("reference").FixValue(context, np.ones(2))
    residual.GetInputPort("action").FixValue(context, np.ones(2))
    np.testing.assert_array_equal(residual.GetOutputPort("desired_pose").Eval(context), [3.0, 4.0])
