"""Conversion of systems to AutoDiffXd and Expression: gradients against finite differences, and refusals."""

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.symbolic import Expression, Variable
from pydrake.systems.framework import DiagramBuilder

from guiderail import systems
from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import ArmImpedance, impedance_torques
from guiderail.models.control.wrench import WrenchBound
from guiderail.systems.support.scalar_conversion import differentiable_torques
from oracles.plants import six_axes
from oracles.prerequisites import changed_outputs
from oracles.systems import check_stale_outputs

STEP = 1e-6
LIMITS = np.array([60.0, 60.0, 60.0, 6.0, 6.0, 6.0])


def make_controller(bound=None, **options):
    plant, link = six_axes()
    K = np.diag([400.0, 300.0, 500.0, 20.0, 25.0, 15.0])
    K[0, 1] = K[1, 0] = 60.0
    gains = systems.ImpedanceGains(K, LIMITS, posture=np.full(6, 0.1), damping_ratio=0.7, bound=bound)
    return systems.CartesianImpedanceController(
        plant, plant.world_frame(), link.body_frame(), gains, period=0.01, **options
    )


def state_and_pose(seed):
    rng = np.random.default_rng(seed)
    state = 0.3 * rng.standard_normal(12)
    return np.r_[state, state[:6] + [0.02, -0.03, 0.01, 0.1, -0.05, 0.08]]


def evaluate(system, numbers, outputs, payload=None):
    """Return the outputs of a controller for the state and the desired pose `numbers`, in one vector."""
    context = system.CreateDefaultContext()
    if payload is not None:
        context.get_mutable_numeric_parameter(context.num_numeric_parameter_groups() - 1).SetFromVector(payload)
    system.GetInputPort("estimated_state").FixValue(context, numbers[:12])
    system.GetInputPort("desired_pose").FixValue(context, numbers[12:])
    return np.concatenate([system.GetOutputPort(name).Eval(context) for name in outputs])


def finite_differences(function, numbers):
    """Return the Jacobian of a function at `numbers` by central differences."""
    steps = STEP * np.eye(len(numbers))
    return np.column_stack([(function(numbers + step) - function(numbers - step)) / (2 * STEP) for step in steps])


@pytest.mark.parametrize(("seed", "mass"), [(0, 0.0), (1, 0.8)])
def test_gradient_of_the_impedance_equals_finite_differences(seed, mass):
    controller, numbers = make_controller(), state_and_pose(seed)
    outputs, payload = ("generalized_force", "impedance_wrench", "pose"), np.array([mass, 0.02, -0.01, 0.05])
    expected = evaluate(controller, numbers, outputs, payload)
    found = evaluate(controller.ToAutoDiffXd(), InitializeAutoDiff(numbers).ravel(), outputs, payload)
    np.testing.assert_allclose(ExtractValue(found).ravel(), expected, rtol=1e-9, atol=1e-9)
    jacobian = finite_differences(lambda values: evaluate(controller, values, outputs, payload), numbers)
    assert np.abs(expected[6:12]).max() < LIMITS.max()
    np.testing.assert_allclose(ExtractGradient(found), jacobian, rtol=1e-6, atol=2e-5)


def test_gradient_with_respect_to_gains_equals_finite_differences():
    controller, numbers = make_controller(), state_and_pose(0)
    stiffness = controller.gains(controller.CreateDefaultContext()).stiffness

    def torque(scales, system):
        context = system.CreateDefaultContext()
        scaled = np.reshape([scales[0] * k for k in stiffness.ravel()], 36)
        context.get_mutable_numeric_parameter(0).SetFromVector(scaled)
        system.GetInputPort("estimated_state").FixValue(context, numbers[:12])
        system.GetInputPort("desired_pose").FixValue(context, numbers[12:])
        return system.GetOutputPort("generalized_force").Eval(context)

    found = torque(InitializeAutoDiff([1.0]).ravel(), controller.ToAutoDiffXd())
    expected = finite_differences(lambda scales: torque(scales, controller), np.ones(1))
    np.testing.assert_allclose(ExtractGradient(found), expected, rtol=1e-6, atol=1e-5)


def test_saturated_entry_has_no_gradient():
    controller, numbers = make_controller(), state_and_pose(0)
    numbers[12] += 10.0
    system, outputs = controller.ToAutoDiffXd(), ("impedance_wrench", "saturation")
    found = evaluate(system, InitializeAutoDiff(numbers).ravel(), outputs)
    np.testing.assert_allclose(ExtractValue(found).ravel(), evaluate(controller, numbers, outputs), atol=1e-9)
    assert found[-1].value() == 1.0
    np.testing.assert_array_equal(ExtractGradient(found)[0], np.zeros(18))


@pytest.mark.parametrize(("share", "is_saturated"), [(1.0, False), (1.0 + 1e-12, True)])
def test_torque_at_its_limit_is_not_saturated(share, is_saturated):
    """As for floats: a torque that is not changed by its limit is not saturated."""
    zero, limits = np.zeros(6), np.full(6, 2.0)
    arguments = {"p_error": zero[:3], "eta": 1.0, "epsilon": zero[:3], "J": np.eye(6), "M": np.eye(6), "v": zero}
    arguments |= {"K": np.eye(6), "damping_ratio": 1.0, "wrench_limits": LIMITS}
    arguments |= {"posture_torque": zero, "gravity_torque": share * limits, "torque_limits": limits}
    assert impedance_torques(ArmImpedance(**arguments)).is_saturated == is_saturated
    assert differentiable_torques(ArmImpedance(**arguments)).is_saturated == is_saturated


def test_closed_loop_has_derivatives_of_its_motion():
    """The time derivatives of a robot under control, with a residual on the command, with respect to the action."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", six_axes()[0])
    controller = builder.AddNamedSystem("controller", make_controller())
    residual = builder.AddNamedSystem("residual", systems.Residual(np.full(6, 0.05)))
    terms = [
        systems.RewardTerm("effort", {"wrench": 6}, lambda wrench: -0.01 * wrench @ wrench),
        systems.RewardTerm("nearness", {"pose": 6}, lambda pose: np.exp(-np.linalg.norm(pose[:3]))),
        systems.RewardTerm("time", {}, lambda: -1.0),
    ]
    reward = builder.AddNamedSystem("reward", systems.RewardSystem(terms))
    builder.Connect(plant.get_state_output_port(), controller.get_estimated_state_input_port())
    builder.Connect(controller.get_generalized_force_output_port(), plant.get_actuation_input_port())
    builder.Connect(residual.get_desired_pose_output_port(), controller.get_desired_pose_input_port())
    builder.Connect(controller.get_impedance_wrench_output_port(), reward.get_signal_input_port("wrench"))
    builder.Connect(controller.get_pose_output_port(), reward.get_signal_input_port("pose"))
    builder.ExportInput(residual.get_reference_input_port(), "reference")
    builder.ExportInput(residual.get_action_input_port(), "action")
    builder.ExportOutput(reward.get_reward_output_port(), "reward")
    diagram, numbers = builder.Build(), state_and_pose(1)

    def motion(action, diagram):
        context = diagram.CreateDefaultContext()
        context.SetContinuousState(numbers[:12])
        diagram.GetInputPort("reference").FixValue(context, numbers[12:])
        diagram.GetInputPort("action").FixValue(context, action)
        derivatives = diagram.EvalTimeDerivatives(context).CopyToVector()
        return np.concatenate([derivatives, diagram.GetOutputPort("reward").Eval(context)])

    action = np.array([0.1, -0.2, 0.3, 0.0, 0.2, -0.1])
    found = motion(InitializeAutoDiff(action).ravel(), diagram.ToAutoDiffXd())
    expected = finite_differences(lambda values: motion(values, diagram), action)
    np.testing.assert_allclose(ExtractValue(found).ravel(), motion(action, diagram), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ExtractGradient(found), expected, rtol=1e-6, atol=1e-4)


def test_no_output_of_a_converted_system_is_stale():
    reward = systems.RewardSystem([systems.RewardTerm("cost", {"pose": 2}, lambda pose: -pose @ pose)])
    residual, controller = systems.Residual([2.0, 3.0]), make_controller()
    for system in (residual, reward):
        for converted in (system.ToAutoDiffXd(), system.ToSymbolic()):
            check_stale_outputs(converted)
    # Without a value at max_wrench, which an impedance with derivatives refuses.
    inputs = ("desired_pose", "estimated_state")
    stale, effects = changed_outputs(controller.ToAutoDiffXd(), trials=5, inputs=inputs)
    assert not stale
    assert {(source, "generalized_force") for source in ("desired_pose", "estimated_state")} <= effects


def test_context_of_a_converted_diagram_takes_state_and_parameters():
    controller = make_controller()
    context = controller.CreateDefaultContext()
    controller.set_payload(context, systems.Payload(0.5, (0.0, 0.0, 0.1)))
    converted = controller.ToAutoDiffXd().CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    index = context.num_numeric_parameter_groups() - 1
    assert converted.get_numeric_parameter(index).CopyToVector()[0].value() == 0.5
    assert converted.num_discrete_state_groups() == context.num_discrete_state_groups()


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


def test_conversion_of_an_impedance_that_is_not_smooth_is_refused():
    with pytest.raises(InputError, match="bounded impedance is not smooth: convert a controller without bound"):
        make_controller(WrenchBound(LIMITS, 100.0, 10.0)).ToAutoDiffXd()
    with pytest.raises(InputError, match="an impedance has no symbolic form"):
        make_controller().ToSymbolic()
    system = make_controller().ToAutoDiffXd()
    context = system.CreateDefaultContext()
    system.GetInputPort("estimated_state").FixValue(context, np.zeros(12))
    system.GetInputPort("desired_pose").FixValue(context, np.zeros(6))
    system.GetInputPort("max_wrench").FixValue(context, np.ones(8))
    with pytest.raises(InputError, match="do not connect max_wrench"):
        system.GetOutputPort("generalized_force").Eval(context)


@pytest.mark.parametrize(("index", "name"), [(3, "state"), (14, "desired pose")])
def test_number_that_is_not_finite_is_refused(index, name):
    numbers = state_and_pose(0)
    numbers[index] = np.nan
    with pytest.raises(InputError, match=f"derivatives of an impedance need a finite {name}"):
        evaluate(make_controller().ToAutoDiffXd(), InitializeAutoDiff(numbers).ravel(), ("generalized_force",))


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
