import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.iiwa import IIWA14
from guiderail.systems.joint_torque_wrench import JointTorqueWrench

READY_POSTURE = np.array(IIWA14.home)


@pytest.fixture(scope="module")
def arm():
    return controller_model(BncWorkcell())


def estimate(arm, wrench, seconds=0.005, **options):
    """Return the estimate from the joint torques of a wrench (6,), force first."""
    plant, model = arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, READY_POSTURE)
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, model.tool_center, np.zeros(3), model.target, model.target
    )
    system = JointTorqueWrench(
        plant, model.target, model.tool_center, **({"period": 0.01, "time_constant": 0.0} | options)
    )
    simulator = Simulator(system)
    system.get_positions_input_port().FixValue(simulator.get_mutable_context(), READY_POSTURE)
    torque = J.T @ np.concatenate([wrench[3:], wrench[:3]])
    system.get_external_torque_input_port().FixValue(simulator.get_mutable_context(), torque)
    simulator.AdvanceTo(seconds)
    assert not system.HasAnyDirectFeedthrough()
    return system.get_wrench_output_port().Eval(simulator.get_context()).copy()


def test_wrench_is_recovered_from_its_joint_torques(arm):
    wrench = np.array([5.0, -3.0, 12.0, 0.2, -0.1, 0.3])
    np.testing.assert_allclose(estimate(arm, wrench, damping=0.0), wrench, atol=1e-9)
    np.testing.assert_allclose(estimate(arm, wrench), wrench, rtol=0.05, atol=0.05)


def test_damping_has_its_documented_default_and_reduces_the_estimate(arm):
    wrench = np.array([5.0, -3.0, 12.0, 0.2, -0.1, 0.3])
    plant, model = arm
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, READY_POSTURE)
    J = plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, model.tool_center, np.zeros(3), model.target, model.target
    )
    damped = np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), J @ J.T @ np.concatenate([wrench[3:], wrench[:3]]))
    np.testing.assert_allclose(estimate(arm, wrench), [*damped[3:], *damped[:3]], rtol=1e-9)


def test_no_time_constant_means_no_filter(arm):
    plant, model = arm
    system = JointTorqueWrench(plant, model.target, model.tool_center, period=0.01, time_constant=0.0)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_positions_input_port().FixValue(context, READY_POSTURE)
    torque = system.get_external_torque_input_port().FixValue(context, np.linspace(-1.0, 1.0, 7))
    simulator.AdvanceTo(0.005)
    first = system.get_wrench_output_port().Eval(context).copy()
    torque.GetMutableData().set_value(np.linspace(-2.0, 2.0, 7))
    simulator.AdvanceTo(0.015)
    np.testing.assert_allclose(system.get_wrench_output_port().Eval(context), 2.0 * first, atol=1e-12)


def test_filter_is_a_first_order_low_pass_from_the_first_sample(arm):
    plant, model = arm
    system = JointTorqueWrench(plant, model.target, model.tool_center, period=0.01, time_constant=0.1, damping=0.0)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_positions_input_port().FixValue(context, READY_POSTURE)
    torque = system.get_external_torque_input_port().FixValue(context, np.linspace(-1.0, 1.0, 7))
    output = system.get_wrench_output_port()
    simulator.AdvanceTo(0.005)
    first = output.Eval(context).copy()
    assert np.linalg.norm(first) > 0.1
    torque.GetMutableData().set_value(np.linspace(-2.0, 2.0, 7))
    simulator.AdvanceTo(0.055)  # events at 10, 20, 30, 40 and 50 ms
    np.testing.assert_allclose(output.Eval(context), first * (2.0 - np.exp(-0.5)), atol=1e-9)
    context.SetTime(0.0)
    simulator.Initialize()
    np.testing.assert_array_equal(output.Eval(context), np.zeros(6))
    simulator.AdvanceTo(0.005)  # the first sample initializes the filter again
    np.testing.assert_allclose(output.Eval(context), 2.0 * first, atol=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        {"period": 0.0},
        {"time_constant": -1.0},
        {"time_constant": np.inf},
        {"damping": -1.0},
        {"damping": np.inf},
    ],
)
def test_constructor_refuses_arguments_out_of_range(arm, wrong):
    with pytest.raises(InputError):
        estimate(arm, np.zeros(6), **wrong)


@pytest.mark.parametrize("port", ["positions", "external_torque"])
def test_sample_is_skipped_when_it_is_not_finite(arm, port):
    plant, model = arm
    system = JointTorqueWrench(plant, model.target, model.tool_center, period=0.01, time_constant=0.1)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    valid_values = {"positions": READY_POSTURE, "external_torque": np.linspace(-1.0, 1.0, 7)}
    values = {name: system.GetInputPort(name).FixValue(context, value) for name, value in valid_values.items()}
    simulator.AdvanceTo(0.025)
    before = system.get_wrench_output_port().Eval(context).copy()
    values[port].GetMutableData().set_value(np.full(7, np.nan))
    simulator.AdvanceTo(0.035)
    np.testing.assert_array_equal(system.get_wrench_output_port().Eval(context), before)
    values[port].GetMutableData().set_value(valid_values[port])
    values["external_torque"].GetMutableData().set_value(2.0 * valid_values["external_torque"])
    simulator.AdvanceTo(1.0)
    assert np.isfinite(system.get_wrench_output_port().Eval(context)).all()
    assert np.linalg.norm(system.get_wrench_output_port().Eval(context) - before) > 0.1


@pytest.mark.parametrize("size", [1e5, 1e150, 1e308])
def test_filter_forgets_a_false_sample_of_any_size(arm, size):
    plant, model = arm
    system = JointTorqueWrench(plant, model.target, model.tool_center, period=0.005, time_constant=0.02)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_positions_input_port().FixValue(context, READY_POSTURE)
    torque = system.get_external_torque_input_port().FixValue(context, np.zeros(7))
    simulator.AdvanceTo(0.012)
    torque.GetMutableData().set_value(np.full(7, -size))
    simulator.AdvanceTo(0.017)
    assert np.linalg.norm(system.get_wrench_output_port().Eval(context)) > 1e3
    torque.GetMutableData().set_value(np.zeros(7))
    simulator.AdvanceTo(0.217)
    assert np.linalg.norm(system.get_wrench_output_port().Eval(context)) < 10.0
